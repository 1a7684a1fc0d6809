"""The ipopt solver: the theorem it must reproduce, other optimisers, and its behaviour towards callers."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from mpc_problems import random_states
from numpy.typing import NDArray
from riccati import optimum
from scipy.optimize import minimize
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.envs import ENV_IDS
from mpcoffline.envs.linear_tracking import A0, ACTION_WEIGHT, B0, STATE_WEIGHT, plant_matrices
from mpcoffline.mpc import MPC, Model, NetworkCost, QuadraticCost
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import IpoptSolver, Plan, Solution
from mpcoffline.solvers.linear_quadratic import is_convex

Array = NDArray[np.float64]


@cache
def solver_of(env_id: str, horizon: int, tolerance: float = 1e-8) -> IpoptSolver:
    mpc = nominal_mpc(env_id, alpha=0.0).replace(horizon=horizon)
    return IpoptSolver(mpc, tolerance=tolerance)


def actions_of(mpc: MPC, n: int, seed: int = 1) -> Array:
    return np.random.default_rng(seed).uniform(mpc.action_low, mpc.action_high, size=(n, mpc.nu))


def rollout_cost(mpc: MPC, x: Array, inputs: Array) -> float:
    """The objective of (MPC) by calling its functions one after the other."""
    total, weight = 0.0, 1.0
    for u in inputs:
        total += weight * float(mpc.stage_function(x, u, mpc.theta))
        x = mpc.dynamics_function(x, u, mpc.theta).full().ravel()
        weight *= mpc.discount
    return total + weight * float(mpc.terminal_function(x, mpc.theta))


# ---------------------------------------------------------------- (THM)


@cache
def theorem(horizon: int) -> tuple[IpoptSolver, Any]:
    """The linear task at alpha = 1: T = V*, Lhat = Q* - gamma V*(f) with the *nominal* model f."""
    nominal = nominal_mpc(LINEAR)
    A, B = plant_matrices(1.0)
    optimal = optimum(A, B, STATE_WEIGHT, ACTION_WEIGHT, nominal.discount)
    model = np.hstack([A0, B0])
    H = optimal.Q - nominal.discount * model.T @ optimal.P @ model
    assert np.linalg.eigvalsh(H)[0] > 0.04  # positive definite at this alpha
    mpc = nominal.replace(
        stage_cost=QuadraticCost(H[:4, :4], H[4:, 4:], H[:4, 4:]),
        terminal_cost=QuadraticCost(optimal.P),
        horizon=horizon,
    )
    np.testing.assert_array_equal(mpc.values["model.A"], A0)
    return IpoptSolver(mpc, tolerance=1e-12), optimal


@pytest.mark.parametrize("horizon", [1, 10])
def test_theorem_gain(horizon: int) -> None:
    """pi_th = pi* although the model is wrong. 0.3 times the unit vectors keep the inputs within their bounds."""
    solver, optimal = theorem(horizon)
    solution = solver.solve(0.3 * np.eye(4))
    assert solution.success.all()
    np.testing.assert_allclose(solution.u0.T / 0.3, optimal.K, rtol=0, atol=1e-9)


@pytest.mark.parametrize("horizon", [1, 10])
def test_theorem_values(horizon: int) -> None:
    """V_th = V* and Q_th = Q*, also far from the optimal input."""
    solver, optimal = theorem(horizon)
    rng = np.random.default_rng(0)
    s, a = rng.uniform(-0.3, 0.3, size=(20, 4)), rng.uniform(-4, 4, size=(20, 2))
    z = np.hstack([s, a])
    np.testing.assert_allclose(solver.value(s), np.einsum("bi,ij,bj->b", s, optimal.P, s), rtol=0, atol=1e-8)
    np.testing.assert_allclose(solver.q_value(s, a), np.einsum("bi,ij,bj->b", z, optimal.Q, z), rtol=0, atol=1e-8)


def test_the_nominal_cost_would_not_do() -> None:
    """The theorem's test can fail: with the nominal cost the gain is another."""
    _, optimal = theorem(10)
    nominal = solver_of(LINEAR, 10)
    assert np.abs(nominal.solve(0.3 * np.eye(4)).u0.T / 0.3 - optimal.K).max() > 0.1


# ---------------------------------------------------------------- properties of V and Q


@pytest.mark.slow
@pytest.mark.parametrize(("env_id", "horizon"), [(LINEAR, 10), (PENDULUM, 10), (CARTPOLE, 5)])
def test_q_value_is_at_least_the_value(env_id: str, horizon: int) -> None:
    """Q_th(s, a) >= V_th(s), with equality at the solution. ipopt's relative tolerance 1e-8, times the value's size."""
    solver = solver_of(env_id, horizon)
    x = random_states(env_id, 8)
    solution = solver.solve(x)
    assert solution.success.all()
    tolerance = 1e-6 * (1.0 + np.abs(solution.value))
    for seed in range(2):
        q = solver.q_value(x, actions_of(solver.mpc, len(x), seed))
        assert (q >= solution.value - tolerance).all()
        assert (q > solution.value + 1e-3).any()
    assert (np.abs(solver.q_value(x, solution.u0) - solution.value) <= tolerance).all()


@pytest.mark.parametrize(("env_id", "horizon"), [(LINEAR, 10), (PENDULUM, 10), (CARTPOLE, 5)])
def test_solutions_obey_the_problem(env_id: str, horizon: int) -> None:
    solver = solver_of(env_id, horizon)
    mpc = solver.mpc
    x = random_states(env_id, 8)
    solution = solver.solve(x)
    np.testing.assert_array_equal(solution.x[:, 0], x)
    np.testing.assert_array_equal(solution.u0, solution.u[:, 0])
    assert ((solution.u >= mpc.action_low) & (solution.u <= mpc.action_high)).all()
    np.testing.assert_allclose(mpc.model(solution.x[:, :-1], solution.u), solution.x[:, 1:], rtol=0, atol=1e-6)
    costs = [rollout_cost(mpc, state, inputs) for state, inputs in zip(x, solution.u, strict=True)]
    # Clipping the inputs to their bounds moves them by ipopt's relaxation of 1e-8.
    np.testing.assert_allclose(solution.value, costs, rtol=1e-5, atol=1e-6)


def test_an_imposed_input_is_the_first() -> None:
    solver = solver_of(PENDULUM, 10)
    x, u = random_states(PENDULUM, 5), actions_of(solver.mpc, 5)
    solution = solver.solve(x, u0=u)
    np.testing.assert_allclose(solution.u0, u, rtol=0, atol=1e-12)
    np.testing.assert_allclose(solution.x[:, 1], solver.mpc.model(x, u), rtol=0, atol=1e-6)


@pytest.mark.parametrize(("env_id", "horizon"), [(LINEAR, 4), (PENDULUM, 6), (CARTPOLE, 5)])
def test_against_single_shooting_by_scipy(env_id: str, horizon: int) -> None:
    """L-BFGS-B over the inputs alone, from several starts, finds nothing better and, at its best, nothing worse."""
    solver = solver_of(env_id, horizon)
    mpc = solver.mpc
    shape = (horizon, mpc.nu)
    u, s = ca.SX.sym("u", horizon * mpc.nu), ca.SX.sym("s", mpc.nx)
    x, cost = s, 0
    for k in range(horizon):
        uk = u[k * mpc.nu : (k + 1) * mpc.nu]
        cost += mpc.discount**k * mpc.stage_function(x, uk, mpc.theta)
        x = mpc.dynamics_function(x, uk, mpc.theta)
    cost += mpc.discount**horizon * mpc.terminal_function(x, mpc.theta)
    gradient = ca.Function("g", [u, s], [ca.gradient(cost, u)])
    bounds = list(zip(np.tile(mpc.action_low, horizon), np.tile(mpc.action_high, horizon), strict=True))
    rng = np.random.default_rng(0)
    for state in random_states(env_id, 4):
        found = [
            minimize(
                lambda v, state=state: rollout_cost(mpc, state, v.reshape(shape)),
                rng.uniform(*np.array(bounds).T),
                jac=lambda v, state=state: gradient(v, state).full().ravel(),
                method="L-BFGS-B",
                bounds=bounds,
                options={"ftol": 1e-14, "gtol": 1e-9, "maxiter": 500},
            ).fun
            for _ in range(4)
        ]
        value = float(solver.value(state))
        assert value == pytest.approx(min(found), rel=1e-6, abs=1e-6)


def test_discount_and_horizon_enter() -> None:
    """One step by hand: x+ = x + u, W = 1, R = 1, T = 2 x^2: V = x^2 + min u^2 + 2 gamma (x + u)^2."""
    for gamma in (1.0, 0.5):
        mpc = integrator(horizon=1, discount=gamma)
        expected = 4.0 * (1 + 2 * gamma / (1 + 2 * gamma))
        assert IpoptSolver(mpc).value([2.0]) == pytest.approx(expected, rel=1e-7)


# ---------------------------------------------------------------- constraints


def integrator(**changes: Any) -> MPC:
    """x+ = x + u with cost x^2 + u^2 and terminal cost 2 x^2."""
    arguments: dict[str, Any] = {
        "model": Model(lambda x, u, p: x + u, 1, 1, 1.0, discrete=True),
        "stage_cost": QuadraticCost([[1.0]], [[1.0]]),
        "terminal_cost": QuadraticCost([[2.0]]),
        "horizon": 4,
        "discount": 0.95,
        "action_low": [-3.0],
        "action_high": [3.0],
    }
    return MPC(**(arguments | changes))


def rate_limit(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    return ca.vertcat(u[0] - 0.2, -u[0] - 0.2)


def test_constraints_are_respected_and_cost() -> None:
    free, limited = IpoptSolver(integrator()), IpoptSolver(integrator(constraints=rate_limit))
    x = np.array([[2.0], [-1.5], [0.1]])
    solution = limited.solve(x)
    assert solution.success.all()
    assert np.abs(solution.u).max() <= 0.2 + 1e-6
    np.testing.assert_allclose(solution.u0[:2, 0], [-0.2, 0.2], atol=1e-6)
    assert (solution.value[:2] > free.value(x)[:2] + 0.1).all()
    assert solution.value[2] == pytest.approx(float(free.value(x)[2]), abs=1e-6)  # inactive there
    u = np.array([[-0.1], [0.1], [0.0]])
    assert (limited.q_value(x, u) >= free.q_value(x, u) - 1e-6).all()


def test_state_constraints_on_a_nonlinear_task() -> None:
    def speed_limit(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return ca.vertcat(x[2] - 0.2, -0.2 - x[2])

    free = solver_of(PENDULUM, 20)
    limited = IpoptSolver(free.mpc.replace(constraints=speed_limit))
    state = np.array([np.cos(0.3), np.sin(0.3), 0.0])
    before, after = free.solve(state), limited.solve(state)
    assert before.success
    assert after.success
    assert np.abs(before.x[:-1, 2]).max() > 0.25
    assert np.abs(after.x[:-1, 2]).max() <= 0.2 + 1e-5
    assert after.value > before.value


@pytest.mark.slow
def test_infeasible_problems_are_reported_not_raised() -> None:
    solver = IpoptSolver(integrator(constraints=rate_limit))
    x = np.array([[2.0], [1.0]])
    u = np.array([[-1.0], [-0.2]])  # the first violates the rate limit
    solution = solver.solve(x, u0=u)
    assert solution.success.tolist() == [False, True]
    assert solution.status[0] not in ("Solve_Succeeded", "Solved_To_Acceptable_Level")
    q = solver.q_value(x, u)
    assert q[0] == np.inf
    assert np.isfinite(q[1])
    assert np.isfinite(solution.u).all()

    def impossible(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return 1.0 + x[0] ** 2

    nowhere = IpoptSolver(integrator(constraints=impossible))
    assert not nowhere.solve([1.0]).success
    assert nowhere.value([1.0]) == np.inf


def test_a_model_that_turns_nan_is_reported_not_raised() -> None:
    model = Model(lambda x, u, p: ca.sqrt(x) + u, 1, 1, 1.0, discrete=True)
    solution = IpoptSolver(integrator(model=model)).solve([-1.0])
    assert not solution.success


# ---------------------------------------------------------------- batches, warm starts, errors


def assert_same(left: Solution, right: Solution) -> None:
    for name in ("u0", "x", "u", "value", "success"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name))
    np.testing.assert_array_equal(left.stats["iterations"], right.stats["iterations"])


@pytest.mark.parametrize(("env_id", "horizon"), [(LINEAR, 10), (PENDULUM, 10)])
def test_a_batch_equals_one_by_one(env_id: str, horizon: int) -> None:
    solver = solver_of(env_id, horizon)
    x = random_states(env_id, 4)
    batch = solver.solve(x)
    assert batch.u0.shape == (4, solver.mpc.nu)
    assert batch.x.shape == (4, horizon + 1, solver.mpc.nx)
    assert batch.u.shape == (4, horizon, solver.mpc.nu)
    assert batch.value.shape == batch.success.shape == batch.stats["iterations"].shape == (4,)
    assert len(batch.status) == 4
    for k in range(4):
        one = solver.solve(x[k])
        assert one.u0.shape == (solver.mpc.nu,)
        assert one.x.shape == (horizon + 1, solver.mpc.nx)
        assert np.ndim(one.value) == np.ndim(one.success) == np.ndim(one.stats["iterations"]) == 0
        for name in ("u0", "x", "u", "value", "success"):
            np.testing.assert_array_equal(getattr(one, name), getattr(batch, name)[k])
        assert np.ndim(solver.value(x[k])) == np.ndim(solver.q_value(x[k], one.u0)) == 0
    assert solver.value(x).shape == (4,)


def test_equal_calls_give_equal_results() -> None:
    x = random_states(PENDULUM, 3)
    solver = solver_of(PENDULUM, 10)
    first = solver.solve(x)
    solver.solve(random_states(PENDULUM, 2, seed=9))  # nothing hidden is kept
    assert_same(first, solver.solve(x))
    assert_same(first, IpoptSolver(solver.mpc).solve(x))
    warm = first.plan.shifted()
    assert_same(solver.solve(x, warm_start=warm), solver.solve(x, warm_start=warm))


@pytest.mark.parametrize(("env_id", "horizon"), [(LINEAR, 30), (PENDULUM, 30)])
def test_warm_starts_reach_the_same_value_sooner(env_id: str, horizon: int) -> None:
    solver = solver_of(env_id, horizon)
    first = solver.solve(random_states(env_id, 4))
    successor = first.x[:, 1]
    cold = solver.solve(successor)
    warm = solver.solve(successor, warm_start=first.plan.shifted())
    assert warm.success.all()
    # The warm one may have found a better minimum, or the cold one: here they agree.
    np.testing.assert_allclose(warm.value, cold.value, rtol=1e-6, atol=1e-6)
    assert (warm.stats["iterations"] < cold.stats["iterations"]).all()
    assert_same(warm, solver.solve(successor, warm_start=first.plan.shifted()))


def test_rows_of_nan_start_cold() -> None:
    solver = solver_of(PENDULUM, 10)
    x = random_states(PENDULUM, 3)
    cold = solver.solve(x)
    plan = cold.plan.select(np.array([True, False, True]))
    assert plan.known.tolist() == [True, False, True]
    mixed = solver.solve(x, warm_start=plan)
    np.testing.assert_array_equal(mixed.u[1], cold.u[1])
    assert mixed.stats["iterations"][1] == cold.stats["iterations"][1]
    assert mixed.stats["iterations"][0] < cold.stats["iterations"][0]
    assert_same(solver.solve(x, warm_start=Plan.none(3, solver.mpc)), cold)
    assert cold.plan.known.all()  # select leaves its source alone


def test_a_solution_is_a_warm_start() -> None:
    solver = solver_of(PENDULUM, 10)
    x = random_states(PENDULUM, 2)
    batch, one = solver.solve(x), solver.solve(x[0])
    assert repr(solver) == "IpoptSolver(nx=3, nu=1, horizon=10)"
    assert repr(one) == f"Solution(u0={one.u0!r}, value={one.value!r}, success={one.success!r})"
    again = solver.solve(x, warm_start=batch)
    np.testing.assert_allclose(again.value, batch.value, rtol=1e-6)
    assert solver.solve(x[0], warm_start=one).value == pytest.approx(one.value, rel=1e-6)


def test_a_useless_warm_start_does_no_harm() -> None:
    solver = solver_of(PENDULUM, 10)
    x = random_states(PENDULUM, 3)
    cold = solver.solve(x)
    plan = Plan(np.full_like(cold.x, 1e3), np.full_like(cold.u, -50.0))
    misled = solver.solve(x, warm_start=plan)
    assert misled.success.all()
    np.testing.assert_allclose(misled.value, cold.value, rtol=1e-5, atol=1e-5)


def test_theta_is_an_argument() -> None:
    solver = IpoptSolver(integrator())
    theta = solver.mpc.space.pack({"stage_cost.R": [[10.0]]})
    other = IpoptSolver(solver.mpc.with_theta(theta))
    x = np.array([[1.0], [-0.4]])
    np.testing.assert_array_equal(solver.value(x, theta), other.value(x))
    assert (solver.value(x, theta) > solver.value(x)).all()
    np.testing.assert_array_equal(solver.q_value(x, [[0.1], [0.2]], theta), other.q_value(x, [[0.1], [0.2]]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x": [0.0, 0.0]}, r"x: expected shape \(B, 3\) or \(3,\), got shape \(2,\)"),
        ({"x": np.zeros((2, 2, 3))}, r"x: expected shape .* got shape \(2, 2, 3\)"),
        ({"x": np.zeros((0, 3))}, r"x: expected shape .* got shape \(0, 3\)"),
        ({"x": 1.0}, "x: expected shape"),
        ({"x": [[1.0, 0.0, 0.0], [1.0, np.nan, 0.0]]}, "x: expected finite numbers, got .*nan.* in row 1"),
        ({"x": [1.0, 0.0, np.inf]}, "x: expected finite numbers"),
        ({"x": np.zeros((2, 3)), "u0": [[0.0]]}, "u0: expected 2 rows, as x, got 1 rows"),
        ({"x": np.zeros(3), "u0": [0.0, 0.0]}, r"u0: expected shape"),
        ({"x": np.zeros(3), "u0": [np.nan]}, "u0: expected finite numbers"),
        ({"x": np.zeros(3), "u0": [2.1]}, r"u0: expected inputs from \[-2.\] to \[2.\], got \[\[2.1\]\]"),
        ({"x": np.zeros(3), "theta": [1.0]}, r"theta: expected shape \(\d+,\), got shape \(1,\)"),
        ({"x": np.zeros(3), "theta": "nan"}, r"theta\[0\] \(model.m\): expected a finite number"),
        ({"x": np.zeros(3), "theta": "low"}, r"theta\[0\] \(model.m\): expected a finite number from 0.01"),
        (
            {"x": np.zeros(3), "warm_start": "batch"},
            r"warm_start.x: expected shape \(1, 11, 3\), got shape \(2, 11, 3\)",
        ),
        ({"x": np.zeros(3), "warm_start": "horizon"}, "warm_start.u: expected shape"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    solver = solver_of(PENDULUM, 10)
    arguments = dict(arguments)
    theta = solver.mpc.theta
    named: dict[str, Any] = {
        "nan": np.where(np.arange(len(theta)) == 0, np.nan, theta),
        "low": np.where(np.arange(len(theta)) == 0, 0.001, theta),
        "batch": Plan.none(2, solver.mpc),
        "horizon": Plan(np.zeros((1, 11, 3)), np.zeros((1, 9, 1))),
    }
    for name in ("theta", "warm_start"):
        if isinstance(arguments.get(name), str):
            arguments[name] = named[arguments[name]]
    with pytest.raises(InvalidArgumentError, match=message):
        solver.solve(**arguments)


def test_float32_actions_may_touch_their_bounds() -> None:
    mpc = integrator(action_low=[-0.1], action_high=[0.1])
    touching = np.float32([0.1])  # 0.10000000149
    assert float(touching[0]) > 0.1
    assert IpoptSolver(mpc).solve([1.0], u0=touching).u0[0] == pytest.approx(0.1, abs=1e-12)


def test_which_problems_are_convex() -> None:
    assert is_convex(nominal_mpc(LINEAR))
    assert is_convex(integrator())
    assert not is_convex(nominal_mpc(PENDULUM))
    assert not is_convex(integrator(terminal_cost=NetworkCost.random(1, (3,), seed=0)))


def test_unbounded_inputs() -> None:
    solver = IpoptSolver(integrator(action_low=[-np.inf], action_high=[np.inf]))
    assert solver.solve([100.0]).u0[0] < -10
    assert solver.solve([100.0], u0=[-55.0]).u0[0] == -55.0


@pytest.mark.slow
def test_the_nominal_tasks_are_solved_at_their_horizons() -> None:
    for env_id in ENV_IDS:
        solver = IpoptSolver(nominal_mpc(env_id))
        assert solver.solve(random_states(env_id, 10)).success.all()
