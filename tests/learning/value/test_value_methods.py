"""The methods against independent truth: a gamble with known expectiles, and dynamic programming on a grid."""

from __future__ import annotations

import lq_plant
import numpy as np
import pytest
from grid_dp import GridOptimum

from mpcoffline.datasets import TransitionTable
from mpcoffline.learning import ValueConfig, fit_value

DISCOUNT = 0.9


def gamble() -> TransitionTable:
    """From 0 either pay 2.2 and stop, or go at no cost to 1 or -1, equally likely, where stopping costs 5 or 0."""
    s = np.array([0.0, 0.0, 0.0, 0.0, 1.0, -1.0])
    a = np.array([-1.0, -1.0, 1.0, 1.0, 0.0, 0.0])
    cost = np.array([2.2, 2.2, 0.0, 0.0, 5.0, 0.0])
    following = np.array([0.0, 0.0, 1.0, -1.0, 1.0, -1.0])
    ends = np.array([1.0, 1.0, 0.0, 0.0, 1.0, 1.0])
    rows = [np.tile(column, 40) for column in (s, a, cost, following, ends)]
    return TransitionTable.from_arrays(rows[0][:, None], rows[1][:, None], rows[2], rows[3][:, None], rows[4])


def expectile(samples: list[float], tau: float) -> float:
    """The number e that balances tau (samples above e) against (1 - tau) (samples below), by bisection."""
    x, low, high = np.array(samples), min(samples), max(samples)
    for _ in range(60):
        middle = 0.5 * (low + high)
        pull = np.where(x > middle, tau, 1.0 - tau) * (x - middle)
        low, high = (middle, high) if pull.sum() > 0.0 else (low, middle)
    return low


@pytest.mark.parametrize(
    ("method", "seen"),
    [
        ("expectile", [2.2, 2.2, DISCOUNT * 5.0, 0.0]),  # one by one: the best of the luck counts
        ("iql", [2.2, 2.2, DISCOUNT * 2.5, DISCOUNT * 2.5]),  # averaged over the luck first
    ],
)
def test_iql_averages_over_luck_where_the_expectile_of_samples_is_optimistic(method: str, seen: list[float]) -> None:
    tau = 0.1
    config = ValueConfig(
        method=method, tau=tau, hidden=(16,), n_steps=700, batch_size=120, learning_rate=2e-2, polyak=0.2
    )
    found = fit_value(gamble(), DISCOUNT, config, seed=0).predict([[0.0], [1.0], [-1.0]])
    np.testing.assert_allclose(found, [expectile(seen, tau), 5.0, 0.0], atol=0.06)
    optimum = min(2.2, DISCOUNT * 2.5)
    assert (found[0] < 0.5 * optimum) == (method == "expectile")


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_the_swing_ups_value_is_that_of_dynamic_programming() -> None:
    table = TransitionTable.from_minari("mpcoffline/pendulum/ddpg-v0").trim(0.9)
    config = ValueConfig(
        method="expectile", hidden=(64, 64), n_steps=2_000, batch_size=128, learning_rate=3e-3, polyak=0.03
    )
    value = fit_value(table, DISCOUNT, config, seed=0)
    optimum = GridOptimum(n_angles=100, n_speeds=101, n_actions=11, discount=DISCOUNT)
    y = table.observations[::20].astype(np.float64)
    truth = optimum.value(np.stack([np.arctan2(y[:, 1], y[:, 0]), y[:, 2]], axis=-1))
    assert lq_plant.explained(truth, value.predict(y)) > 0.97
