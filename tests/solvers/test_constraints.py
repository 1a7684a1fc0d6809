"""The ipopt solver under constraints: against linear and quadratic programs of scipy, by hand, and when infeasible."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC, Constraint, Model, Penalty, QuadraticCost, StateBounds
from mpcoffline.solvers import DDPSolver, IpoptSolver, Status

Array = NDArray[np.float64]
N, DISCOUNT = 6, 0.95


def double_integrator(**changes: Any) -> MPC:
    """Position and speed, x+ = x + 0.5 v, v+ = v + 0.5 u."""
    arguments: dict[str, Any] = {
        "model": Model(lambda x, u, p: ca.vertcat(x[0] + 0.5 * x[1], x[1] + 0.5 * u[0]), 2, 1, 0.5, discrete=True),
        "stage_cost": QuadraticCost(np.diag([1.0, 0.1]), [[0.1]]),
        "terminal_cost": QuadraticCost(np.diag([2.0, 1.0])),
        "horizon": N,
        "discount": DISCOUNT,
        "action_low": [-2.0],
        "action_high": [2.0],
    }
    return MPC(**(arguments | changes))


def trajectory(x: Array, u: Array) -> Array:
    """States ``(N + 1, 2)``."""
    states = [np.asarray(x, dtype=np.float64)]
    for force in u:
        p, v = states[-1]
        states.append(np.array([p + 0.5 * v, v + 0.5 * force]))
    return np.array(states)


def cost(x: Array, u: Array) -> float:
    states = trajectory(x, u)
    stages = states[:-1, 0] ** 2 + 0.1 * states[:-1, 1] ** 2 + 0.1 * u**2
    return float(stages @ DISCOUNT ** np.arange(N) + DISCOUNT**N * (2 * states[-1, 0] ** 2 + states[-1, 1] ** 2))


def by_slsqp(x: Array, inequalities: Any = None, equalities: Any = None, penalty: Any = None) -> Array:
    """The best inputs by another algorithm, in the inputs alone; inequalities(states, u) >= 0."""
    constraints = [
        {"type": kind, "fun": lambda u, h=h: h(trajectory(x, u), u)}
        for kind, h in (("ineq", inequalities), ("eq", equalities))
        if h is not None
    ]
    found = minimize(
        lambda u: cost(x, u) + (0.0 if penalty is None else penalty(trajectory(x, u))),
        np.zeros(N),
        method="SLSQP",
        bounds=[(-2.0, 2.0)] * N,
        constraints=constraints,
        options={"ftol": 1e-14, "maxiter": 500},
    )
    return np.asarray(found.x)


START = np.array([2.0, 0.0])


def test_state_bounds() -> None:
    mpc = double_integrator(constraints=StateBounds([-np.inf, -0.5], [np.inf, 1.0]))
    solution = IpoptSolver(mpc).solve(START)
    assert solution.success
    assert solution.x[:, 1].min() == pytest.approx(-0.5, abs=1e-7)
    truth = by_slsqp(START, inequalities=lambda x, u: x[1:, 1] + 0.5)
    np.testing.assert_allclose(solution.u[:, 0], truth, atol=1e-5)
    assert solution.value == pytest.approx(cost(START, truth), rel=1e-7)


def test_the_initial_state_may_lie_outside() -> None:
    """State bounds hold from the next state on: a state that can be left is no failure."""
    mpc = double_integrator(constraints=StateBounds([-np.inf, -0.5], [np.inf, 0.5]))
    solution = IpoptSolver(mpc).solve([0.0, 1.0])
    assert solution.success
    assert np.abs(solution.x[1:, 1]).max() <= 0.5 + 1e-7


def test_terminal_constraints() -> None:
    rest = Constraint(lambda x, p: ca.vertcat(x - 0.1, -x - 0.1), "rest", terminal=True)
    solution = IpoptSolver(double_integrator(constraints=[rest])).solve(START)
    assert solution.success
    truth = by_slsqp(START, inequalities=lambda x, u: np.r_[0.1 - x[-1], 0.1 + x[-1]])
    np.testing.assert_allclose(solution.u[:, 0], truth, atol=1e-5)


def test_terminal_equality_as_two_inequalities() -> None:
    """An interior-point method has no interior here; the answer must still be right."""
    stop = Constraint(lambda x, p: ca.vertcat(x[1], -x[1]), "stop", terminal=True)
    solution = IpoptSolver(double_integrator(constraints=[stop])).solve(START)
    assert solution.success
    np.testing.assert_allclose(solution.u[:, 0], by_slsqp(START, equalities=lambda x, u: x[-1, 1]), atol=1e-5)


def test_constraints_with_model_parameters_as_data() -> None:
    model = Model(lambda x, u, p: x + u * p["gain"], 1, 1, 1.0, {"gain": 1.0, "limit": 0.3}, discrete=True)
    limit = Constraint(lambda x, u, p: ca.vertcat(u - p["limit"], -u - p["limit"]), "limit")
    mpc = double_integrator(
        model=model, stage_cost=QuadraticCost([[1.0]]), terminal_cost=QuadraticCost([[1.0]]), constraints=limit
    )
    solver = IpoptSolver(mpc)
    assert solver.solve([5.0]).u0[0] == pytest.approx(-0.3, abs=1e-6)
    theta = mpc.space.pack({"model.limit": 0.7})
    assert solver.solve([5.0], theta).u0[0] == pytest.approx(-0.7, abs=1e-6)
    along = mpc.theta_along({"model.limit": np.linspace(0.2, 0.7, N)})
    np.testing.assert_allclose(solver.solve([5.0], along).u[:, 0], -np.linspace(0.2, 0.7, N), atol=1e-6)


# ---------------------------------------------------------------- soft constraints


def test_an_l1_penalty_above_the_multiplier_is_exact() -> None:
    bounds = {"low": [-np.inf, -0.5], "high": [np.inf, np.inf]}
    hard = IpoptSolver(double_integrator(constraints=StateBounds(**bounds))).solve(START)
    soft = IpoptSolver(double_integrator(constraints=StateBounds(**bounds, soft=Penalty(l1=100.0)))).solve(START)
    assert hard.success
    assert soft.success
    np.testing.assert_allclose(soft.u, hard.u, atol=1e-6)
    assert soft.value == pytest.approx(float(hard.value), rel=1e-6)


@pytest.mark.parametrize("solver", [IpoptSolver, DDPSolver])
@pytest.mark.parametrize("at_end", [True, False])
@pytest.mark.parametrize("weights", [Penalty(l1=0.3), Penalty(l2=2.0), Penalty(l1=0.1, l2=1.0)])
def test_weak_penalties_weigh_violation_against_cost(weights: Penalty, at_end: bool, solver: Any) -> None:
    """Violated a little: the value is the cost plus gamma^k (l1 s + l2 s^2), by another algorithm too."""
    stages = slice(1, N + 1) if at_end else slice(N)
    start = np.array([START[0], -0.6])

    def penalty(states: Array) -> float:
        s = np.maximum(-0.5 - states[:, 1], 0.0)
        return float((DISCOUNT ** np.arange(N + 1) * (weights.l1 * s + weights.l2 * s**2))[stages].sum())

    walls = StateBounds([-99.0, -99.0], [99.0, 99.0], "walls")
    slow = StateBounds([-np.inf, -0.5], [np.inf, np.inf], soft=weights, at_end=at_end)
    solution = solver(double_integrator(constraints=[walls, slow])).solve(start)
    assert solution.success
    assert solution.x[1:, 1].min() < -0.55
    own = cost(start, solution.u[:, 0]) + penalty(solution.x)
    assert solution.value == pytest.approx(own, rel=1e-6)
    truth = by_slsqp(start, penalty=penalty)
    assert own <= cost(start, truth) + penalty(trajectory(start, truth)) + 1e-6
    if not weights.l1:  # smooth, so that the other algorithm converges too
        np.testing.assert_allclose(solution.u[:, 0], truth, atol=1e-4)


def test_hard_bounds_hold_at_the_end() -> None:
    with pytest.raises(InvalidArgumentError, match="at_end: expected True for hard bounds"):
        StateBounds([-1.0], [1.0], "room", at_end=False)


def test_soft_constraints_are_never_infeasible() -> None:
    limits = [
        Constraint(lambda x, u, p: x[0] - 1.0, "wall", Penalty(l1=50.0)),
        Constraint(lambda x, p: ca.vertcat(x[0] + 9.0), "far", Penalty(l2=1.0), terminal=True),
        StateBounds([5.0, 5.0], [6.0, 6.0], "elsewhere", Penalty(l1=1.0, l2=1.0)),
    ]
    for x in ([2.0, 0.0], [50.0, 10.0]):
        solution = IpoptSolver(double_integrator(constraints=limits)).solve(x)
        assert solution.success, solution.status
        assert solution.stats["violation"] == 0.0


# ---------------------------------------------------------------- infeasible problems


@pytest.mark.parametrize(
    ("constraints", "named"),
    [
        ([StateBounds([-1.0, -9.0], [1.0, 9.0], "track")], r"'track\[0\]' at stage [12] is violated by"),
        ([Constraint(lambda x, u, p: 3.0 - u, "push")], r"'push' at stage \d is violated by [1-5]"),
        (
            [Constraint(lambda x, u, p: ca.vertcat(u - 5.0, x[0] - 4.0), "wall")],
            r"'wall\[1\]' at stage [01] is violated by [12]",
        ),
        ([Constraint(lambda x, p: x[0] + 50.0, "goal", terminal=True)], r"'goal' at stage 6 is violated by [345]\d"),
        (
            [StateBounds([-9.0, -9.0], [9.0, 9.0]), Constraint(lambda x, p: 20.0 - x[0], "goal", terminal=True)],
            r"'(goal|state bounds\[0\])' at stage",
        ),
    ],
)
@pytest.mark.parametrize("solver", [IpoptSolver, DDPSolver])
def test_the_violated_constraint_is_named(constraints: Any, named: str, solver: Any) -> None:
    solution = solver(double_integrator(constraints=constraints)).solve([[6.0, 0.0]])
    assert solution.success.tolist() == [False]
    assert solution.status == [Status.INFEASIBLE]
    assert solution.stats["violation"][0] > 0.1
    with pytest.raises(AssertionError, match=named):
        raise AssertionError(solution.words[0])


def test_an_imposed_input_that_breaks_a_constraint() -> None:
    mpc = double_integrator(constraints=Constraint(lambda x, u, p: u - 1.0, "gentle"))
    solution = IpoptSolver(mpc).solve([[1.0, 0.0]] * 2, u0=[[1.5], [0.5]])
    assert solution.success.tolist() == [False, True]
    assert "'gentle' at stage 0 is violated by 0.5" in solution.words[0]


# ---------------------------------------------------------------- success is decided by the trajectory


class _Claims:
    """A solver that returns a point and multipliers and claims success."""

    def __init__(self, solver: ca.Function, **changes: Any) -> None:
        self._solver, self._changes = solver, changes

    def __call__(self, **arguments: Any) -> dict[str, Any]:
        result = dict(self._solver(**arguments))
        for name, change in self._changes.items():
            result[name] = change(result[name])
        return result

    def stats(self) -> dict[str, Any]:
        return dict(self._solver.stats()) | {"return_status": "Solve_Succeeded"}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"x": lambda w: 0.9 * w}, "not optimal"),
        ({"x": lambda w: 0.99 * w}, "not optimal"),
        ({"x": lambda w: w * np.nan}, "not finite"),
    ],
)
def test_a_false_claim_is_no_success(changes: dict[str, Any], expected: str) -> None:
    solver = IpoptSolver(double_integrator())
    assert solver.solve(START).success
    program = solver._programs.common
    program._cold, program._exact = _Claims(program._cold, **changes), _Claims(program._exact, **changes)
    solution = solver.solve(START)
    assert not solution.success
    assert expected in solution.words[0]
    assert solver.value(START) == np.inf


def test_a_solution_stopped_early_is_no_success() -> None:
    solver = IpoptSolver(double_integrator(), max_iterations=1)
    solution = solver.solve(START)
    assert not solution.success
    assert solution.words[0].startswith("Maximum_Iterations_Exceeded: not optimal")


def test_the_trajectory_returned_is_the_models() -> None:
    solution = IpoptSolver(double_integrator()).solve(START)
    np.testing.assert_array_equal(solution.x, trajectory(START, solution.u[:, 0]))
    assert solution.value == pytest.approx(cost(START, solution.u[:, 0]), rel=1e-13)
