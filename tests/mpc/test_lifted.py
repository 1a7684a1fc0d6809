"""Quadratic costs in features, against plain numpy; (FIT) finds their weights."""

from __future__ import annotations

import json
import math
from typing import Any

import casadi as ca
import lq_plant
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from lq_plant import QuadraticValue
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.datasets import TransitionTable
from mpcoffline.learning import ParameterConfig, fit_parameters
from mpcoffline.mpc import MPC, LiftedCost, Model, NormCost, QuadraticCost, polynomial_features
from mpcoffline.mpc.component import cost_from_json
from mpcoffline.mpc.torch_twin import TorchTwin
from mpcoffline.solvers import make_solver

Array = NDArray[np.float64]


def squares(x: Any) -> Any:
    """x1, x2, x1^2, x1 x2, x2^2, by CasADi."""
    return ca.vertcat(x[0], x[1], x[0] ** 2, x[0] * x[1], x[1] ** 2)


def squares_of(x: Array) -> Array:
    """The same by numpy, of each row."""
    return np.stack([x[:, 0], x[:, 1], x[:, 0] ** 2, x[:, 0] * x[:, 1], x[:, 1] ** 2], axis=1)


def functions(cost: Any, nx: int, nu: int) -> tuple[ca.Function, ca.Function]:
    """The cost as stage and as terminal cost."""
    x, u, theta = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("theta", cost.space.size)
    p = cost.space.symbols(theta)
    stage = ca.Function("L", [x, u, theta], [cost.expression(x, u, p)])
    return stage, ca.Function("T", [x, theta], [cost.terminal_expression(x, p)])


@settings(max_examples=30)
@given(st.booleans(), st.integers(0, 2**31))
def test_quadratic_form_of_the_features(cross: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(6, 6))
    H, x_ref, u_ref = G @ G.T, rng.normal(size=2), rng.normal(size=1)
    S = H[:5, 5:] if cross else np.zeros((5, 1))
    cost = LiftedCost(squares, x_ref, H[:5, :5], H[5:, 5:], S if cross else None, u_ref, constant=0.3)
    for found, expected in ((cost.W, H[:5, :5]), (cost.R, H[5:, 5:]), (cost.S, S)):
        np.testing.assert_allclose(found, expected, atol=1e-12 * H.max())
    x, u = rng.normal(size=(5, 2)), rng.normal(size=(5, 1))
    e, v = squares_of(x) - squares_of(x_ref[None]), u - u_ref
    terminal = np.einsum("bi,ij,bj->b", e, cost.W, e) + 0.3
    stage = terminal + 2 * np.einsum("bi,ij,bj->b", e, S, v) + H[5, 5] * v[:, 0] ** 2
    L, T = functions(cost, 2, 1)
    np.testing.assert_allclose(L(x.T, u.T, cost.space.theta).full().ravel(), stage, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(T(x.T, cost.space.theta).full().ravel(), terminal, rtol=1e-9, atol=1e-9)
    twin = TorchTwin(L)(*(torch.from_numpy(array) for array in (x, u, cost.space.theta)))
    np.testing.assert_allclose(twin.numpy().ravel(), stage, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("nx", "degree"), [(1, 1), (1, 4), (3, 2), (2, 3), (5, 2)])
def test_polynomial_features_are_all_monomials(nx: int, degree: int) -> None:
    x = ca.SX.sym("x", nx)
    phi = ca.Function("phi", [x], [polynomial_features(nx, degree)(x)])
    assert phi.numel_out(0) == math.comb(nx + degree, degree) - 1
    point = np.array([2.0, 3.0, 5.0, 7.0, 11.0])[:nx]  # of primes, each monomial has a value of its own
    values = phi(point).full().ravel()
    np.testing.assert_array_equal(values[:nx], point)
    assert len(set(values)) == len(values)
    with pytest.raises(InvalidArgumentError, match="degree: expected a positive integer, got 0"):
        polynomial_features(nx, 0)


@pytest.mark.parametrize(
    "cost",
    [
        QuadraticCost(np.diag([2.0, 1.0]), x_ref=[0.3, 0.0]),
        QuadraticCost(np.diag([2.0, 1.0]), [[0.5]], x_ref=[0.3, 0.0], u_ref=[0.7], constant=0.2),
        QuadraticCost(np.diag([2.0, 1.0]), [[0.5]], [[0.1], [0.3]], x_ref=[0.3, 0.0], constant=0.2),
    ],
    ids=["W", "WR", "H"],
)
def test_a_lifted_quadratic_cost_has_its_values(cost: QuadraticCost) -> None:
    lifted = LiftedCost.of(cost, polynomial_features(2))
    assert [block.name for block in lifted.space] == [block.name for block in cost.space]
    x, u = np.random.default_rng(0).normal(size=(2, 9)), np.ones((1, 9))
    for f, g in zip(functions(lifted, 2, 1), functions(cost, 2, 1), strict=True):
        arguments = (x, u)[: f.n_in() - 1]
        expected = g(*arguments, cost.space.theta).full()
        np.testing.assert_allclose(f(*arguments, lifted.space.theta).full(), expected, rtol=1e-12)


def test_json_roundtrip_bit_for_bit() -> None:
    cost = LiftedCost.of(QuadraticCost(np.eye(2), [[1.0]], x_ref=[0.1, 0.2]), polynomial_features(2, 3))
    data = json.loads(json.dumps(cost.to_json()))
    again = cost_from_json(data)
    assert isinstance(again, LiftedCost)
    assert again.to_json() == cost.to_json()
    values = [float(functions(c, 2, 1)[0]([0.3, -0.4], 0.5, c.space.theta)) for c in (again, cost)]
    assert values[0] == values[1]
    with pytest.raises(FileFormatError, match="features"):
        cost_from_json(data | {"features": data["features"] | {"output": 3}})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"W": np.eye(2)}, "W: expected a row for each of 5 features, got 2 rows"),
        ({"W": -np.eye(5)}, "W: expected a positive semidefinite matrix"),
        ({"x_ref": [0.0], "W": np.eye(5)}, "features: expected a function of CasADi SX expressions of 1 states"),
        ({"features": lambda x: ca.vertcat(math.sin(x[0]), x[1]), "W": np.eye(2)}, "features: expected a function"),
        ({"features": lambda x: math.sqrt(x), "W": np.eye(2)}, "features: expected a function of CasADi SX"),
    ],
)
def test_lifted_cost_refuses(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        LiftedCost(**({"features": squares, "x_ref": [0.0, 0.0]} | arguments))


def test_only_features_that_begin_with_the_state_hold_any_quadratic_cost() -> None:
    with pytest.raises(InvalidArgumentError, match="features: expected x as the first 2"):
        LiftedCost.of(QuadraticCost(np.eye(2)), lambda x: ca.vertcat(x[1], x[0]))


def problem(stage_cost: Any) -> MPC:
    model = Model(lambda x, u, p: lq_plant.A @ x + lq_plant.B @ u, nx=2, nu=1, dt=0.1, discrete=True)
    return MPC(model, stage_cost, NormCost([0.0, 0.0]), 3, 0.9, [-1.0], [1.0])


def test_fit_recovers_the_weights() -> None:
    """With V = 0, (FIT) is plain regression of the logged cost, which the features hold exactly."""
    rng = np.random.default_rng(0)
    x, u = (lq_plant.float32_uniform(rng, 2_000, n) for n in (2, 1))
    x_ref = np.array([0.5, 0.0])
    costs = 2.0 * (x[:, 0] ** 2 - 0.25) ** 2 + x[:, 1] ** 2 + 0.5 * u[:, 0] ** 2 + 0.3
    table = TransitionTable.from_arrays(x, u, costs, x, np.zeros(len(x)))
    mpc = problem(LiftedCost.of(QuadraticCost(np.eye(2), [[1.0]], x_ref=x_ref), polynomial_features(2)))
    result = fit_parameters(
        mpc, QuadraticValue(np.zeros((2, 2))), table, ("cost",), ParameterConfig(prior=1e-9), seed=0
    )
    assert result.loss_after < 1e-5 * result.loss_before
    fitted = mpc.with_theta(result.theta).stage_cost
    L = functions(fitted, 2, 1)[0]
    np.testing.assert_allclose(L(x.T, u.T, fitted.space.theta).full().ravel(), costs, atol=0.01)
    np.testing.assert_allclose(fitted.R, [[0.5]], atol=0.01)


@pytest.mark.slow
def test_ipopt_and_ddp_agree() -> None:
    cost = LiftedCost.of(QuadraticCost(np.eye(2), [[0.1]], x_ref=[0.5, 0.0]), polynomial_features(2))
    weights = np.diag([0.0, 0.5, 2.0, 0.3, 0.1])  # two minima over x: 0.5 and -0.5
    mpc = problem(cost.with_theta(cost.space.pack({"W": weights})))
    x = np.array([[0.8, 0.1], [-0.2, 0.6]])
    ipopt, ddp = (make_solver(mpc, name).solve(x) for name in ("ipopt", "ddp"))
    np.testing.assert_allclose(ddp.value, ipopt.value, rtol=1e-6)
    np.testing.assert_allclose(ddp.u0, ipopt.u0, atol=1e-3)
