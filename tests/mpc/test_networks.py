"""Costs that are networks, against plain numpy and torch."""

from __future__ import annotations

import json
from typing import Any

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mpcoffline.errors import InvalidArgumentError
from mpcoffline.mpc import MPC, NetworkCost, NormCost, QuadraticCost
from mpcoffline.mpc.cost import cost_from_json
from mpcoffline.mpc.torch_twin import TorchTwin
from mpcoffline.solvers import make_solver
from mpcoffline.tasks import nominal_mpc

Array = NDArray[np.float64]
PENDULUM = "mpcoffline/PendulumSwingUp-v0"


def some_network(nx: int, hidden: tuple[int, ...], seed: int) -> tuple[NetworkCost, dict[str, Any]]:
    """A cost with every argument given, and the arguments."""
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(nx, nx))
    options: dict[str, Any] = {
        "mean": rng.normal(size=nx),
        "std": rng.uniform(0.5, 2.0, nx),
        "offset": 3.0,
        "scale": -1.7,
        "W": G @ G.T,
        "x_ref": rng.normal(size=nx),
    }
    return NetworkCost.random(nx, hidden, seed=seed, **options), options


def by_torch(cost: NetworkCost, x: Array) -> Array:
    """The formula in the class, with torch's own layers."""
    values = {name: torch.from_numpy(np.asarray(value)) for name, value in cost.values.items()}
    h = (torch.from_numpy(x) - values["mean"]) / values["std"]
    for k in range(cost.n_layers):
        h = torch.nn.functional.linear(h, values[f"weights_{k}"], values[f"biases_{k}"])
        if k < cost.n_layers - 1:
            h = h / torch.sqrt(1 + h**2)
    e = torch.from_numpy(x) - values["x_ref"]
    return (values["offset"] + values["scale"] * h[:, 0] + ((e @ values["W"]) * e).sum(1)).numpy()


def function(cost: Any, nx: int) -> ca.Function:
    x, theta = ca.SX.sym("x", nx), ca.SX.sym("theta", cost.space.size)
    return ca.Function("T", [x, theta], [cost.terminal_expression(x, cost.space.symbols(theta))])


@given(st.integers(1, 5), st.lists(st.integers(1, 6), max_size=3), st.integers(0, 2**31))
def test_terminal_cost_is_its_formula(nx: int, hidden: list[int], seed: int) -> None:
    cost, _ = some_network(nx, tuple(hidden), seed)
    x = np.random.default_rng(seed).normal(size=(7, nx))
    T = function(cost, nx)
    expected = by_torch(cost, x)
    np.testing.assert_allclose(T(x.T, cost.space.theta).full().ravel(), expected, rtol=1e-12, atol=1e-11)
    twin = TorchTwin(T)(torch.from_numpy(x), torch.from_numpy(cost.space.theta))
    np.testing.assert_allclose(twin.numpy().ravel(), expected, rtol=1e-12, atol=1e-11)


def test_defaults_are_the_bare_network() -> None:
    A, b = [[1.0, -2.0]], [0.5]
    cost = NetworkCost([[[3.0, 4.0]], [[2.0]]], [[0.0], [1.0]])
    assert float(function(cost, 2)([1.0, 1.0], cost.space.theta)) == pytest.approx(2 * 7 / np.sqrt(50) + 1)
    linear = NetworkCost([A], [b])
    assert float(function(linear, 2)([3.0, 1.0], linear.space.theta)) == pytest.approx(1.5)


def test_parameters_are_terminal_cost_or_reference() -> None:
    mpc = nominal_mpc(PENDULUM).replace(terminal_cost=some_network(3, (4, 4), 0)[0])
    groups = {block.name.removeprefix("terminal_cost."): block.group for block in mpc.space if "terminal" in block.name}
    layers = [f"{kind}_{k}" for kind in ("weights", "biases") for k in range(3)]
    assert groups == dict.fromkeys([*layers, "offset", "W"], "terminal") | dict.fromkeys(
        ["scale", "mean", "std", "x_ref"], "reference"
    )


def test_random_networks_are_those_of_their_seed() -> None:
    same, again, other = (NetworkCost.random(3, seed=seed) for seed in (1, 1, 2))
    assert [len(v) for n, v in same.values.items() if n.startswith("weights")] == [24, 24, 1]
    np.testing.assert_array_equal(same.space.theta, again.space.theta)
    assert (same.space.theta != other.space.theta).any()


def test_json_roundtrip_bit_for_bit() -> None:
    cost, _ = some_network(3, (5, 4), 0)
    again = cost_from_json(json.loads(json.dumps(cost.to_json())))
    assert again.to_json() == cost.to_json()
    assert (again.nx, again.n_layers) == (3, 3)
    mpc = nominal_mpc(PENDULUM).replace(terminal_cost=cost)
    np.testing.assert_array_equal(MPC.from_json(json.loads(json.dumps(mpc.to_json()))).theta, mpc.theta)


@pytest.mark.parametrize(
    ("weights", "biases", "options", "message"),
    [
        ([], [], {}, "weights: expected one matrix a layer"),
        ([np.ones((1, 2))], [], {}, "weights: expected one matrix a layer, and as many biases, got 1 and 0"),
        ([np.ones((2, 2))], [np.ones(2)], {}, r"weights_0: expected shape \(1, n\), got shape \(2, 2\)"),
        ([np.ones(2)], [np.ones(1)], {}, r"weights_0: expected shape \(1, n\), got shape \(2,\)"),
        ([np.ones((3, 2)), np.ones((1, 2))], [np.ones(3), [0.0]], {}, r"weights_1: expected shape \(1, 3\)"),
        ([np.ones((3, 2)), np.ones((1, 3))], [np.ones(2), [0.0]], {}, r"biases_0: expected shape \(3,\)"),
        ([np.ones((1, 2))], [[0.0]], {"std": [1.0, 0.0]}, "Parameter value"),
        ([np.ones((1, 2))], [[0.0]], {"mean": [1.0]}, r"mean: expected shape \(2,\)"),
        ([np.ones((1, 2))], [[0.0]], {"W": np.eye(3)}, r"W: expected shape \(2, 2\)"),
        ([np.ones((1, 2))], [[0.0]], {"W": -np.eye(2)}, "W: expected a positive semidefinite matrix"),
        ([[[np.nan, 1.0]]], [[0.0]], {}, "finite numbers"),
    ],
)
def test_network_cost_refuses(weights: Any, biases: Any, options: Any, message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        NetworkCost(weights, biases, **options)


def test_a_damaged_file_is_refused() -> None:
    data = some_network(2, (3,), 0)[0].to_json()
    data["blocks"] = [block for block in data["blocks"] if block["name"] != "biases_0"]
    with pytest.raises((InvalidArgumentError, KeyError)):
        cost_from_json(data)


def test_a_network_of_another_size_than_the_model_is_refused() -> None:
    with pytest.raises(InvalidArgumentError, match="terminal_cost: expected a cost for nx = 3"):
        nominal_mpc(PENDULUM).replace(terminal_cost=NetworkCost.random(2, seed=0))


def test_which_costs_promise_convexity() -> None:
    assert QuadraticCost.convex
    assert NormCost.convex
    assert not NetworkCost.convex


@pytest.mark.slow
def test_ipopt_and_ddp_agree_and_take_weights_as_data() -> None:
    """One step ahead the minimum over u is found by hand, on a grid."""
    cost, _ = some_network(3, (6, 6), 3)
    mpc = nominal_mpc(PENDULUM).replace(terminal_cost=cost, horizon=1, discount=0.95)
    other = mpc.space.pack({"terminal_cost.weights_2": 2.0 * mpc.values["terminal_cost.weights_2"]})
    x, u = np.array([[0.6, 0.8, 0.5], [-1.0, 0.0, 1.0]]), np.linspace(-2.0, 2.0, 40_001)
    solvers = [make_solver(mpc, name) for name in ("ipopt", "ddp")]
    for theta in (mpc.theta, other):
        for state in x:
            repeated = np.repeat(state[:, None], len(u), axis=1)
            reached = mpc.dynamics_function(repeated, u[None], theta)
            grid = mpc.stage_function(repeated, u[None], theta) + 0.95 * mpc.terminal_function(reached, theta)
            for solver in solvers:
                assert float(solver.solve(state, theta=theta).value) == pytest.approx(float(ca.mmin(grid)), abs=1e-6)
