"""The exact value of a linear-quadratic MPC, against Bellman's equation, rollouts and other libraries."""

from __future__ import annotations

import casadi as ca
import lq_plant
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from lq_plant import BEST, DISCOUNT
from numpy.typing import NDArray

from mpcoffline import MPC, Model, NormCost, OfflineMPCLearner, QuadraticCost
from mpcoffline.learning.linear_quadratic import is_linear_quadratic, riccati_cost
from mpcoffline.plants.nominal import nominal_mpc

Array = NDArray[np.float64]


def affine_mpc(seed: int = 0, nx: int = 3, nu: int = 2, discount: float = 0.9) -> MPC:
    """A random affine model and a convex quadratic cost around somewhere else."""
    rng = np.random.default_rng(seed)
    parts = {"A": rng.normal(size=(nx, nx)) / np.sqrt(nx), "B": rng.normal(size=(nx, nu)), "c": rng.normal(size=nx)}
    factor = rng.normal(size=(nx + nu, nx + nu))
    H = factor @ factor.T
    cost = QuadraticCost(
        H[:nx, :nx], H[nx:, nx:], H[:nx, nx:], x_ref=rng.normal(size=nx), u_ref=rng.normal(size=nu), constant=-3.0
    )
    model = Model(lambda x, u, p: p["A"] @ x + p["B"] @ u + p["c"], nx, nu, 0.1, parts, discrete=True)
    return MPC(model, cost, NormCost(np.zeros(nx)), 5, discount, [-np.inf] * nu, [np.inf] * nu)


def value(cost: QuadraticCost, x: Array) -> Array:
    e = x - cost.values["x_ref"]
    return np.asarray(np.einsum("bi,ij,bj->b", e, cost.W, e) + cost.values["constant"])


@given(seed=st.integers(0, 10_000), discount=st.sampled_from([0.5, 0.9, 0.99]))
@settings(max_examples=20, deadline=None)
def test_it_solves_bellmans_equation(seed: int, discount: float) -> None:
    """min over a of Lhat + gamma V(f), taken numerically, is V."""
    mpc = affine_mpc(seed, discount=discount)
    V = riccati_cost(mpc)
    assert V is not None
    rng = np.random.default_rng(seed)
    u = ca.SX.sym("u", mpc.nu)
    for x in rng.normal(size=(3, mpc.nx)):
        e = mpc.dynamics_function(x, u, mpc.theta) - V.values["x_ref"]
        q = mpc.stage_function(x, u, mpc.theta) + discount * (e.T @ V.W @ e + float(V.values["constant"]))
        H, g = ca.hessian(q, u)
        best = np.linalg.solve(ca.evalf(H).full(), -ca.Function("g", [u], [g])(np.zeros(mpc.nu)).full().ravel())
        least = float(ca.Function("q", [u], [q])(best))
        assert least == pytest.approx(
            float(value(V, x[None])[0]), rel=1e-8, abs=1e-8 * abs(float(V.values["constant"]))
        )


def test_around_zero_it_is_the_riccati_solution() -> None:
    mpc = lq_plant.make_mpc()
    exact = mpc.with_values({"model.A": lq_plant.A, "model.B": lq_plant.B})
    exact = exact.with_values({"stage_cost.W": lq_plant.W, "stage_cost.R": lq_plant.R})
    V = riccati_cost(exact)
    assert V is not None
    assert exact.discount == DISCOUNT
    np.testing.assert_allclose(V.W, BEST.P, rtol=1e-9)
    np.testing.assert_allclose(V.values["x_ref"], 0.0, atol=1e-12)


@pytest.mark.parametrize("powers", [(0, 20), (-20, 20)])
def test_units_do_not_matter(powers: tuple[int, int]) -> None:
    """States in other units, a cost that ignores one of them."""
    d = np.diag([2.0 ** powers[0], 2.0 ** powers[1]])
    inverse = np.linalg.inv(d)

    def cost_in(d: Array, inverse: Array) -> QuadraticCost:
        A, B = d @ np.array([[0.9, 0.0], [0.5, 0.5]]) @ inverse, d @ np.array([[1.0], [0.0]])
        W = inverse @ np.diag([1.0, 0.0]) @ inverse
        model = Model(lambda x, u, p: p["A"] @ x + p["B"] @ u, 2, 1, 0.1, {"A": A, "B": B}, discrete=True)
        V = riccati_cost(MPC(model, QuadraticCost(W, [[0.1]]), NormCost([0.0, 0.0]), 5, 0.9, [-1.0], [1.0]))
        assert V is not None
        return V

    expected = cost_in(np.eye(2), np.eye(2)).W
    np.testing.assert_allclose(d @ cost_in(d, inverse).W @ d, expected, rtol=1e-9, atol=1e-9 * expected.max())


def test_other_problems_have_none() -> None:
    assert riccati_cost(nominal_mpc("mpcoffline/PendulumSwingUp-v0")) is None
    mpc = affine_mpc()
    assert is_linear_quadratic(mpc)
    assert not is_linear_quadratic(mpc.replace(constraints=lambda x, u, p: x[0] - 1.0))
    lost = Model(lambda x, u, p: ca.vertcat(1.5 * x[0], u[0]), 2, 1, 0.1, discrete=True)  # no input holds x_0
    problem = MPC(lost, QuadraticCost(np.eye(2), [[1.0]]), NormCost([0.0, 0.0]), 5, 0.9, [-1.0], [1.0])
    assert riccati_cost(problem) is None
    free = MPC(lost, QuadraticCost(np.zeros((2, 2)), [[0.0]]), NormCost([0.0, 0.0]), 5, 0.9, [-1.0], [1.0])
    assert riccati_cost(free) is None


def test_the_default_fit_of_a_linear_plant_is_its_optimum() -> None:
    """Model and cost are found, the terminal cost is exact: so is the gain, from any preset's horizon."""
    rng = np.random.default_rng(0)
    table = lq_plant.logged(lq_plant.float32_uniform(rng, 600, 2), lq_plant.float32_uniform(rng, 600, 1))
    learner = OfflineMPCLearner(lq_plant.make_mpc(), seed=0, value_n_steps=100, hidden=(8,), trim=1.0, prior=0.0)
    learner.fit(table, show_progress=False)
    assert isinstance(learner.mpc.terminal_cost, QuadraticCost)
    np.testing.assert_allclose(learner.mpc.terminal_cost.W, BEST.P, rtol=2e-2, atol=1e-3)
