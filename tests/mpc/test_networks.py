"""Costs that are networks, against plain numpy and torch."""

from __future__ import annotations

import json
from typing import Any

import casadi as ca
import lq_plant
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.datasets import TransitionTable
from mpcoffline.learning import ParameterConfig, fit_parameters
from mpcoffline.mpc import MPC, ConvexNetworkCost, Model, NetworkCost, NormCost, QuadraticCost
from mpcoffline.mpc.component import cost_from_json
from mpcoffline.mpc.torch_twin import TorchTwin
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import make_solver

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


@settings(max_examples=25)
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
        ([], [], {}, "weights: expected 1 arrays, got 0"),
        ([np.ones((1, 2))], [], {}, "biases: expected 1 arrays, got 0"),
        ([np.ones((2, 2))], [np.ones(2)], {}, r"weights_0: expected shape \(1, 2\), got shape \(2, 2\)"),
        ([np.ones(2)], [np.ones(1)], {}, r"weights_0: expected shape \(1, 2\), got shape \(2,\)"),
        ([np.ones((3, 2)), np.ones((1, 2))], [np.ones(3), [0.0]], {}, r"weights_1: expected shape \(1, 3\)"),
        ([np.ones((3, 2)), np.ones((1, 3))], [np.ones(2), [0.0]], {}, r"weights_0: expected shape \(2, 2\)"),
        ([np.ones((3, 2)), np.ones((1, 3))], [np.ones(3), [0.0, 0.0]], {}, r"biases_1: expected shape \(1,\)"),
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


@pytest.mark.parametrize("damaged", ["biases_0", "weights_1", "mean"])
def test_a_damaged_file_is_refused(damaged: str) -> None:
    data = nominal_mpc(PENDULUM).replace(terminal_cost=some_network(3, (4,), 0)[0]).to_json()
    blocks = data["terminal_cost"]["blocks"]
    for broken in ([b for b in blocks if b["name"] != damaged], [one_longer(b, damaged) for b in blocks]):
        with pytest.raises(FileFormatError):
            MPC.from_json(data | {"terminal_cost": data["terminal_cost"] | {"blocks": broken}})


def one_longer(block: dict[str, Any], name: str) -> dict[str, Any]:
    """A block's JSON, with one row more if it has the name."""
    if block["name"] != name:
        return block
    rows, *columns = block["shape"]
    longer = {key: block[key] + block[key][: int(np.prod(columns))] for key in ("theta", "low", "high")}
    return block | longer | {"shape": [rows + 1, *columns]}


def test_a_network_of_another_size_than_the_model_is_refused() -> None:
    with pytest.raises(InvalidArgumentError, match="terminal_cost: expected a cost for nx = 3"):
        nominal_mpc(PENDULUM).replace(terminal_cost=NetworkCost.random(2, seed=0))


# ---------------------------------------------------------------- input-convex networks


def some_convex(nx: int, nu: int, hidden: tuple[int, ...], seed: int) -> ConvexNetworkCost:
    """A cost with every argument given."""
    rng = np.random.default_rng(seed)
    n = nx + nu
    G = rng.normal(size=(n, n))
    H = G @ G.T
    options: dict[str, Any] = {"R": H[nx:, nx:], "S": H[:nx, nx:], "u_ref": rng.normal(size=nu)} if nu else {}
    options |= {"mean": rng.normal(size=n), "std": rng.uniform(0.5, 2.0, n)}
    return ConvexNetworkCost.random(
        nx, nu, hidden, seed=seed, W=H[:nx, :nx], x_ref=rng.normal(size=nx), constant=-2.0, **options
    )


def convex_by_torch(cost: ConvexNetworkCost, x: Array, u: Array) -> Array:
    """The formula in the class, with torch's own layers."""
    values = {name: torch.from_numpy(np.asarray(value)) for name, value in cost.values.items()}
    v = (torch.from_numpy(np.hstack([x, u])) - values["mean"]) / values["std"]
    z = None
    for k in range(cost.n_layers):
        a = torch.nn.functional.linear(v, values[f"passes_{k}"], values[f"biases_{k}"])
        if z is not None:
            a = a + torch.nn.functional.linear(z, values[f"mixes_{k - 1}"])
        z = (a + torch.sqrt(a**2 + 1)) / 2
    e, du = x - cost.values["x_ref"], u - cost.values.get("u_ref", np.zeros(0))
    both, H = np.hstack([e, du]), np.block([[cost.W, cost.S], [cost.S.T, cost.R]])
    assert z is not None
    net = torch.nn.functional.linear(z, values[f"mixes_{cost.n_layers - 1}"])[:, 0].numpy()
    return np.asarray(net + np.einsum("bi,ij,bj->b", both, H, both) + cost.values["constant"])


def stage_function(cost: Any, nx: int, nu: int) -> ca.Function:
    x, u, theta = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("theta", cost.space.size)
    return ca.Function("L", [x, u, theta], [cost.expression(x, u, cost.space.symbols(theta))])


@settings(max_examples=25)
@given(st.integers(1, 3), st.integers(0, 2), st.lists(st.integers(1, 5), min_size=1, max_size=3), st.integers(0, 2**31))
def test_convex_cost_is_its_formula(nx: int, nu: int, hidden: list[int], seed: int) -> None:
    cost, rng = some_convex(nx, nu, tuple(hidden), seed), np.random.default_rng(seed)
    x, u = rng.normal(size=(7, nx)), rng.normal(size=(7, nu))
    L, expected = stage_function(cost, nx, nu), convex_by_torch(cost, x, u)
    np.testing.assert_allclose(L(x.T, u.T, cost.space.theta).full().ravel(), expected, rtol=1e-12, atol=1e-11)
    twin = TorchTwin(L)(*(torch.from_numpy(a) for a in (x, u, cost.space.theta)))
    np.testing.assert_allclose(twin.numpy().ravel(), expected, rtol=1e-12, atol=1e-11)
    at_reference = np.tile(cost.values.get("u_ref", np.zeros(0)), (7, 1))
    T = function(cost, nx)(x.T, cost.space.theta).full().ravel()
    np.testing.assert_allclose(T, convex_by_torch(cost, x, at_reference), rtol=1e-12, atol=1e-11)


@given(st.integers(0, 2**31))
def test_convex_for_every_theta_in_bounds(seed: int) -> None:
    """The Hessian in (x, u) is positive semidefinite wherever theta and (x, u) are."""
    cost, rng = ConvexNetworkCost.random(2, 1, (4, 3), seed=0), np.random.default_rng(seed)
    theta = np.where(cost.space.mask(["cost"]), 3.0 * rng.normal(size=cost.space.size), cost.space.theta)
    theta = np.maximum(theta, cost.space.low)
    xu, p = ca.SX.sym("xu", 3), ca.SX.sym("theta", cost.space.size)
    L = cost.expression(xu[:2], xu[2], cost.space.symbols(p))
    hessian = ca.Function("H", [xu, p], [ca.hessian(L, xu)[0]])(3.0 * rng.normal(size=3), theta).full()
    assert np.linalg.eigvalsh(hessian)[0] >= -1e-12 * np.abs(hessian).max()


def test_a_convex_costs_parameters() -> None:
    mpc = nominal_mpc(PENDULUM).replace(stage_cost=ConvexNetworkCost.random(3, 1, (5, 4), seed=0))
    groups = {b.name.removeprefix("stage_cost."): b.group for b in mpc.space if b.name.startswith("stage_cost.")}
    learned = ["W", "R", "constant", "passes_0", "passes_1", "biases_0", "biases_1", "mixes_0", "mixes_1"]
    assert groups == dict.fromkeys(learned, "cost") | dict.fromkeys(["u_ref", "x_ref", "mean", "std"], "reference")
    assert [b.low.min() for b in mpc.space if "mixes" in b.name] == [0.0, 0.0]
    np.testing.assert_allclose(mpc.values["stage_cost.R"], [[1e-3]])
    again = MPC.from_json(json.loads(json.dumps(mpc.to_json())))
    assert again.to_json() == mpc.to_json()
    np.testing.assert_array_equal(again.theta, mpc.theta)


@pytest.mark.parametrize(
    ("passes", "biases", "mixes", "options", "message"),
    [
        ([], [], [], {}, "passes: expected 1 arrays, got 0"),
        ([np.ones((2, 2))], [np.ones(2)], [np.ones((1, 2))], {}, r"passes_0: expected shape \(2, 3\)"),
        ([np.ones((2, 3))], [np.ones(2)], [-np.ones((1, 2))], {}, "expected a value from 0.0 to inf"),
        ([np.ones((2, 3))], [np.ones(2)], [np.ones((1, 3))], {}, r"mixes_0: expected shape \(1, 2\)"),
        ([np.ones((2, 3))], [np.ones(2)], [], {}, "mixes: expected 1 arrays, got 0"),
        ([np.ones((2, 3))], [np.ones(2)], [np.ones((1, 2))], {"mean": [0.0]}, r"mean: expected shape \(3,\)"),
        ([np.ones((2, 3))], [np.ones(2)], [np.ones((1, 2))], {"std": np.zeros(3)}, "Parameter value"),
    ],
)
def test_convex_cost_refuses(passes: Any, biases: Any, mixes: Any, options: Any, message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        ConvexNetworkCost(passes, biases, mixes, np.eye(2), np.eye(1), **options)


@pytest.mark.slow
def test_fit_learns_a_convex_cost() -> None:
    """With V = 0, (FIT) is plain regression of the logged cost; no quadratic cost follows this one."""
    rng = np.random.default_rng(0)
    x, u = (3.0 * lq_plant.float32_uniform(rng, 600, n) for n in (2, 1))
    costs = np.hypot(1.0, x[:, 0]) + np.logaddexp(0.0, 2.0 * x[:, 1] - u[:, 0]) + 0.1 * u[:, 0] ** 2
    table = TransitionTable.from_arrays(x, u, costs, x, np.zeros(len(x)))
    model = Model(lambda x, u, p: lq_plant.A @ x + lq_plant.B @ u, nx=2, nu=1, dt=0.1, discrete=True)
    config, value = ParameterConfig(prior=1e-7, refit_iterations=100), lq_plant.QuadraticValue(np.zeros((2, 2)))
    errors = []
    for cost in (QuadraticCost(np.eye(2), [[1.0]], [[0.0], [0.0]]), ConvexNetworkCost.random(2, 1, (4,), seed=0)):
        mpc = MPC(model, cost, NormCost([0.0, 0.0]), 3, 0.9, [-1.0], [1.0])
        result = fit_parameters(mpc, value, table, ("cost",), config, seed=0)
        assert (result.theta >= mpc.space.low).all()
        errors.append(result.loss_after)
    assert errors[1] < 0.01
    assert errors[1] < 0.1 * errors[0]


def test_which_costs_promise_convexity() -> None:
    assert QuadraticCost.convex
    assert NormCost.convex
    assert ConvexNetworkCost.convex
    assert not NetworkCost.convex


@pytest.mark.slow
@pytest.mark.parametrize("part", ["terminal_cost.weights_2", "stage_cost.mixes_1"])
def test_ipopt_and_ddp_agree_and_take_weights_as_data(part: str) -> None:
    """One step ahead the minimum over u is found by hand, on a grid."""
    name, _ = part.split(".")
    cost = some_network(3, (6, 6), 3)[0] if name == "terminal_cost" else some_convex(3, 1, (4, 4), 0)
    mpc = nominal_mpc(PENDULUM).replace(horizon=1, discount=0.95, **{name: cost})
    other = mpc.space.pack({part: 2.0 * mpc.values[part]})
    x, u = np.array([[0.6, 0.8, 0.5], [-1.0, 0.0, 1.0]]), np.linspace(-2.0, 2.0, 40_001)
    solvers = [make_solver(mpc, name) for name in ("ipopt", "ddp")]
    for theta in (mpc.theta, other):
        for state in x:
            repeated = np.repeat(state[:, None], len(u), axis=1)
            reached = mpc.dynamics_function(repeated, u[None], theta)
            grid = mpc.stage_function(repeated, u[None], theta) + 0.95 * mpc.terminal_function(reached, theta)
            for solver in solvers:
                assert float(solver.solve(state, theta=theta).value) == pytest.approx(float(ca.mmin(grid)), abs=1e-6)
