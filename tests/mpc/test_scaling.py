"""The units of a problem, and the constant of a cost."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline import MPC, Model, Parameter, QuadraticCost, TransitionTable
from mpcoffline.estimation import identify
from mpcoffline.mpc import Block, ParameterSpace
from mpcoffline.mpc.component import Component
from mpcoffline.mpc.coordinates import with_level
from mpcoffline.mpc.scaling import cost_spread, increments_scale, spread_of


def scalar_mpc(stage: Any = None, *, delay: int = 0, start: float = 0.0) -> MPC:
    """x+ = 0.9 x + 0.1 (u + b)."""
    model = Model(lambda x, u, p: 0.9 * x + 0.1 * (u + p["b"]), 1, 1, 0.1, {"b": start}, discrete=True, delay=delay)
    return MPC(model, stage or QuadraticCost([[1.0]], [[0.1]]), QuadraticCost([[1.0]]), 5, 0.9, [-1e6], [1e6])


def test_spreads_are_sizes_where_nothing_varies() -> None:
    values = np.array([[1.0, 5.0, 0.0], [3.0, 5.0, 0.0]])
    np.testing.assert_array_equal(spread_of(values), [1.0, 5.0, 1.0])
    near = np.array([[1e6], [1e6 + 0.01]])
    assert spread_of(near)[0] == pytest.approx(0.005)
    assert spread_of(near, 1e-6)[0] == near.max()
    assert cost_spread(np.array([-3.0, -3.0])) == 3.0
    assert cost_spread(np.array([-1.0, 1.0])) == 1.0
    np.testing.assert_array_equal(increments_scale(np.array([[0.0], [0.0]]), np.array([[1.0], [-1.0]])), [1.0])


def test_a_level_goes_into_the_parameter_that_adds_one() -> None:
    mpc = scalar_mpc(QuadraticCost([[1.0]], [[0.1]], constant=2.0))
    moved = mpc.with_theta(with_level(mpc, mpc.theta, -7.0))
    assert float(moved.values["stage_cost.constant"]) == -5.0
    others = [name for name in mpc.values if name != "stage_cost.constant"]
    assert all(np.array_equal(moved.values[name], mpc.values[name]) for name in others)


class OwnCost(Component):
    """w x^2 + u^2 + factor c; without c where the factor is zero."""

    nx = 1

    def __init__(self, factor: float, low: float = -np.inf) -> None:
        self.factor = factor
        constant = [Block.free("c", Parameter(0.0, low=low), "cost")] if factor else []
        self.space = ParameterSpace([Block.free("w", 1.0, "cost"), *constant])

    def expression(self, x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return p["w"] * x[0] ** 2 + u[0] ** 2 + (self.factor * p["c"] if self.factor else 0.0)


@pytest.mark.parametrize(("factor", "low", "expected"), [(2.0, -np.inf, -3.0), (1.0, -1.0, -1.0)])
def test_a_level_heeds_slopes_and_bounds(factor: float, low: float, expected: float) -> None:
    mpc = scalar_mpc(OwnCost(factor, low))
    assert float(mpc.with_theta(with_level(mpc, mpc.theta, -6.0)).values["stage_cost.c"]) == expected


def test_a_cost_without_a_constant_stays() -> None:
    mpc = scalar_mpc(OwnCost(0.0))
    np.testing.assert_array_equal(with_level(mpc, mpc.theta, 3.0), mpc.theta)


def test_a_parameter_from_zero_is_found_behind_a_dead_time() -> None:
    rng, delay, truth, size = np.random.default_rng(0), 2, 1e4, 1e4
    rows = []
    for episode in range(10):
        x, past = rng.normal() * size, [0.0] * delay
        for _ in range(60):
            u = rng.normal() * size
            past.append(u)
            reached = 0.9 * x + 0.1 * (past[-1 - delay] + truth)
            rows.append([x, u, x * x, reached, episode])
            x = reached
    a = np.array(rows)
    table = TransitionTable.from_arrays(a[:, :1], a[:, 1:2], a[:, 2], a[:, 3:4], np.zeros(len(a)), a[:, 4].astype(int))
    mpc = scalar_mpc(delay=delay)
    found = identify(mpc, table)
    assert not found.undetermined
    assert float(mpc.with_theta(found.theta).values["model.b"]) == pytest.approx(truth, rel=1e-4)
