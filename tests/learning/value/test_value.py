"""(VALUE) on problems whose value is known: linear-quadratic systems and a chain; the losses against numpy."""

from __future__ import annotations

from functools import cache
from typing import Any

import lq_plant
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, MPCOfflineError, UnknownIdError
from mpcoffline.datasets import TransitionTable
from mpcoffline.learning import VALUE_METHODS, ValueConfig, ValueFunction, ValueTraining, fit_value
from mpcoffline.learning.value.fit import Expectile, Residual, TemporalDifference, ValueMethod
from mpcoffline.mpc.layout import Layout

Array = NDArray[np.float64]
GRID = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 17), np.linspace(-0.8, 0.8, 17)), axis=-1).reshape(-1, 2)
SMALL: dict[str, Any] = {"hidden": (32, 32), "n_steps": 1_000, "learning_rate": 1e-2, "polyak": 0.1}


@cache
def learned(method: str, tau: float = 0.3) -> tuple[ValueFunction, float]:
    """V of the logging policy's transitions, and the loss over the last half."""
    config = ValueConfig(method=method, tau=tau, **SMALL)
    training = ValueTraining(lq_plant.policy_log(4_000), lq_plant.DISCOUNT, config, seed=0)
    training.advance(500)
    loss = training.advance(500)["value_loss"]
    return training.result, loss


@pytest.mark.parametrize("method", ["residual", "td"])
def test_the_value_of_a_linear_policy_solves_its_lyapunov_equation(method: str) -> None:
    value, loss = learned(method)
    truth = lq_plant.quadratic(lq_plant.policy_value(lq_plant.GAIN), GRID)
    assert lq_plant.explained(truth, value.predict(GRID)) > 0.99
    assert loss < 1e-3


@cache
def learned_from_diverse_actions(method: str, tau: float = 0.3) -> Array:
    config = ValueConfig(method=method, tau=tau, **SMALL)
    return fit_value(lq_plant.exploring_log(8_000), lq_plant.DISCOUNT, config, seed=0).predict(GRID)


@pytest.mark.slow
def test_a_low_expectile_lies_below_the_behaviours_value_and_near_the_optimum() -> None:
    optimal = lq_plant.quadratic(lq_plant.BEST.P, GRID)
    td = learned_from_diverse_actions("td")
    low = learned_from_diverse_actions("expectile", 0.03)
    assert (low < td).all()
    assert lq_plant.explained(optimal, low) > 0.97 > lq_plant.explained(optimal, td)
    assert np.abs(low - optimal).mean() < 0.2 * np.abs(td - optimal).mean()


@pytest.mark.slow
def test_expectiles_fall_with_tau() -> None:
    means = [learned_from_diverse_actions("expectile", tau).mean() for tau in (0.03, 0.2, 0.5)]
    assert means == sorted(means)
    # The expectile 1/2 is the mean: the same minimum as TD's.
    assert means[-1] == pytest.approx(learned_from_diverse_actions("td").mean(), rel=0.05)


# ---------------------------------------------------------------- ends of episodes


def chain(terminated: bool) -> TransitionTable:
    """Two states: 0 -> 1 at cost 2, 1 -> 1 at cost 3, where the last either terminates or is cut off in time."""
    x, reached = np.array([[0.0], [1.0]] * 64), np.array([[1.0], [1.0]] * 64)
    ends = np.tile([0.0, float(terminated)], 64)
    return TransitionTable.from_arrays(x, np.zeros((128, 1)), np.tile([2.0, 3.0], 64), reached, ends)


@pytest.mark.parametrize("method", ["auto", *VALUE_METHODS])
@pytest.mark.parametrize("terminated", [True, False])
def test_bootstrapping_stops_at_a_termination_only(method: str, terminated: bool) -> None:
    discount = 0.8
    last = 3.0 if terminated else 3.0 / (1.0 - discount)
    config = ValueConfig(method=method, hidden=(8,), n_steps=500, batch_size=64, learning_rate=2e-2, polyak=0.2)
    value = fit_value(chain(terminated), discount, config, seed=0)
    np.testing.assert_allclose(value.predict([[0.0], [1.0]]), [2.0 + discount * last, last], rtol=2e-3)


# ---------------------------------------------------------------- losses


def batch_of_five() -> tuple[TransitionTable, ValueFunction, ValueFunction, dict[str, Array]]:
    rng = np.random.default_rng(3)
    table = TransitionTable.from_arrays(
        rng.normal(size=(5, 2)), rng.normal(size=(5, 1)), rng.normal(size=5), rng.normal(size=(5, 2)), [0, 1, 0, 0, 1]
    )
    with torch.random.fork_rng():
        torch.manual_seed(5)
        V, target = ValueFunction(2, (8,)), ValueFunction(2, (8,))
    V.normalise(table, 0.7)
    target.normalise(table, 0.7)
    numbers = {
        "V": V.predict(table.observations),
        "V_next": V.predict(table.next_observations),
        "target_next": target.predict(table.next_observations),
        "alive": 1.0 - table.terminations.astype(np.float64),
        "cost": table.costs.astype(np.float64),
    }
    return table, V, target, numbers


def by_hand(method: ValueMethod, n: dict[str, Array], discount: float) -> float:
    following = n["V_next"] if isinstance(method, Residual) else n["target_next"]
    delta = n["cost"] + discount * n["alive"] * following - n["V"]
    if isinstance(method, Expectile):
        return float(np.mean(np.where(delta > 0, method.tau, 1 - method.tau) * delta**2))
    return float(np.mean(delta**2))


@pytest.mark.parametrize("method", [Residual(), TemporalDifference(), Expectile(0.1), Expectile(0.8)])
def test_losses_equal_their_formulas(method: ValueMethod) -> None:
    table, V, target, numbers = batch_of_five()
    loss = method.loss(V, target, table.columns(torch.from_numpy(table.rows)), 0.7)
    assert float(loss.detach()) == pytest.approx(by_hand(method, numbers, 0.7), rel=1e-5)


@pytest.mark.parametrize("method", [Residual(), TemporalDifference(), Expectile(0.1)])
def test_only_the_residual_is_differentiated_at_the_successor(method: ValueMethod) -> None:
    """The slope in the offset of V: the residual has (gamma alive - 1) per row, a held target -1."""
    table, V, target, n = batch_of_five()
    discount = 0.7
    V.offset.requires_grad_()
    method.loss(V, target, table.columns(torch.from_numpy(table.rows)), discount).backward()
    following = n["V_next"] if isinstance(method, Residual) else n["target_next"]
    delta = n["cost"] + discount * n["alive"] * following - n["V"]
    slope = discount * n["alive"] - 1.0 if isinstance(method, Residual) else -np.ones(5)
    weight = np.where(delta > 0, 0.1, 0.9) if isinstance(method, Expectile) else np.ones(5)
    assert V.offset.grad is not None
    assert float(V.offset.grad) == pytest.approx(np.mean(2 * weight * delta * slope), rel=1e-4)


# ---------------------------------------------------------------- the function


def test_normalisation_is_that_of_the_data() -> None:
    table = lq_plant.random_log(500)
    value = ValueFunction(2)
    value.normalise(table, 0.9)
    np.testing.assert_allclose(value.mean.numpy(), table.observations.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(value.std.numpy(), table.observations.std(axis=0), rtol=1e-5)
    assert float(value.offset) == pytest.approx(10 * table.costs.mean(), rel=1e-5)
    assert float(value.scale) == pytest.approx(10 * table.costs.std(), rel=1e-4)


def test_constant_data_and_no_discount_are_normalised_finitely() -> None:
    table = TransitionTable.from_arrays(np.ones((4, 2)), np.ones((4, 1)), np.ones(4), np.ones((4, 2)), np.zeros(4))
    value = fit_value(table, 1.0, ValueConfig(hidden=(4,), n_steps=3), seed=0)
    assert np.isfinite(value.predict(np.ones((1, 2)))).all()


def test_shapes_follow_the_observations() -> None:
    value = ValueFunction(3, (4,))
    for shape in ((), (5,), (2, 5)):
        predicted = value.predict(np.zeros((*shape, 3)))
        assert predicted.shape == shape
        assert predicted.dtype == np.float64


@pytest.mark.parametrize("bad", [np.zeros(2), np.zeros((3, 4)), np.full(3, np.nan), np.full((2, 3), np.inf)])
def test_wrong_observations_are_refused(bad: Array) -> None:
    with pytest.raises(InvalidArgumentError, match=r"observations: expected finite numbers of shape \(..., 3\)"):
        ValueFunction(3, (4,)).predict(bad)


def test_the_learned_function_is_constant() -> None:
    value, _ = learned("td")
    assert not value.training
    assert not any(parameter.requires_grad for parameter in value.parameters())


def test_arrays_hold_the_whole_function() -> None:
    value, _ = learned("residual")
    arrays = value.to_arrays()
    again = ValueFunction.from_arrays(arrays)
    assert again.hidden == value.hidden
    np.testing.assert_array_equal(again.predict(GRID), value.predict(GRID))
    for name, array in again.to_arrays().items():
        np.testing.assert_array_equal(array, arrays[name])


def test_the_discount_is_kept_and_may_be_unknown() -> None:
    value = fit_value(lq_plant.random_log(50), 0.93, ValueConfig(hidden=(4,), n_steps=1), seed=0)
    assert value.discount == 0.93
    arrays = value.to_arrays()
    assert ValueFunction.from_arrays(arrays).discount == 0.93
    del arrays["gamma"]  # as in files from before it was kept
    assert ValueFunction.from_arrays(arrays).discount is None
    assert ValueFunction(2).discount is None


@pytest.mark.parametrize("damage", ["missing", "shape", "foreign", "empty", "kind", "scalar", "nan"])
def test_damaged_arrays_are_refused(damage: str) -> None:
    arrays: dict[str, NDArray[Any]] = ValueFunction(2, (4, 4)).to_arrays()
    if damage == "missing":
        del arrays["net.2.bias"]
    elif damage == "shape":
        arrays["net.2.weight"] = np.zeros((4, 5), dtype=np.float32)
    elif damage == "foreign":
        arrays["other"] = np.zeros(3)
    elif damage == "empty":
        arrays = {}
    elif damage == "kind":
        arrays["net.0.bias"] = np.array(["a", "b", "c", "d"])
    elif damage == "nan":
        arrays["net.0.bias"] = np.full(4, np.nan, dtype=np.float32)
    else:
        arrays["mean"] = np.array(1.0)
    with pytest.raises(FileFormatError, match="value function"):
        ValueFunction.from_arrays(arrays)


# ---------------------------------------------------------------- seeds, reports, configuration


def weights(seed: int) -> dict[str, NDArray[Any]]:
    config = ValueConfig(hidden=(16, 16), n_steps=60)
    return fit_value(lq_plant.random_log(300), 0.9, config, seed=seed).to_arrays()


def test_the_seed_decides_every_bit() -> None:
    state = torch.random.get_rng_state()
    first, again, other = weights(1), weights(1), weights(2)
    for name, array in first.items():
        np.testing.assert_array_equal(again[name], array)
    assert any((other[name] != first[name]).any() for name in first)
    assert torch.equal(torch.random.get_rng_state(), state)  # the caller's generator is left alone


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "expectil"}, "Did you mean 'expectile'"),
        ({"tau": 0.0}, "tau"),
        ({"tau": 1.0}, "tau"),
        ({"tau": np.nan}, "tau"),
        ({"n_steps": 0}, "n_steps: expected a positive integer, got 0"),
        ({"n_steps": 10.5}, "n_steps"),
        ({"n_steps": True}, "n_steps"),
        ({"batch_size": -1}, "batch_size"),
        ({"learning_rate": 0.0}, "learning_rate: expected a finite number above 0, got 0.0"),
        ({"learning_rate": np.inf}, "learning_rate"),
        ({"learning_rate": "fast"}, "learning_rate"),
        ({"polyak": 1.5}, "polyak: expected a finite number above 0 to 1, got 1.5"),
        ({"hidden": (16, 0)}, r"hidden\[1\]"),
    ],
)
def test_bad_configurations_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(MPCOfflineError, match=message) as caught:
        ValueConfig(**options)
    assert isinstance(caught.value, UnknownIdError if "method" in options else InvalidArgumentError)


@pytest.mark.parametrize("hidden", [(), (5,), (4, 3)])
@pytest.mark.parametrize("n_members", [1, 2])
def test_of_a_longer_memory_it_asks_what_it_knew(hidden: tuple[int, ...], n_members: int) -> None:
    """Past inputs by input and age: those of the shorter memory decide, the others are anything."""
    rng = np.random.default_rng(0)
    short, long = Layout.of(2, 2, [1, 0]), Layout.of(2, 2, [3, 2])
    y, past = rng.normal(size=(20, 2)), rng.normal(size=(20, 2, 3))  # of input 0 and 1, by age
    value = ValueFunction(short.nx, hidden, n_members)
    value.normalise(
        TransitionTable.from_arrays(
            *(rng.normal(size=(9, k)) for k in (3, 1)), np.arange(9.0), rng.normal(size=(9, 3)), np.zeros(9)
        ),
        0.9,
    )
    wide = value.of_layout(short, long)
    z = np.column_stack([y, past[:, 0], past[:, 1, :2]])
    np.testing.assert_allclose(wide.predict(z), value.predict(np.column_stack([y, past[:, 0, :1]])), rtol=1e-6)
    assert wide.ny == long.nx
    assert wide.discount == value.discount
    assert value.of_layout(short, short) is value
    with pytest.raises(InvalidArgumentError, match="layout"):  # of more past values of one input, if of as many in all
        ValueFunction(5).of_layout(Layout.of(2, 2, [3, 0]), Layout.of(2, 2, [1, 4]))
