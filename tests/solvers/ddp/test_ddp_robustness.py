"""The ddp solver on problems that are degenerate, extreme or hopeless: it ends, and claims nothing that is not so."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from mpc_problems import projected_gradient, random_linear, random_states, random_theta, residual_and_cost
from scipy.linalg import solve_discrete_are
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.envs import ENV_IDS
from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import DDPSolver, IpoptSolver, Plan, Solution


def honest(mpc: MPC, x: np.ndarray, solution: Solution, theta: np.ndarray | None = None) -> None:
    """Whatever is called a success is finite, obeys model and bounds, and costs what it says."""
    np.testing.assert_array_equal(solution.x[:, 0], x)
    good = solution.success
    if not good.any():
        return
    for array in (solution.value, solution.u, solution.x):
        assert np.isfinite(array[good]).all()
    error, cost = residual_and_cost(mpc, solution, theta)
    assert (error[good] < 1e-9).all()
    np.testing.assert_allclose(solution.value[good], cost[good], rtol=1e-9, atol=1e-9)
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    assert ((solution.u >= low) & (solution.u <= high)).all()


@pytest.mark.parametrize("nu", [1, 3])
def test_without_bounds_it_is_riccati(nu: int) -> None:
    """Infinite bounds, long horizon: the gain of scipy's discounted Riccati equation."""
    unbounded = np.full(nu, np.inf)
    mpc = random_linear(1, nu=nu, horizon=150, action_low=-unbounded, action_high=unbounded)
    A, B = (mpc.values[f"model.{name}"] * np.sqrt(mpc.discount) for name in "AB")
    W, R = mpc.values["stage_cost.W"], mpc.values["stage_cost.R"]
    P = solve_discrete_are(A, B, W, R)
    gain = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    x = 10.0 * np.random.default_rng(0).normal(size=(20, 4))
    solution = DDPSolver(mpc).solve(x)
    assert solution.success.all()
    np.testing.assert_allclose(solution.u0, x @ gain.T, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(solution.value, np.einsum("bi,ij,bj->b", x, P, x), rtol=1e-6)


def test_bounds_on_one_side_and_on_one_input() -> None:
    mpc = random_linear(2, nu=2, action_low=[-np.inf, -0.2], action_high=[0.3, np.inf])
    x = np.random.default_rng(0).normal(size=(12, 4))
    ours, theirs = DDPSolver(mpc).solve(x), IpoptSolver(mpc).solve(x)
    assert ours.success.all()
    np.testing.assert_allclose(ours.value, theirs.value, rtol=1e-6)
    honest(mpc, x, ours)


@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("horizon", [1, 2])
def test_short_horizons(env_id: str, horizon: int) -> None:
    mpc = nominal_mpc(env_id).replace(horizon=horizon)
    x = random_states(env_id, 20)
    ours, theirs = DDPSolver(mpc).solve(x), IpoptSolver(mpc).solve(x)
    assert ours.success.all()
    np.testing.assert_allclose(ours.value, theirs.value, rtol=1e-5, atol=1e-6)
    assert ours.x.shape == (20, horizon + 1, mpc.nx)


@pytest.mark.parametrize(
    "weights",
    [
        {"R": np.zeros((2, 2))},
        {"R": np.ones((2, 2))},  # singular: only the sum of the inputs costs
        {"W": np.zeros((4, 4))},
        {"W": np.zeros((4, 4)), "R": np.zeros((2, 2)), "T": np.zeros((4, 4))},  # nothing costs anything
        {"W": np.diag([1.0, 0.0, 0.0, 0.0]), "R": np.diag([1.0, 0.0]), "T": np.zeros((4, 4))},
        {"W": 1e12 * np.eye(4), "R": 1e-12 * np.eye(2)},
        {"W": 1e-12 * np.eye(4), "R": 1e-12 * np.eye(2), "T": np.zeros((4, 4))},
    ],
    ids=["R=0", "R singular", "W=0", "all zero", "both singular", "stiff", "tiny"],
)
def test_singular_weights(weights: dict[str, Any]) -> None:
    given = {"W": np.eye(4), "R": np.eye(2), "T": np.eye(4)} | weights
    for seed in range(4):
        mpc = random_linear(
            seed,
            nu=2,
            stage_cost=QuadraticCost(given["W"], given["R"]),
            terminal_cost=QuadraticCost(given["T"]),
        )
        x = np.random.default_rng(seed).normal(size=(10, 4))
        ours = DDPSolver(mpc).solve(x)
        assert ours.success.all()
        honest(mpc, x, ours)
        gradient = projected_gradient(mpc, ours)
        assert (gradient < 1e-3 * np.sqrt((1.0 + ours.value) * (1.0 + np.abs(given["W"]).max()))).all()


def test_an_input_without_effect() -> None:
    model = Model(lambda x, u, p: ca.vertcat(0.9 * x[0] + u[0], 0.5 * x[1]), 2, 2, 0.1, discrete=True)
    mpc = MPC(
        model=model,
        stage_cost=QuadraticCost(np.eye(2), np.diag([0.1, 0.0])),
        terminal_cost=QuadraticCost(np.eye(2)),
        horizon=5,
        discount=0.9,
        action_low=[-1.0, -1.0],
        action_high=[1.0, 1.0],
    )
    solution = DDPSolver(mpc).solve([[1.0, 1.0], [-3.0, 2.0]])
    assert solution.success.all()
    honest(mpc, np.array([[1.0, 1.0], [-3.0, 2.0]]), solution)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_do_not_matter(scale: float) -> None:
    """The same problem with inputs in other units has the same value and, rescaled, the same inputs."""
    plain = random_linear(4, nu=2)
    A, B = plain.values["model.A"], plain.values["model.B"]
    scaled = random_linear(
        4,
        nu=2,
        model=Model(lambda x, u, p: p["A"] @ x + p["B"] @ u, 4, 2, 0.1, {"A": A, "B": B / scale}, discrete=True),
        stage_cost=QuadraticCost(plain.values["stage_cost.W"], plain.values["stage_cost.R"] / scale**2),
        action_low=np.asarray(plain.action_low) * scale,
        action_high=np.asarray(plain.action_high) * scale,
    )
    x = np.random.default_rng(0).normal(size=(10, 4))
    one, other = DDPSolver(plain).solve(x), DDPSolver(scaled).solve(x)
    assert other.success.all()
    np.testing.assert_allclose(other.value, one.value, rtol=1e-8)
    np.testing.assert_allclose(other.u0 / scale, one.u0, rtol=0, atol=1e-4)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_far_out_states(env_id: str) -> None:
    """Nothing crashes or hangs, no NaN is a success, and what is called a success is one."""
    mpc = nominal_mpc(env_id)
    solver = DDPSolver(mpc)
    for size in (1e1, 1e3, 1e6, 1e100, 1e300):
        x = size * np.random.default_rng(0).normal(size=(20, mpc.nx))
        solution = solver.solve(x)
        honest(mpc, x, solution)
        assert (solution.stats["iterations"] <= 8 * 200).all()
        solver.solve(x, warm_start=solution.plan)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ENV_IDS)
def test_ten_thousand_random_problems(env_id: str) -> None:
    """Random theta with full weights, models of alpha 1.5, states of which some are far out: 1e4 in the three tasks."""
    mpcs = [nominal_mpc(env_id) if env_id == LINEAR else nominal_mpc(env_id, alpha=1.5, seed=s) for s in range(5)]
    solver = DDPSolver(mpcs[0], max_iterations=100, n_starts=4)
    rng = np.random.default_rng(0)
    solved = []
    for seed in range(34):
        theta = random_theta(mpcs[seed % 5], seed, spread=1.0)
        x = random_states(env_id, 100, seed, speed=8.0)
        x[90:] += 30.0 * rng.normal(size=(10, mpcs[0].nx))
        solution = solver.solve(x, theta)
        honest(solver.mpc, x, solution, theta)
        solved.append(solution.success[:90].mean())
    assert np.mean(solved) > 0.9  # Gauss-Newton creeps on some of the worst models


def test_a_model_with_strong_curvature() -> None:
    """Gauss-Newton creeps where the input acts through its curvature only: it ends, and is honest."""

    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return ca.vertcat(x[0] + 0.3 * u[0], ca.sin(3.0 * x[0]) * ca.cos(u[0]))

    mpc = MPC(
        model=Model(ode, 2, 1, 0.1),
        stage_cost=QuadraticCost(np.diag([0.0, 1.0]), [[0.01]], x_ref=[0.0, 1.0]),
        terminal_cost=QuadraticCost(np.diag([0.0, 1.0])),
        horizon=15,
        discount=1.0,
        action_low=[-2.0],
        action_high=[2.0],
    )
    x = np.random.default_rng(0).normal(size=(40, 2))
    solution = DDPSolver(mpc).solve(x)
    honest(mpc, x, solution)
    assert (projected_gradient(mpc, solution)[solution.success] < 1e-4).all()
    assert solution.success.mean() > 0.4


def test_a_model_that_blows_up() -> None:
    """x+ = x^3 + u overflows from most states: no success there, and no crash."""
    model = Model(lambda x, u, p: x**3 + u, 1, 1, 0.1, discrete=True)
    mpc = MPC(model, QuadraticCost([[1.0]], [[1.0]]), QuadraticCost([[1.0]]), 30, 1.0, [-0.5], [0.5])
    x = np.array([[0.1], [1.2], [5.0], [-100.0]])
    solution = DDPSolver(mpc).solve(x)
    honest(mpc, x, solution)
    assert solution.success[0]
    assert not solution.success[3]
    assert not np.isnan(DDPSolver(mpc).value(x)).any()


def test_a_state_that_overflows_unseen_is_no_success() -> None:
    """Nothing costs the second state, which runs away: the value is finite, the trajectory is not."""
    model = Model(lambda x, u, p: ca.vertcat(0.5 * x[0] + u[0], x[1] ** 2), 2, 1, 0.1, discrete=True)
    cost = QuadraticCost(np.diag([1.0, 0.0]), [[1.0]])
    mpc = MPC(model, cost, QuadraticCost(np.diag([1.0, 0.0])), 30, 1.0, [-1.0], [1.0])
    solution = DDPSolver(mpc).solve([[1.0, 0.5], [1.0, 3.0]])
    assert solution.success.tolist() == [True, False]


def test_iterations_are_bounded_and_said() -> None:
    mpc = nominal_mpc(CARTPOLE)
    x = random_states(CARTPOLE, 10)
    solution = DDPSolver(mpc, max_iterations=2).solve(x)
    assert (solution.stats["iterations"] <= 2 * (16 + 4 + 1)).all()  # starts, the best of them, a plan that stays
    assert "iteration limit" in solution.status
    honest(mpc, x, solution)


@pytest.mark.parametrize(
    ("options", "name"),
    [({"max_iterations": 0}, "max_iterations"), ({"n_threads": 0}, "n_threads"), ({"n_starts": 65}, "n_starts")],
)
def test_bad_options_are_refused(options: dict[str, int], name: str) -> None:
    with pytest.raises(InvalidArgumentError, match=name):
        DDPSolver(nominal_mpc(PENDULUM), **options)


@pytest.mark.parametrize("limit", [6, 10, 16])
def test_what_the_iteration_limit_accepts_is_solved(limit: int) -> None:
    """Going on from there changes value and input by next to nothing."""
    mpc = nominal_mpc(CARTPOLE)
    x = random_states(CARTPOLE, 200, limit)
    early, solver = DDPSolver(mpc, max_iterations=limit).solve(x), DDPSolver(mpc)
    good = early.success
    assert 0.1 < good.mean() < 0.99
    longer = solver.solve(x[good], warm_start=Plan(early.x[good], early.u[good]))
    assert longer.success.all()
    assert (np.abs(early.value[good] - longer.value) < 1e-6 * (1.0 + np.abs(longer.value))).all()
    np.testing.assert_allclose(early.u0[good], longer.u0, rtol=0, atol=1e-3)
