"""Violations of limits: counted in the log and in closed loops, and a recommendation that they withhold."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline import TransitionTable
from mpcoffline.diagnostics.limits import LimitCheck, limit_checks, with_limits
from mpcoffline.diagnostics.verdict import Judgement
from mpcoffline.mpc import MPC, Constraint, Model, Penalty, QuadraticCost, StateBounds
from mpcoffline.simulation.episodes import Episodes

POWER = Constraint(lambda x, u, p: ca.vertcat(x[0] * u[0] - p["most"], -x[0] * u[0] - 9.0), "power", Penalty(2.0, 0.5))
LEVEL = StateBounds([-np.inf, -1.0], [0.5, 1.0], "level")
END = Constraint(lambda x, p: x[0], "end", terminal=True)


def limited(*constraints: Constraint | StateBounds, unit: float = 1.0) -> MPC:
    model = Model(lambda x, u, p: x + u[0] * unit, 2, 1, 1.0, {"most": 0.2 * unit}, discrete=True)
    return MPC(model, QuadraticCost(np.eye(2)), QuadraticCost(np.eye(2)), 3, 0.9, [-1.0], [1.0], list(constraints))


def run(x: list[float], u: list[float], n: int = 4) -> Episodes:
    """The same from every start, its second state at rest; one state more than inputs."""
    states = np.zeros((n, len(x), 2))
    states[:, :, 0] = x
    nothing = np.zeros((1, n))
    actions = np.tile(np.array(u)[None, :, None], (n, 1, 1))
    return Episodes(nothing, nothing, nothing > 0.0, states, actions, states[None], actions[None], np.zeros(1))


def log_of(x: list[float], u: list[float]) -> TransitionTable:
    states = np.stack([x, np.zeros(len(x))], axis=1)
    return TransitionTable.from_arrays(
        states[:-1], np.array(u)[:, None], np.zeros(len(u)), states[1:], np.zeros(len(u), dtype=bool)
    )


LOG = log_of([0.0, 0.4, 0.8, 0.6, 0.0], [0.5, 0.5, 0.5, 0.0])
FIRST, SECOND = run([0.0, 0.2, 0.4, 9.0], [0.5, 0.5, 0.5]), run([0.0, 0.6, 0.7, 9.0], [0.5, 0.5, -1.0])


def test_each_limit_is_counted() -> None:
    """By hand: x <= 0.5 along, x u <= 0.2; the last state, whose input nobody knows, and the end are left out."""
    level, power = sorted(limit_checks(limited(POWER, LEVEL, END), LOG, FIRST, SECOND), key=lambda each: each.name)
    assert (level.name, level.kind, level.shares) == ("level", "hard", (0.5, 0.0, pytest.approx(2 / 3)))
    assert level.largest == pytest.approx((0.3, 0.0, 0.2))
    assert level.worse
    assert (power.name, power.kind, power.shares) == ("power", "l1 = 2, l2 = 0.5", (0.25, 0.0, pytest.approx(1 / 3)))
    assert power.largest == pytest.approx((0.2, 0.0, 0.1))


def test_a_proposal_that_keeps_them_is_not_worse() -> None:
    (check,) = limit_checks(limited(LEVEL), LOG, SECOND, FIRST)
    assert not check.worse
    assert not limit_checks(limited(LEVEL), LOG, SECOND, SECOND)[0].worse


def test_a_trifle_is_none_in_any_unit() -> None:
    """A ten-thousandth over a limit that moves by 1."""
    nearly = run([0.0, 0.50005, 0.5, 9.0], [0.0, 0.0, 0.0])
    for unit in (1e-3, 1.0, 1e3):
        scaled = Constraint(lambda x, u, p, unit=unit: unit * (x[0] - 0.5), "level")
        (check,) = limit_checks(limited(scaled), LOG, SECOND, nearly)
        assert check.shares == pytest.approx((0.5, 2 / 3, 0.0))


def test_more_violations_withhold_a_recommendation() -> None:
    unknown: Any = None
    judgement = Judgement("recommend", ("cheaper", "and so on"), "full", None, unknown, (0.0, 0.0, 0.0))
    worse = LimitCheck("level", "hard", (0.1, 0.01, 0.2), (1.0, 1.0, 1.0), worse=True)
    changed = with_limits(judgement, (worse,))
    assert changed.verdict == "try with care"
    assert changed.reasons[0] == "cheaper"
    assert "full violates the limit 'level' (hard) in 20.0% of the steps, MPC_1 in 1.0%" in changed.reasons[1]
    fine = LimitCheck("level", "hard", (0.1, 0.2, 0.2), (1.0, 1.0, 1.0), worse=False)
    assert with_limits(judgement, (fine,)) is judgement
