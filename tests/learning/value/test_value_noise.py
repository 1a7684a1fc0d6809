"""How noisy a log is, against noise of known size; and what "auto" makes of it."""

from __future__ import annotations

import logging

import lq_plant
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable
from mpcoffline.learning import ValueConfig
from mpcoffline.learning.value.fit import Expectile, ImplicitQ, ValueTraining, estimate_stochasticity

Array = NDArray[np.float64]


def noisy(table: TransitionTable, process: float = 0.0, measured: float = 0.0, paid: float = 0.0) -> TransitionTable:
    """Adds noise: in units of the std of s+ - s to s+, of the std of s to s and s+ apart, of the std of L to L."""
    rng = np.random.default_rng(1)
    s, following, cost = (c.astype(np.float64) for c in (table.observations, table.next_observations, table.costs))
    disturbance = process * (following - s).std(axis=0) * rng.normal(size=s.shape)
    errors = measured * s.std(axis=0) * rng.normal(size=(2, *s.shape))
    return TransitionTable.from_arrays(
        s + errors[0],
        table.actions,
        cost + paid * cost.std() * rng.normal(size=cost.shape),
        following + disturbance + errors[1],
        table.terminations,
    )


@settings(max_examples=8)
@given(process=st.floats(0.0, 2.0), paid=st.floats(0.0, 2.0))
def test_the_shares_are_those_of_the_noise(process: float, paid: float) -> None:
    found = estimate_stochasticity(noisy(lq_plant.random_log(4_000), process=process, paid=paid))
    # Noise of p standard deviations is p^2 / (1 + p^2) of all variance.
    assert found.change == pytest.approx(process**2 / (1.0 + process**2), abs=0.04)
    assert found.cost == pytest.approx(paid**2 / (1.0 + paid**2), abs=0.04)


@pytest.mark.parametrize(
    "task", ["pendulum", *(pytest.param(task, marks=pytest.mark.slow) for task in ("linear", "cartpole"))]
)
@pytest.mark.usefixtures("shipped")
def test_the_logs_that_ship_are_deterministic_and_noise_on_them_is_noticed(task: str) -> None:
    table = TransitionTable.from_minari(f"mpcoffline/{task}/ddpg-v0").trim(0.9)
    clean, measured = estimate_stochasticity(table), estimate_stochasticity(noisy(table, measured=0.05))
    assert max(clean.change, clean.cost) < 0.01
    assert 0.15 < measured.change < 0.35
    assert not measured.is_noisy
    assert estimate_stochasticity(noisy(table, process=2.0)).is_noisy
    assert estimate_stochasticity(noisy(table, paid=0.5)).is_noisy


@pytest.mark.parametrize("n", [1, 2, 30, 100])
def test_few_rows_of_a_deterministic_plant_are_not_called_noisy(n: int) -> None:
    assert not estimate_stochasticity(lq_plant.random_log(n)).is_noisy


def test_nothing_that_varies_is_no_noise() -> None:
    still = TransitionTable.from_arrays(
        np.ones((50, 2)), np.ones((50, 1)), np.full(50, 7.0), np.ones((50, 2)), np.zeros(50)
    )
    found = estimate_stochasticity(still)
    assert (found.change, found.cost) == (0.0, 0.0)


def test_the_seed_decides() -> None:
    table = noisy(lq_plant.random_log(500), process=0.3)
    assert estimate_stochasticity(table, seed=3) == estimate_stochasticity(table, seed=3)


@pytest.mark.parametrize(("process", "chosen"), [(0.0, Expectile(0.2)), (2.0, ImplicitQ(0.2))])
def test_auto_chooses_by_the_noise_and_says_so(
    process: float, chosen: Expectile | ImplicitQ, caplog: pytest.LogCaptureFixture
) -> None:
    table = noisy(lq_plant.random_log(1_000), process=process)
    with caplog.at_level(logging.INFO, logger="mpcoffline.learning"):
        training = ValueTraining(table, 0.9, ValueConfig(method="auto", tau=0.2, hidden=(4,)), seed=0)
    assert training.method == chosen
    assert training.stochasticity == estimate_stochasticity(table)
    assert f"learns by {chosen}: given (s, a), {100 * training.stochasticity.change:.1f} %" in caplog.text
