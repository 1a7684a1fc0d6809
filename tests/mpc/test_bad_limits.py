"""Limits that are wrong are refused when the MPC is made, by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC, Constraint, Model, Penalty, QuadraticCost, Signal, StateBounds

INF = np.inf


def limited(*constraints: Any) -> MPC:
    """Two states and a signal."""

    def step(x: Any, u: Any, p: Any, d: Any) -> Any:
        return 0.9 * x + u + d.inflow

    model = Model(step, 2, 1, 1.0, {"most": 1.0}, discrete=True, signals=[Signal("inflow")])
    return MPC(model, QuadraticCost(np.eye(2)), QuadraticCost(np.eye(2)), 4, 0.9, [-1.0], [1.0], list(constraints))


WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "low above high": (lambda: StateBounds([1.0, 0.0], [0.0, 1.0], "level"), r"level: expected low <= high"),
    "NaN": (lambda: StateBounds([np.nan, 0.0], [1.0, 1.0], "level"), r"level: expected low <= high"),
    "no number": (lambda: StateBounds([INF, 0.0], [INF, 1.0], "level"), r"level: expected low < inf"),
    "other shapes": (lambda: StateBounds([0.0], [1.0, 1.0], "level"), r"level: expected low <= high of one shape"),
    "too many": (lambda: limited(StateBounds(np.zeros(5), np.ones(5), "level")), r"level: expected 2 numbers"),
    "contradicting": (
        lambda: limited(StateBounds([0.5, -INF], [INF, INF], "above"), StateBounds([-INF, -INF], [0.4, INF], "below")),
        r"'above' and 'below': .*at least 0.5 and at most 0.4 of state 0",
    ),
    "a matrix": (
        lambda: limited(Constraint(lambda x, u, p: ca.horzcat(x[0], x[1]), "h")),
        r"h: expected a column, got shape \(1, 2\)",
    ),
    "nothing": (lambda: limited(Constraint(lambda x, u, p: ca.SX(0, 1), "h")), r"h: expected a column"),
    "a negative price": (lambda: StateBounds([0], [1], "level", Penalty(-1.0)), r"level.soft: expected weights >= 0"),
    "NaN for a price": (lambda: Constraint(lambda x, u, p: u, "h", Penalty(1.0, np.nan)), r"h.soft: expected weights"),
    "no price": (lambda: Constraint(lambda x, u, p: u, "h", Penalty()), r"h.soft: expected weights"),
    "a number for prices": (lambda: Constraint(lambda x, u, p: u, "h", 20.0), r"h.soft: expected Penalty\(l1, l2\)"),
    "of a signal": (
        lambda: limited(Constraint(lambda x, u, p, d: d.inflow - 1.0, "flood")),
        r"flood: expected a limit of the plant's states or inputs",
    ),
    "of parameters": (
        lambda: limited(Constraint(lambda x, u, p: p["most"] - 2.0, "h")),
        r"h: expected a limit of the plant's states or inputs",
    ),
    "of an input, at the end": (
        lambda: limited(Constraint(lambda x, u, p: u, "end", terminal=True)),
        r"end: expected a function of CasADi SX expressions",
    ),
    "a comparison": (
        lambda: limited(Constraint(lambda x, u, p: ca.vertcat(x[1] - 1.0, x[0] <= 1.0), "h")),
        r"h: expected h <= 0 that grows .* got a step",
    ),
    "an infinite bound": (
        lambda: limited(Constraint(lambda x, u, p: x[:2] - ca.DM([1.0, INF]), "h")),
        r"h: expected finite numbers, got an infinite one. Leave out",
    ),
    "NaN in h": (lambda: limited(Constraint(lambda x, u, p: x[0] - np.nan, "h")), r"h: .*constant NaN"),
    "an unknown parameter": (
        lambda: limited(Constraint(lambda x, u, p: x[0] - p["least"], "h")),
        r"h: expected a function .* KeyError: 'least'",
    ),
    "a text for a bound": (lambda: StateBounds(["low"], [1.0], "level"), r"level: expected numbers"),
    "a name that occurs twice": (
        lambda: limited(StateBounds([0, 0], [1, 1], "level"), StateBounds([0, 0], [1, 1], "level")),
        r"names of constraints: expected unique names",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_it_is_refused(what: str) -> None:
    make, words = WRONG[what]
    with pytest.raises(InvalidArgumentError, match=words):
        make()


def test_what_is_fine() -> None:
    """Bounds that touch, a signal beside a state, bounds that bound nothing: these are dropped."""
    touching = StateBounds([0.5, -INF], [INF, INF], "above"), StateBounds([-INF, -INF], [0.5, INF], "below")
    beside = Constraint(lambda x, u, p, d: x[0] + d.inflow - 1.0, "flood")
    assert len(limited(*touching, beside).constraints) == 3
    assert limited(StateBounds([-INF, -INF], [INF, INF], "free")).constraints is None
