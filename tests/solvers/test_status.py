"""Why a solve failed, for programs."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline.mpc import MPC, Constraint, Model, QuadraticCost, StateBounds
from mpcoffline.solvers import Solution, Status, make_solver


def pendulum(**changes: Any) -> MPC:
    arguments: dict[str, Any] = {
        "model": Model(lambda x, u, p: ca.vertcat(x[1], ca.sin(x[0]) + u), 2, 1, 0.1),
        "stage_cost": QuadraticCost(np.eye(2), [[0.1]]),
        "terminal_cost": QuadraticCost(np.eye(2)),
        "horizon": 8,
        "discount": 0.95,
        "action_low": [-1.0],
        "action_high": [1.0],
    }
    return MPC(**(arguments | changes))


def solved(mpc: MPC, solver: str, **options: Any) -> Solution:
    return make_solver(mpc, solver, **options).solve([[1.0, 0.2]])


def growing() -> MPC:
    """A model whose states leave the numbers that there are."""
    model = Model(lambda x, u, p: 1e90 * (x + u), 2, 1, 0.1, discrete=True)
    return pendulum(model=model, horizon=8)


@pytest.mark.parametrize(
    ("mpc", "solver", "options", "expected"),
    [
        (pendulum(), "ipopt", {}, Status.CONVERGED),
        (pendulum(), "ddp", {}, Status.CONVERGED),
        (pendulum(), "ddp", {"max_iterations": 1, "n_starts": 1}, Status.ITERATION_LIMIT),
        (pendulum(), "ipopt", {"max_iterations": 1, "n_starts": 1}, Status.ITERATION_LIMIT),
        (pendulum(), "ipopt", {"max_time": 1e-6}, Status.TIME_LIMIT),
        (pendulum(constraints=StateBounds([-0.5, -9.0], [0.5, 9.0])), "ipopt", {}, Status.INFEASIBLE),
        (pendulum(constraints=Constraint(lambda x, u, p: u + 2.0, "deep")), "ipopt", {}, Status.INFEASIBLE),
        (growing(), "ddp", {}, Status.NOT_FINITE),
    ],
)
def test_how_a_solve_ended(mpc: MPC, solver: str, options: dict[str, Any], expected: Status) -> None:
    solution = solved(mpc, solver, **options)
    assert solution.status == [expected]
    assert solution.success.tolist() == [expected is Status.CONVERGED]
    assert len(solution.words) == 1


def test_a_status_is_its_text() -> None:
    solution = solved(pendulum(), "ddp")
    assert solution.status[0] == "converged"
    assert str(solution.status) == "['converged']"
    assert solution.words == ["converged"]
    assert solution.unbatched().stats["iterations"].shape == ()


def test_words_of_a_linear_quadratic_problem_say_how() -> None:
    model = Model(lambda x, u, p: x + u, 2, 1, 0.1, discrete=True)
    solution = make_solver(pendulum(model=model), "lqr").solve([[0.01, 0.01], [9.0, 9.0]])
    assert solution.status == [Status.CONVERGED] * 2
    assert solution.words == ["Riccati", "QP"]
