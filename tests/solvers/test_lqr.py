"""The lqr solver against scipy's Riccati equation, ipopt, and its own first-order conditions."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from riccati import optimum
from scipy.optimize import minimize

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.envs.linear_tracking import ACTION_WEIGHT, STATE_WEIGHT, plant_matrices
from mpcoffline.mpc import MPC, Constraint, Model, NormCost, QuadraticCost
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import IpoptSolver, LQRSolver, Plan

Array = NDArray[np.float64]
DISCOUNT = 0.9


def linear_mpc(alpha: float = 0.0, **changes: Any) -> MPC:
    """Linear tracking with the plant's matrices at alpha and a quadratic terminal cost: V* unless changed."""
    A, B = plant_matrices(alpha)
    best = optimum(A, B, STATE_WEIGHT, ACTION_WEIGHT, DISCOUNT)
    base = nominal_mpc("mpcoffline/LinearTracking-v0")
    values = {"model.A": A, "model.B": B}
    mpc = base.with_theta(base.space.pack(values))
    return mpc.replace(**({"terminal_cost": QuadraticCost(best.P)} | changes))


def random_mpc(seed: int, bound: float = np.inf, **changes: Any) -> MPC:
    """An affine model and full costs with cross terms, references and constants, drawn at random."""
    rng = np.random.default_rng(seed)
    nx, nu = int(rng.integers(1, 5)), int(rng.integers(1, 4))
    A, B, c = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu)), rng.normal(size=nx)
    A *= 1.1 / np.abs(np.linalg.eigvals(A)).max()
    root = rng.normal(size=(nx + nu, nx + nu))
    H = root @ root.T + 0.1 * np.eye(nx + nu)
    last = rng.normal(size=(nx, nx))
    arguments: dict[str, Any] = {
        "model": Model(
            lambda x, u, p: p["A"] @ x + p["B"] @ u + p["c"], nx, nu, 0.1, {"A": A, "B": B, "c": c}, discrete=True
        ),
        "stage_cost": QuadraticCost(
            H[:nx, :nx], H[nx:, nx:], H[:nx, nx:], x_ref=rng.normal(size=nx), u_ref=rng.normal(size=nu), constant=0.3
        ),
        "terminal_cost": QuadraticCost(last @ last.T, x_ref=rng.normal(size=nx), constant=-0.2),
        "horizon": int(rng.integers(1, 13)),
        "discount": float(rng.uniform(0.5, 1.0)),
        "action_low": np.full(nu, -bound),
        "action_high": np.full(nu, bound),
    }
    return MPC(**(arguments | changes))


def rollout_cost(mpc: MPC, x: Array, inputs: Array) -> float:
    """The objective of (MPC) by calling its functions one after the other."""
    total, weight = 0.0, 1.0
    for u in inputs:
        total += weight * float(mpc.stage_function(x, u, mpc.theta))
        x = mpc.dynamics_function(x, u, mpc.theta).full().ravel()
        weight *= mpc.discount
    return total + weight * float(mpc.terminal_function(x, mpc.theta))


@cache
def oracle(mpc: MPC) -> IpoptSolver:
    return IpoptSolver(mpc, tolerance=1e-12)


# ---------------------------------------------------------------- without active bounds


@pytest.mark.parametrize("alpha", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("horizon", [1, 7, 100])
def test_the_riccati_equation_of_scipy(alpha: float, horizon: int) -> None:
    """With T = V* every horizon has the value, the action values and the gain of the infinite one."""
    A, B = plant_matrices(alpha)
    best = optimum(A, B, STATE_WEIGHT, ACTION_WEIGHT, DISCOUNT)
    solver = LQRSolver(linear_mpc(alpha, horizon=horizon))
    rng = np.random.default_rng(0)
    s, a = rng.uniform(-0.3, 0.3, size=(50, 4)), rng.uniform(-4, 4, size=(50, 2))
    solution = solver.solve(s)
    assert solution.success.all()
    assert set(solution.words) == {"Riccati"}
    np.testing.assert_allclose(solution.value, np.einsum("bi,ij,bj->b", s, best.P, s), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(solution.u0, s @ best.K.T, rtol=0, atol=1e-9)
    z = np.hstack([s, a])
    inside = np.abs(solver.solve(s, u0=a).u[:, 1:]).max(axis=(1, 2), initial=0.0) < 10.0
    assert inside.sum() > 20
    q = np.einsum("bi,ij,bj->b", z, best.Q, z)
    np.testing.assert_allclose(solver.q_value(s, a)[inside], q[inside], rtol=1e-9, atol=1e-9)


def test_a_long_horizon_forgets_its_end() -> None:
    """N = 400 with another terminal cost still has the infinite horizon's value."""
    A, B = plant_matrices(1.0)
    best = optimum(A, B, STATE_WEIGHT, ACTION_WEIGHT, DISCOUNT)
    solver = LQRSolver(linear_mpc(1.0, terminal_cost=QuadraticCost(np.eye(4)), horizon=400))
    s = np.random.default_rng(0).uniform(-1, 1, size=(20, 4))
    np.testing.assert_allclose(solver.value(s), np.einsum("bi,ij,bj->b", s, best.P, s), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_affine_models_and_full_costs_against_ipopt(seed: int) -> None:
    mpc = random_mpc(seed)
    x = np.random.default_rng(seed).normal(size=(3, mpc.nx))
    u = np.random.default_rng(seed).normal(size=(3, mpc.nu))
    solver = LQRSolver(mpc)
    for imposed in (None, u):
        exact, found = solver.solve(x, u0=imposed), oracle(mpc).solve(x, u0=imposed)
        assert exact.success.all()
        assert (exact.stats["residual"] < 1e-12).all()
        np.testing.assert_allclose(exact.value, found.value, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(exact.u, found.u, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(mpc.model(exact.x[:, :-1], exact.u), exact.x[:, 1:], rtol=1e-10, atol=1e-10)
        costs = [rollout_cost(mpc, *row) for row in zip(x, exact.u, strict=True)]
        np.testing.assert_allclose(exact.value, costs, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(solver.solve(x, u0=u).u0, u)


# ---------------------------------------------------------------- active bounds


@pytest.mark.parametrize("seed", range(8))
def test_active_bounds_against_ipopt(seed: int) -> None:
    mpc = random_mpc(seed, bound=0.4)
    x = 2.0 * np.random.default_rng(seed).normal(size=(3, mpc.nx))
    u = np.random.default_rng(seed).uniform(-0.4, 0.4, size=(3, mpc.nu))
    solver = LQRSolver(mpc)
    for imposed in (None, u):
        exact, found = solver.solve(x, u0=imposed), oracle(mpc).solve(x, u0=imposed)
        assert exact.success.all()
        assert (exact.stats["residual"] < 1e-10).all()
        assert np.abs(exact.u).max() <= 0.4
        np.testing.assert_allclose(exact.value, found.value, rtol=1e-10, atol=1e-10)
        assert (exact.value <= found.value + 1e-9 * (1.0 + np.abs(found.value))).all()
        costs = [rollout_cost(mpc, *row) for row in zip(x, exact.u, strict=True)]
        np.testing.assert_allclose(exact.value, costs, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("alpha", [0.0, 2.0])
def test_horizon_100_with_active_bounds(alpha: float) -> None:
    mpc = linear_mpc(alpha)
    x = np.random.default_rng(0).uniform(-6, 6, size=(5, 4))
    exact, found = LQRSolver(mpc).solve(x), oracle(mpc).solve(x)
    assert exact.success.all()
    assert "QP" in exact.words
    assert (exact.stats["residual"] < 1e-10).all()
    assert np.abs(exact.u).max() == 10.0
    np.testing.assert_allclose(exact.value, found.value, rtol=1e-10)
    np.testing.assert_allclose(exact.u0, found.u0, rtol=0, atol=1e-6)


def test_active_bounds_against_projected_gradients_of_scipy() -> None:
    mpc = random_mpc(3, bound=0.3, horizon=6)
    state, shape = np.full(mpc.nx, 1.5), (6, mpc.nu)
    found = minimize(
        lambda v: rollout_cost(mpc, state, v.reshape(shape)),
        np.zeros(6 * mpc.nu),
        method="L-BFGS-B",
        bounds=[(-0.3, 0.3)] * (6 * mpc.nu),
        options={"ftol": 1e-15, "gtol": 1e-10, "maxiter": 1000},
    )
    assert float(LQRSolver(mpc).value(state)) == pytest.approx(found.fun, rel=1e-7)


def test_one_sided_bounds() -> None:
    mpc = random_mpc(1, action_low=np.full(random_mpc(1).nu, -0.1))
    x = np.random.default_rng(1).normal(size=(4, mpc.nx))
    exact = LQRSolver(mpc).solve(x)
    assert exact.success.all()
    assert exact.u.min() == -0.1
    np.testing.assert_allclose(exact.value, oracle(mpc).value(x), rtol=1e-10, atol=1e-10)


def test_warm_starts_change_nothing_but_the_iterations() -> None:
    mpc = linear_mpc()
    solver = LQRSolver(mpc)
    x = np.random.default_rng(0).uniform(-6, 6, size=(10, 4))
    cold = solver.solve(x)
    warm = solver.solve(x, warm_start=cold)
    np.testing.assert_allclose(warm.u, cold.u, rtol=0, atol=1e-10)
    assert warm.stats["iterations"].sum() < cold.stats["iterations"].sum()
    misled = solver.solve(x, warm_start=Plan(np.zeros_like(cold.x), np.full_like(cold.u, 10.0)))
    assert misled.success.all()
    np.testing.assert_allclose(misled.u, cold.u, rtol=0, atol=1e-10)
    again = solver.solve(x)  # nothing hidden is kept
    np.testing.assert_array_equal(again.u, cold.u)
    np.testing.assert_array_equal(again.stats["iterations"], cold.stats["iterations"])


# ---------------------------------------------------------------- the protocol


def test_a_batch_equals_one_by_one() -> None:
    solver = LQRSolver(linear_mpc())
    x = np.random.default_rng(0).uniform(-2, 2, size=(6, 4))
    batch = solver.solve(x)
    assert {"QP", "Riccati"} == set(batch.words)
    for k in range(6):
        one = solver.solve(x[k])
        assert one.u0.shape == (2,)
        for name in ("u0", "x", "u", "value", "success"):
            np.testing.assert_allclose(getattr(one, name), getattr(batch, name)[k], rtol=0, atol=1e-11)
    np.testing.assert_array_equal(batch.x[:, 0], x)


def test_theta_is_an_argument_and_cached() -> None:
    mpc = random_mpc(0, bound=0.5)
    solver = LQRSolver(mpc, cache_size=2)
    rng = np.random.default_rng(0)
    x = rng.normal(size=(4, mpc.nx))
    thetas = mpc.theta + 0.05 * rng.normal(size=(4, mpc.space.size))
    expected = [float(LQRSolver(mpc.with_theta(theta)).value(x[i])) for i, theta in enumerate(thetas)]
    for _ in range(2):
        found = [float(solver.value(x[i], theta)) for i, theta in enumerate(thetas)]
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_allclose(solver.value(x, thetas), expected, rtol=1e-12)  # one theta a problem


def test_a_moving_reference_against_ipopt() -> None:
    mpc = random_mpc(5, bound=0.5, horizon=6)
    rng = np.random.default_rng(0)
    theta = mpc.theta_along(
        {
            "stage_cost.x_ref": rng.normal(size=(6, mpc.nx)),
            "stage_cost.u_ref": rng.normal(size=(6, mpc.nu)),
            "model.A": mpc.values["model.A"] * rng.uniform(0.5, 1.0, size=(6, 1, 1)),
        }
    )
    x = rng.normal(size=(3, mpc.nx))
    u = rng.uniform(-0.5, 0.5, size=(3, mpc.nu))
    solver = LQRSolver(mpc)
    for imposed in (None, u):
        exact, found = solver.solve(x, theta, imposed), oracle(mpc).solve(x, theta, imposed)
        assert exact.success.all()
        np.testing.assert_allclose(exact.value, found.value, rtol=1e-10, atol=1e-10)
    assert (np.abs(solver.value(x, theta) - solver.value(x)) > 1e-3).all()


# ---------------------------------------------------------------- what does not fit


@pytest.mark.parametrize(
    ("mpc", "message"),
    [
        (nominal_mpc("mpcoffline/PendulumSwingUp-v0"), "got a model that is not affine"),
        (nominal_mpc("mpcoffline/LinearTracking-v0"), r"got a terminal cost that is not quadratic \(NormCost\)"),
        (random_mpc(0, constraints=Constraint(lambda x, u, p: x[0] - 1.0)), "got constraints other than input bounds"),
        (linear_mpc(terminal_cost=NormCost(np.zeros(4))), "terminal cost that is not quadratic"),
    ],
)
def test_other_problems_are_refused(mpc: MPC, message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        LQRSolver(mpc)


def test_a_bilinear_model_is_refused() -> None:
    model = Model(lambda x, u, p: x + x * u, 1, 1, 1.0, discrete=True)
    mpc = MPC(model, QuadraticCost([[1.0]], [[1.0]]), QuadraticCost([[1.0]]), 3, 0.9, [-1.0], [1.0])
    with pytest.raises(InvalidArgumentError, match="not affine"):
        LQRSolver(mpc)


def test_inputs_without_cost_or_effect_are_passed_to_ipopt() -> None:
    """The second input neither costs nor acts: any value is optimal, and the Hessian is singular."""
    model = Model(lambda x, u, p: x + u[0], 1, 2, 1.0, discrete=True)
    mpc = MPC(model, QuadraticCost([[1.0]]), QuadraticCost([[1.0]]), 3, 0.9, [-1.0] * 2, [1.0] * 2)
    solution = LQRSolver(mpc).solve([0.5])
    assert solution.success
    assert "ipopt" in solution.words[0]
    assert solution.value == pytest.approx(0.25, abs=1e-6)


def test_inputs_without_cost() -> None:
    """R = 0: deadbeat, as far as the bounds allow."""
    model = Model(lambda x, u, p: x + u, 1, 1, 1.0, discrete=True)
    mpc = MPC(model, QuadraticCost([[1.0]]), QuadraticCost([[1.0]]), 3, 1.0, [-1.0], [1.0])
    solution = LQRSolver(mpc).solve([[0.5], [2.5]])
    assert solution.success.all()
    np.testing.assert_allclose(solution.u[..., 0], [[-0.5, 0, 0], [-1, -1, -0.5]], atol=1e-12)
    np.testing.assert_allclose(solution.value, [0.25, 2.5**2 + 1.5**2 + 0.5**2], rtol=1e-12)


def test_a_cost_that_is_not_convex_is_not_called_solved_by_riccati() -> None:
    class Saddle(QuadraticCost):
        def expression(self, x: ca.SX, u: ca.SX, p: Any) -> ca.SX:
            return ca.sumsqr(x) - 3.0 * ca.sumsqr(u)

    model = Model(lambda x, u, p: x + u, 1, 1, 1.0, discrete=True)
    mpc = MPC(model, Saddle([[1.0]], [[1.0]]), QuadraticCost([[1.0]]), 2, 0.9, [-1.0], [1.0])
    solution = LQRSolver(mpc).solve([[0.5]])
    assert solution.words[0].startswith("ipopt")
    if solution.success[0]:  # a vertex of the box
        np.testing.assert_allclose(np.abs(solution.u), 1.0, atol=1e-6)


@pytest.mark.parametrize("x", [[1e6, 0, 0, 0], [1e3, -1e3, 1e3, 1e3]])
def test_far_out_states(x: list[float]) -> None:
    """All bounds active: an honest answer, whichever it is."""
    solution = LQRSolver(linear_mpc(2.0)).solve(x)
    assert np.abs(solution.u).max() <= 10.0
    assert solution.success
    assert np.isfinite(solution.value)


@pytest.mark.parametrize("seed", [42, 47, 56])
def test_unstable_models_with_saturated_inputs(seed: int) -> None:
    """The states grow by 1.65^40: trajectory and value must be those of the inputs all the same."""
    mpc = random_mpc(seed, bound=0.05, horizon=40)
    mpc = mpc.with_theta(mpc.space.pack({"model.A": 1.5 * mpc.values["model.A"]}))
    x = 1e3 * np.random.default_rng(seed).normal(size=(2, mpc.nx))
    solution = LQRSolver(mpc).solve(x)
    assert solution.success.any()
    costs = [rollout_cost(mpc, *row) for row in zip(x, solution.u, strict=True)]
    np.testing.assert_allclose(solution.value, costs, rtol=1e-9)
    # No other corner or point of the box is better, as far as a random search sees.
    rng = np.random.default_rng(0)
    for state, u, value, success in zip(x, solution.u, solution.value, solution.success, strict=True):
        for scale in (1e-3, 0.1, 1.0):
            other = np.clip(u + scale * 0.05 * rng.normal(size=u.shape), -0.05, 0.05)
            assert not success or rollout_cost(mpc, state, other) >= value - 1e-9 * abs(value)
