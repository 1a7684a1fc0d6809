"""(VALUE) in pieces: interruption, ensembles, held-out episodes, and data or settings that are hard on it."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import lq_plant
import numpy as np
import pendulum_data
import pytest
import torch
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError, MPCOfflineError
from mpcoffline.datasets import TransitionTable
from mpcoffline.learning import VALUE_METHODS, ValueConfig, ValueFunction, fit_value
from mpcoffline.learning.value.fit import Residual, ValueTraining
from mpcoffline.learning.value.training import VALIDATE_EVERY

Array = NDArray[np.float64]
GRID = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.8, 0.8, 9)), axis=-1).reshape(-1, 2)
TINY: dict[str, Any] = {"hidden": (8, 8), "n_steps": 30, "batch_size": 64}


def training(config: ValueConfig, n: int = 300, seed: int = 0) -> ValueTraining:
    return ValueTraining(lq_plant.random_log(n), 0.9, config, seed=seed)


def same_arrays(found: dict[str, NDArray[Any]], wanted: dict[str, NDArray[Any]]) -> None:
    assert found.keys() == wanted.keys()
    for name, array in wanted.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


# ---------------------------------------------------------------- interruption


@pytest.mark.parametrize(
    "options",
    [
        *({"method": method} for method in ("auto", *VALUE_METHODS)),
        {"n_members": 2},
        {"validation": 0.3, "n_steps": 400},
    ],
)
def test_an_interrupted_training_ends_with_the_same_bits(options: dict[str, Any]) -> None:
    """Whenever it is interrupted: before its first step, soon after, at its end, or (the longest) shortly before."""
    config = ValueConfig(**(TINY | options))
    whole, first = training(config), training(config)
    for stop in (0, 7, 290):
        first.advance(stop - first.step)
        second = training(config)
        second.restore({name: array.copy() for name, array in first.to_arrays().items()})
        assert second.step == first.step
        second.advance(config.n_steps)
        whole.advance(config.n_steps - whole.step)
        same_arrays(second.to_arrays(), whole.to_arrays())
        same_arrays(second.result.to_arrays(), whole.result.to_arrays())


def test_a_table_larger_than_memory_is_learned_from_and_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "store"))
    dataset = pendulum_data.stored(episodes=pendulum_data.recorded(length=40, episodes=8))
    table = TransitionTable.from_minari(dataset, memory=1000, cache=tmp_path / "cache")
    assert table.is_mapped
    config = ValueConfig(**TINY, validation=0.3)
    whole, first, second = (ValueTraining(table, 0.9, config, seed=0) for _ in range(3))
    whole.advance(30)
    first.advance(12)
    second.restore(first.to_arrays())
    second.advance(18)
    same_arrays(second.result.to_arrays(), whole.result.to_arrays())
    assert np.isfinite(whole.result.predict(table.observations)).all()


@settings(max_examples=10)
@given(pieces=st.lists(st.integers(0, 12), max_size=6))
def test_the_pieces_do_not_matter(pieces: list[int]) -> None:
    config = ValueConfig(**TINY)
    whole, parts = training(config), training(config)
    whole.advance(config.n_steps)
    for n in [*pieces, config.n_steps]:
        parts.advance(n)
    same_arrays(parts.to_arrays(), whole.to_arrays())


def test_a_state_is_a_copy() -> None:
    running = training(ValueConfig(**TINY))
    running.advance(3)
    arrays, kept = running.to_arrays(), running.to_arrays()
    result = running.result
    before = result.predict(GRID)
    running.advance(10)
    same_arrays(arrays, kept)
    np.testing.assert_array_equal(result.predict(GRID), before)


def test_fit_value_is_the_training_from_start_to_end() -> None:
    config = ValueConfig(**TINY)
    running = training(config)
    running.advance(config.n_steps + 5)
    assert running.done
    assert running.step == running.n_steps == 30
    same_arrays(fit_value(lq_plant.random_log(300), 0.9, config, seed=0).to_arrays(), running.result.to_arrays())


@pytest.mark.parametrize("damage", ["missing", "other network", "other method"])
def test_a_state_of_another_training_is_refused(damage: str) -> None:
    source = training(ValueConfig(**(TINY | {"hidden": (8, 9)}))) if damage == "other network" else None
    arrays = (source or training(ValueConfig(**TINY))).to_arrays()
    if damage == "missing":
        del arrays["counters"]
    config = ValueConfig(**(TINY | ({"method": "iql"} if damage == "other method" else {})))
    with pytest.raises(FileFormatError, match="state of a value training"):
        training(config).restore(arrays)


# ---------------------------------------------------------------- ensembles


@pytest.mark.parametrize("method", ["residual", "iql"])
def test_an_ensemble_is_the_mean_of_its_members(method: str) -> None:
    config = ValueConfig(**TINY, method=method, n_members=3)
    together = fit_value(lq_plant.random_log(300), 0.9, config, seed=0)
    arrays, alone = together.to_arrays(), []
    for i in range(3):
        own = {name.replace(f"members.{i}.", ""): a for name, a in arrays.items() if f"members.{i}." in name}
        units = {name: a for name, a in arrays.items() if not name.startswith("net.")}
        alone.append(ValueFunction.from_arrays(own | units))
    predictions = np.array([member.predict(GRID) for member in alone])
    np.testing.assert_allclose(together.predict(GRID), predictions.mean(axis=0), rtol=1e-6)
    assert (predictions.std(axis=0) > 0.0).all()
    first = fit_value(lq_plant.random_log(300), 0.9, ValueConfig(**TINY, method="residual"), seed=0)
    if method == "residual":  # the first member is the function that would have been learned alone
        np.testing.assert_array_equal(predictions[0], first.predict(GRID))


def test_an_ensembles_arrays_hold_it_and_its_slope_is_that_of_its_values() -> None:
    value = fit_value(lq_plant.random_log(300), 0.9, ValueConfig(**TINY, n_members=2), seed=0)
    again = ValueFunction.from_arrays(value.to_arrays())
    assert (again.n_members, again.hidden, again.ny) == (2, (8, 8), 2)
    np.testing.assert_array_equal(again.predict(GRID), value.predict(GRID))
    s = torch.tensor(GRID[:5], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(value.double(), s)


def test_an_ensemble_with_a_gap_is_refused() -> None:
    arrays = ValueFunction(2, (4,), n_members=3).to_arrays()
    for name in [name for name in arrays if name.startswith("net.members.1.")]:
        del arrays[name]
    with pytest.raises(FileFormatError, match="value function"):
        ValueFunction.from_arrays(arrays)


# ---------------------------------------------------------------- held-out episodes


def test_the_weights_of_the_smallest_validation_loss_are_kept() -> None:
    config = ValueConfig(hidden=(64, 64), n_steps=4 * VALIDATE_EVERY, batch_size=32, validation=0.5, learning_rate=1e-2)
    running = ValueTraining(lq_plant.random_log(64), 0.9, config, seed=0)  # few enough to be learned by heart
    table = lq_plant.random_log(64)
    _, held_out = table.split(0.5, 0)
    seen, values = [], []
    for _ in range(4):
        seen.append(running.advance(VALIDATE_EVERY)["validation_loss"])
        values.append(running.result)
    best = int(np.argmin(seen))
    same_arrays(values[-1].to_arrays(), values[best].to_arrays())
    # The loss by hand: the squared Bellman residual on the held-out rows, in units of V's scale.
    batch, value = held_out.columns(held_out.rows), values[-1]
    residual = batch.costs + 0.9 * value.predict(batch.next_observations) - value.predict(batch.observations)
    assert min(seen) == pytest.approx(np.mean(residual**2) / float(value.scale) ** 2, rel=1e-3)


def test_learning_stops_when_the_validation_loss_no_longer_falls() -> None:
    config = ValueConfig(
        hidden=(64, 64), n_steps=8_000, batch_size=32, validation=0.5, learning_rate=1e-2, patience=VALIDATE_EVERY
    )
    running = ValueTraining(lq_plant.random_log(64), 0.9, config, seed=0)
    running.advance(8_000)
    assert running.done
    assert running.step < 8_000
    assert running.step % VALIDATE_EVERY == 0


def test_one_episode_is_learned_from_whole_and_that_is_said(caplog: pytest.LogCaptureFixture) -> None:
    table = lq_plant.random_log(300)
    table.episode_ids[:] = 0
    with caplog.at_level(logging.WARNING, logger="mpcoffline.learning"):
        running = ValueTraining(table, 0.9, ValueConfig(**TINY, validation=0.2), seed=0)
    assert "is one episode: (VALUE) learns from all of it, without validation" in caplog.text
    assert running.advance(30).keys() == {"value_loss"}
    same_arrays(running.result.to_arrays(), fit_value(table, 0.9, ValueConfig(**TINY), seed=0).to_arrays())


# ---------------------------------------------------------------- hard data


def hard(kind: str) -> tuple[TransitionTable, Array]:
    """A log of u = GAIN x, and the true values at GRID."""
    table = lq_plant.policy_log(2_000)
    s, a, cost, following = (
        c.astype(np.float64) for c in (table.observations, table.actions, table.costs, table.next_observations)
    )
    truth = lq_plant.quadratic(lq_plant.policy_value(lq_plant.GAIN), GRID)
    ends = np.zeros(len(s))
    if kind == "cost offset":
        cost, truth = cost + 1e3, truth + 1e4
    elif kind == "large cost":
        cost, truth = 1e6 * cost, 1e6 * truth
    elif kind == "small cost":
        cost, truth = 1e-6 * cost, 1e-6 * truth
    elif kind == "duplicated":
        s, a, cost, following, ends = (np.repeat(x, 3, axis=0) for x in (s, a, cost, following, ends))
    elif kind == "terminal":
        ends = ends + 1.0
        truth = lq_plant.quadratic(lq_plant.W + lq_plant.GAIN.T @ lq_plant.R @ lq_plant.GAIN, GRID)
    return TransitionTable.from_arrays(s, a, cost, following, ends), truth


@pytest.mark.parametrize("kind", ["cost offset", "large cost", "small cost", "duplicated", "terminal"])
def test_scales_offsets_and_ends_do_not_spoil_the_value(kind: str) -> None:
    table, truth = hard(kind)
    config = ValueConfig(method="td", hidden=(32, 32), n_steps=600, learning_rate=1e-2, polyak=0.1)
    value = fit_value(table, lq_plant.DISCOUNT, config, seed=0)
    assert lq_plant.explained(truth, value.predict(GRID)) > 0.98


def test_units_of_the_state_and_constant_columns_do_not_matter() -> None:
    """x in units of 1e-3 and 1e5 around an offset, beside a column that never changes."""
    table, truth = hard("")
    unit = np.array([1e-3, 1e5])

    def widened(x: Any) -> Array:
        return np.hstack([unit * x, np.full((len(x), 1), 300.0)])

    wide = TransitionTable.from_arrays(
        widened(table.observations), table.actions, table.costs, widened(table.next_observations), table.terminations
    )
    config = ValueConfig(method="td", hidden=(32, 32), n_steps=600, learning_rate=1e-2, polyak=0.1)
    value = fit_value(wide, lq_plant.DISCOUNT, config, seed=0)
    assert lq_plant.explained(truth, value.predict(widened(GRID))) > 0.98


@pytest.mark.parametrize("method", ["auto", *VALUE_METHODS])
def test_fewer_rows_than_a_batch_are_enough(method: str) -> None:
    config = ValueConfig(method=method, tau=0.5, hidden=(32, 32), n_steps=400, learning_rate=1e-2, polyak=0.1)
    value = fit_value(lq_plant.policy_log(100), lq_plant.DISCOUNT, config, seed=0)
    truth = lq_plant.quadratic(lq_plant.policy_value(lq_plant.GAIN), GRID)
    assert lq_plant.explained(truth, value.predict(GRID)) > 0.9


@pytest.mark.parametrize("tau", [0.01, 0.99])
def test_extreme_expectiles_stay_between_the_bounds_of_the_cost(tau: float) -> None:
    """Errors that feed on themselves would leave [min L, max L] / (1 - gamma)."""
    rng = np.random.default_rng(0)
    x = lq_plant.float32_uniform(rng, 200, 2)
    table = TransitionTable.from_arrays(x, x[:, :1], rng.uniform(1.0, 2.0, size=200), x[::-1], np.zeros(200))
    config = ValueConfig(method="expectile", tau=tau, hidden=(32, 32), n_steps=400, learning_rate=1e-2, polyak=0.2)
    values = fit_value(table, 0.9, config, seed=0).predict(x)
    assert values.min() > 8.0
    assert values.max() < 22.0


# ---------------------------------------------------------------- losses that are not finite


def test_a_step_without_a_finite_loss_changes_nothing(monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    running = training(ValueConfig(**TINY))
    running.advance(10)
    loss = Residual.loss
    monkeypatch.setattr(Residual, "loss", lambda *arguments: loss(*arguments) * np.nan)
    before = running.to_arrays()
    with caplog.at_level(logging.WARNING, logger="mpcoffline.learning"):
        assert np.isnan(running.advance(5)["value_loss"])
    assert "(VALUE) skipped step 11: its loss or gradient is not finite" in caplog.text
    after = running.to_arrays()
    for name in before.keys() - {"counters"}:
        np.testing.assert_array_equal(after[name], before[name], err_msg=name)
    monkeypatch.undo()
    assert np.isfinite(running.advance(5)["value_loss"])


def test_a_lost_training_says_what_happened_and_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Residual, "loss", lambda self, V, *rest: V.weights[0].sum() * np.inf)
    with pytest.raises(MPCOfflineError, match=r"in 25 steps in a row, up to step 25.*Lower learning_rate .now 0.001"):
        fit_value(lq_plant.random_log(300), 0.9, ValueConfig(**TINY), seed=0)


def test_a_schedule_too_short_for_the_discount_is_told(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="mpcoffline.learning"):
        ValueTraining(lq_plant.random_log(50), 0.99, ValueConfig(method="td"), seed=0)
    assert "raise n_steps (8000) or polyak (0.01)" in caplog.text
    caplog.clear()
    ValueTraining(lq_plant.random_log(50), 0.9, ValueConfig(method="td"), seed=0)
    ValueTraining(lq_plant.random_log(50), 0.99, ValueConfig(method="td", polyak=None), seed=0)
    ValueTraining(lq_plant.random_log(50), 0.99, ValueConfig(), seed=0)  # the residual has no target
    assert not caplog.text


@pytest.mark.parametrize(
    ("n_steps", "discount", "rate"), [(3_000, 0.95, 0.02), (3_000, 0.97, 0.02), (3_000, 0.99, 0.05), (100, 0.99, 0.2)]
)
def test_a_rate_that_is_not_given_lets_v_settle(n_steps: int, discount: float, rate: float) -> None:
    """One and a half times the effective horizon, 1 / (1 - gamma), in n_steps; between 0.02 and 0.2."""
    assert ValueConfig(n_steps=n_steps, polyak=None).rate(discount) == pytest.approx(rate, rel=1e-6)
    assert ValueConfig(n_steps=n_steps, polyak=0.5).rate(discount) == 0.5
