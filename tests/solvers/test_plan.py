"""Warm starts: the plan one step later."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st

from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.solvers import DDPSolver, Plan
from mpcoffline.solvers.plan import pauses


def resting(n_steps: int, at: int) -> np.ndarray:
    """A trajectory that comes to rest and leaves again ever faster, slowest at a step, ``(1, N + 1, 2)``."""
    t = np.arange(n_steps + 1.0)
    path = np.exp(t - 2.0 * at) - np.exp(-t)
    return np.stack([path, -3.0 * path], axis=1)[None]


def test_it_waits_at_its_end() -> None:
    plan = Plan(np.arange(4.0).reshape(1, 4, 1), np.arange(3.0).reshape(1, 3, 1), np.arange(7.0).reshape(1, 7, 1))
    later = plan.shifted()
    assert later.x.ravel().tolist() == [1, 2, 3, 3]
    assert later.u.ravel().tolist() == [1, 2, 2]
    assert later.multipliers is not None
    assert later.multipliers.ravel().tolist() == [1, 2, 3, 3, 4, 5, 6]


def test_it_waits_where_it_rests() -> None:
    x = np.array([4.0, 1.0, 0.1, 0.0, -0.1, -2.0, -5.0]).reshape(1, 7, 1)
    plan = Plan(np.concatenate([x, -np.arange(7.0).reshape(1, 7, 1)]), np.arange(12.0).reshape(2, 6, 1))
    assert pauses(plan.x).tolist() == [3, 6]  # the other one does not rest
    later = plan.shifted()
    assert later.x[:, :, 0].tolist() == [[1.0, 0.1, 0.0, 0.0, -0.1, -2.0, -5.0], [-1, -2, -3, -4, -5, -6, -6]]
    assert later.u[:, :, 0].tolist() == [[1, 2, 3, 3, 4, 5], [7, 8, 9, 10, 11, 11]]
    y = np.arange(20.0).reshape(2, 10, 1)
    told = Plan(plan.x, plan.u, y).shifted().multipliers
    assert told is not None
    assert told[:, :, 0].tolist() == [[1, 2, 3, 3, 4, 5, 6, 7, 8, 9], [11, 12, 13, 14, 15, 16, 16, 17, 18, 19]]


def test_it_also_waits_where_it_is_slow_at_a_lower_cost_than_at_its_end() -> None:
    """Each of four is slowest after three steps; the second is a tenth as fast as ever there, and the last is late."""
    speeds = np.array([[4, 3, 1, 1, 2, 6], [40, 3, 1, 1, 2, 6], [4, 3, 1, 1, 2, 6], [9, 7, 2, 2, 2, 3]], dtype=float)
    x = np.cumsum(np.hstack([np.zeros((4, 1)), speeds]), axis=1)[:, :, None]
    asked = []

    def cheaper(rows: np.ndarray, steps: np.ndarray) -> np.ndarray:
        asked.append((rows.tolist(), steps.tolist()))
        return rows == 0

    assert pauses(x).tolist() == [6, 3, 6, 6]
    assert pauses(x, cheaper).tolist() == [3, 3, 6, 6]
    assert asked == [([0, 2], [3, 3])]


@pytest.mark.parametrize("plan", [Plan.none, lambda n, mpc: Plan(np.ones((n, 9, 2)), np.ones((n, 8, 1)))])
def test_what_does_not_move_or_is_none_is_held(plan: object) -> None:
    mpc = leaving(8)
    given_plan = plan(2, mpc)  # type: ignore[operator]
    np.testing.assert_array_equal(given_plan.shifted().x, given_plan.x)
    assert pauses(given_plan.x).tolist() == [8, 8]


@given(at=st.integers(2, 8), exponent=st.integers(-200, 200), sign=st.sampled_from([-1.0, 1.0]))
def test_no_unit_of_a_state_matters(at: int, exponent: int, sign: float) -> None:
    x = resting(12, at)
    assert pauses(x).tolist() == [at]
    assert pauses(x * [[[sign * 2.0**exponent, 1.0]]]).tolist() == [at]


def leaving(horizon: int) -> MPC:
    """A cart that shall stand at 0, and be at 3 at the end."""
    model = Model(lambda x, u, p: ca.vertcat(x[0] + 0.2 * x[1], x[1] + 0.2 * u), 2, 1, 0.2, discrete=True)
    stage, end = QuadraticCost(np.diag([1.0, 0.1]), [[0.1]]), QuadraticCost(5.0 * np.eye(2), x_ref=[3.0, 0.0])
    return MPC(model, stage, end, horizon, 1.0, [-5.0], [5.0])


def using_up(horizon: int) -> MPC:
    """A level that shall be kept, and be another at the end; a stock runs out meanwhile, faster when it is high."""
    model = Model(lambda x, u, p: ca.vertcat(x[0] + 0.2 * u, x[1] - 0.1 - 0.05 * x[0] ** 2), 2, 1, 0.2, discrete=True)
    stage, end = QuadraticCost(np.diag([1.0, 0.0]), [[0.1]]), QuadraticCost(np.diag([5.0, 0.0]), x_ref=[3.0, 0.0])
    return MPC(model, stage, end, horizon, 1.0, [-5.0], [5.0])


def test_a_turnpike_on_which_something_moves_is_told_by_the_stage_cost() -> None:
    mpc = using_up(40)
    solver = DDPSolver(mpc)
    plan = solver.solve(np.array([[2.0, 5.0], [-3.0, 1.0]])).plan
    following = solver.solve(plan.x[:, 1])
    assert np.abs(plan.shifted().u - following.u).max() > 1.0
    assert np.abs(plan.shifted(mpc).u - following.u).max() < 0.01
    iterations = [
        solver.solve(plan.x[:, 1], warm_start=start).stats["iterations"].sum()
        for start in (plan.shifted(mpc), plan.shifted())
    ]
    assert iterations[0] < iterations[1]


def test_a_turnpike_is_next_to_the_next_solution() -> None:
    """Beside the solution of the next state: a plan that waits on its way, and one that is held at its end."""
    mpc = leaving(60)
    solver = DDPSolver(mpc)
    x = np.array([[2.0, -1.0], [-3.0, 0.5], [0.1, 0.0]])
    plan = solver.solve(x).plan
    following = solver.solve(plan.x[:, 1]).u
    held = np.concatenate([plan.u[:, 1:], plan.u[:, -1:]], axis=1)
    waiting = plan.shifted().u
    assert np.abs(held - following).max() > 1.0
    assert np.abs(waiting - following).max() < 0.01
