"""Terminal costs from V, against closed forms, conditions of optimality, and autograd."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st
from numpy.typing import NDArray
from torch import Tensor

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError, MPCOfflineError, UnknownIdError
from mpcoffline.learning.distillation import network, network_jacobian, squares
from mpcoffline.learning.terminal import DistillConfig, fit_terminal, terminal_error
from mpcoffline.mpc import NetworkCost, QuadraticCost

Array = NDArray[np.float64]
SMALL = DistillConfig(hidden=(12, 12), n_steps=80, batch_size=2_000)


def quadratic_value(P: Array, x_ref: Array, level: float) -> Callable[[Tensor], Tensor]:
    def value(x: Tensor) -> Tensor:
        e = x.double() - torch.from_numpy(x_ref)
        return (((e @ torch.from_numpy(P)) * e).sum(-1) + level).float()

    return value


def bowl(x: Tensor) -> Tensor:
    """A value that no quadratic is: flat far away, curved the wrong way there."""
    return 5.0 + 30.0 * torch.tanh(0.3 * x.square().sum(-1)) + 3.0 * torch.sin(2.0 * x[..., 0])


def cloud(n: int, nx: int = 2, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(-2.0, 2.0, size=(n, nx))


@given(st.integers(1, 4), st.booleans(), st.sampled_from([1e-6, 1.0, 1e6]), st.integers(0, 2**31))
def test_a_quadratic_value_is_found(nx: int, singular: bool, size: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(nx, max(nx - singular, 1)))
    P, x_ref = size * G @ G.T, rng.normal(size=nx)
    cost = fit_terminal("quadratic", quadratic_value(P, x_ref, 3.0 * size), cloud(200, nx, seed), x_ref=x_ref, seed=0)
    assert isinstance(cost, QuadraticCost)
    np.testing.assert_allclose(cost.W, P, rtol=0, atol=2e-4 * np.abs(P).max())
    assert float(cost.values["constant"]) == pytest.approx(3.0 * size, abs=2e-3 * np.abs(P).max() + 1e-4 * size)


@given(st.integers(0, 2**31))
def test_the_quadratic_is_the_nearest_positive_semidefinite_one(seed: int) -> None:
    """W >= 0 is optimal if and only if the slope M of the loss in W obeys M >= 0 and M W = 0 (the loss is convex)."""
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(3, 3))
    P = G + G.T  # indefinite: the bound is active
    x, x_ref = cloud(300, 3, seed).astype(np.float32).astype(np.float64), rng.normal(size=3)
    value = quadratic_value(P, x_ref, 1.0)
    cost = fit_terminal("quadratic", value, x, x_ref=x_ref, seed=0)
    assert isinstance(cost, QuadraticCost)
    e = x - x_ref
    V = value(torch.from_numpy(x)).double().numpy()
    rest = np.einsum("bi,ij,bj->b", e, cost.W, e) + cost.values["constant"] - V
    M = np.einsum("b,bi,bj->ij", rest, e, e) / len(e)
    size = np.abs(np.einsum("bi,bj->ij", e, e)).max() / len(e) * V.std()
    assert abs(rest.mean()) < 1e-5 * V.std()
    assert np.linalg.eigvalsh(M)[0] > -1e-4 * size
    assert abs(np.sum(M * cost.W)) < 1e-5 * V.var()


@pytest.fixture(scope="module")
def learned() -> NetworkCost:
    cost = fit_terminal("network", bowl, cloud(4_000), x_ref=[0.0, 0.0], seed=0, config=SMALL)
    assert isinstance(cost, NetworkCost)
    return cost


def test_a_network_holds_what_no_quadratic_can(learned: NetworkCost) -> None:
    held_out = cloud(1_000, seed=1)
    plain = fit_terminal("quadratic", bowl, cloud(4_000), x_ref=[0.0, 0.0], seed=0)
    error, before = (terminal_error(cost, bowl, held_out) for cost in (learned, plain))
    assert before.relative > 0.2
    assert error.relative < 0.05
    assert error.rms <= error.largest
    assert error.spread == pytest.approx(float(bowl(torch.from_numpy(held_out)).std(correction=0)), rel=1e-5)


def test_terminal_error_is_its_formula() -> None:
    cost = QuadraticCost(np.eye(2), constant=1.0)
    error = terminal_error(cost, lambda x: x[:, 0], [[0.0, 0.0], [3.0, 0.0]])  # T - V = 1 - 0, 10 - 3
    assert (error.rms, error.spread, error.largest) == pytest.approx((5.0, 1.5, 7.0))
    assert error.relative == pytest.approx(10.0 / 3.0)


def test_far_from_the_data_the_cost_rises(learned: NetworkCost) -> None:
    directions = cloud(50, seed=2)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    T = torch_terminal(learned)
    assert (T(40.0 * directions) > T(20.0 * directions)).all()
    assert (T(20.0 * directions) > T(cloud(4_000)).max()).all()


def torch_terminal(cost: NetworkCost) -> Callable[[Array], Array]:
    def evaluated(x: Array) -> Array:
        v = {name: torch.from_numpy(np.asarray(value)) for name, value in cost.values.items()}
        layers = [(v[f"weights_{k}"], v[f"biases_{k}"]) for k in range(cost.n_layers)]
        net = network(layers, (torch.from_numpy(x) - v["mean"]) / v["std"])
        e = x - cost.values["x_ref"]
        return (v["offset"] + v["scale"] * net).numpy() + np.einsum("bi,ij,bj->b", e, cost.values["W"], e)

    return evaluated


def test_the_blend_lies_between_network_and_quadratic(learned: NetworkCost) -> None:
    options: dict[str, Any] = {"x_ref": [0.0, 0.0], "seed": 0}
    x = cloud(100, seed=3)
    quadratic = fit_terminal("quadratic", bowl, cloud(4_000), **options)
    assert isinstance(quadratic, QuadraticCost)
    q = np.einsum("bi,ij,bj->b", x, quadratic.W, x) + quadratic.values["constant"]
    pure = torch_terminal(learned)(x)
    for blend in (0.5, 1.0):
        mixed = fit_terminal("network", bowl, cloud(4_000), blend=blend, config=SMALL, **options)
        assert isinstance(mixed, NetworkCost)
        np.testing.assert_allclose(torch_terminal(mixed)(x), (1 - blend) * pure + blend * q, rtol=1e-9)


def test_the_same_seed_gives_the_same_weights(learned: NetworkCost) -> None:
    again, other = (
        fit_terminal("network", bowl, cloud(4_000), x_ref=[0.0, 0.0], seed=seed, config=SMALL) for seed in (0, 1)
    )
    np.testing.assert_array_equal(again.space.theta, learned.space.theta)
    assert (other.space.theta != learned.space.theta).any()


@pytest.mark.parametrize("n_layers", [0, 1, 2])
def test_the_jacobian_is_that_of_autograd(n_layers: int) -> None:
    cost = NetworkCost.random(3, (4, 5)[:n_layers], seed=0)
    layers = [
        (torch.from_numpy(cost.values[f"weights_{k}"]), torch.from_numpy(cost.values[f"biases_{k}"]))
        for k in range(cost.n_layers)
    ]
    z = torch.from_numpy(cloud(6, 3))
    parts = [part for layer in layers for part in layer]
    output, jacobian = network_jacobian(layers, z)

    def by_parts(*given: Tensor) -> Tensor:
        return network(list(zip(given[::2], given[1::2], strict=True)), z)

    expected = torch.autograd.functional.jacobian(by_parts, tuple(parts))
    torch.testing.assert_close(output, by_parts(*parts))
    torch.testing.assert_close(jacobian, torch.cat([block.flatten(1) for block in expected], dim=1))


# ---------------------------------------------------------------- data as they come


@pytest.mark.parametrize("size", [1, 3, 4, 41])
def test_squares_are_those_of_the_jacobian_below_its_diagonal(size: int) -> None:
    jacobian = torch.from_numpy(cloud(200, size))
    expected = torch.tril(jacobian.T @ jacobian)
    torch.testing.assert_close(torch.tril(squares(jacobian)), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", ["quadratic", "network"])
def test_a_constant_column_a_few_rows_and_large_numbers(kind: Any) -> None:
    x = cloud(100, 3) * [1e6, 1.0, 0.0] + [0.0, 0.0, 7.0]

    def value(x: Tensor) -> Tensor:
        return 1e6 * bowl(x[:, :2] / torch.tensor([1e6, 1.0]))

    cost = fit_terminal(kind, value, x, x_ref=[0.0, 0.0, 7.0], seed=0, config=SMALL)
    assert np.isfinite(cost.space.theta).all()
    assert terminal_error(cost, value, x).relative < (0.7 if kind == "quadratic" else 0.1)


@pytest.mark.parametrize("kind", ["quadratic", "network"])
@pytest.mark.parametrize("rows", [1, 50])
def test_a_constant_value_is_a_constant_cost(kind: Any, rows: int) -> None:
    cost = fit_terminal(kind, lambda x: 0.0 * x[:, 0] - 4.0, cloud(rows), x_ref=[0.0, 0.0], seed=0, config=SMALL)
    error = terminal_error(cost, lambda x: 0.0 * x[:, 0] - 4.0, cloud(rows))
    assert error.largest < 1e-3
    assert error.relative < 1e-3


def test_a_value_that_is_noise_is_refused() -> None:
    def noise(x: Tensor) -> Tensor:
        return torch.sin(1e5 * x.double().square().sum(-1)).float()

    with pytest.raises(MPCOfflineError, match=r"within 50% of the spread of V, got an error of .* kind='quadratic'"):
        fit_terminal("network", noise, cloud(4_000), x_ref=[0.0, 0.0], seed=0, config=SMALL)


@pytest.mark.parametrize(
    ("kind", "observations", "options", "error", "message"),
    [
        ("cubic", cloud(9), {}, UnknownIdError, "terminal cost: expected one of network, quadratic, got 'cubic'"),
        ("network", cloud(9), {"blend": 1.5}, InvalidArgumentError, "blend: expected a finite number from 0 to 1"),
        ("network", cloud(9, 3), {}, InvalidArgumentError, r"observations: expected shape \(n, 2\)"),
        ("quadratic", np.zeros((0, 2)), {}, InvalidArgumentError, r"observations: expected shape \(n, 2\)"),
        ("quadratic", [[0.0, np.nan]], {}, InvalidDataError, "observations: expected finite numbers"),
    ],
)
def test_what_is_refused(kind: Any, observations: Any, options: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        fit_terminal(kind, bowl, observations, x_ref=[0.0, 0.0], seed=0, **options)


@pytest.mark.parametrize("value", [lambda x: x[:, 0] / 0.0, lambda x: x])
def test_values_that_are_no_numbers_are_refused(value: Any) -> None:
    with pytest.raises(InvalidDataError, match="value: expected 9 finite numbers"):
        fit_terminal("quadratic", value, cloud(9), x_ref=[0.0, 0.0], seed=0)


@pytest.mark.parametrize("options", [{"hidden": (0,)}, {"n_steps": 0}, {"max_rows": 1.5}])
def test_config_refuses(options: Any) -> None:
    with pytest.raises(InvalidArgumentError, match=next(iter(options))):
        DistillConfig(**options)
