"""Where episodes end, and at what price: against the rules that the logs were made with."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable
from mpcoffline.simulation.logged_cost import LoggedCost

Array = NDArray[np.float64]


def walks(over: Callable[[Array], bool], price: float, *, noise: float = 0.0, seed: int = 0) -> TransitionTable:
    """Random walks in three coordinates from [-0.5, 0.5]^3 that cost |s|^2 a step, and a price where they end."""
    rng, rows = np.random.default_rng(seed), []
    for e in range(100):
        s = rng.uniform(-0.5, 0.5, 3)
        for _ in range(30):
            a = 0.2 * rng.normal(size=1)
            reached = s + np.array([a[0], 0.0, 0.0]) + 0.1 * rng.normal(size=3)
            ended = over(reached)
            measured = (v + noise * rng.normal(size=3) for v in (s, reached))
            rows.append((next(measured), a, s @ s + price * ended, next(measured), ended, e))
            s = reached
            if ended:
                break
    s, a, costs, reached, ends, ids = map(np.array, zip(*rows, strict=True))
    return TransitionTable.from_arrays(s, a, costs, reached, ends, ids)


def states(seed: int = 9) -> Array:
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (2_000, 3))


@pytest.mark.parametrize("price", [30.0, -4.0])
def test_limits_of_one_coordinate_and_the_price_beyond_them(price: float) -> None:
    cost = LoggedCost(walks(lambda s: not -0.8 < s[0] < 1.0, price, noise=0.005))
    s = states()
    clear = np.minimum(np.abs(s[:, 0] + 0.8), np.abs(s[:, 0] - 1.0)) > 0.05
    np.testing.assert_array_equal(cost.ended(s, s[:, :1], s)[clear], ((s[:, 0] < -0.8) | (s[:, 0] > 1.0))[clear])
    assert cost.end_price == pytest.approx(price, abs=0.1)
    np.testing.assert_allclose(
        cost(0.5 * s, s[:, :1], 0.5 * s), np.sum((0.5 * s) ** 2, axis=1), atol=0.05
    )  # without the price
    assert "s0 >" in str(cost)
    assert "s0 <" in str(cost)


def test_ends_that_a_quadratic_tells() -> None:
    cost = LoggedCost(walks(lambda s: float(s @ s) > 1.0, 5.0))
    s = states()
    square = np.sum(s**2, axis=1)
    clear = np.abs(square - 1.0) > 0.15
    assert np.mean(cost.ended(s, s[:, :1], s)[clear] == (square > 1.0)[clear]) > 0.98
    assert cost.end_price == pytest.approx(5.0, abs=0.05)


def test_ends_that_the_state_does_not_tell() -> None:
    """As of a plant that is switched off at random: no simulated episode ends, and the sentence says why."""
    rng = np.random.default_rng(1)
    cost = LoggedCost(walks(lambda s: rng.random() < 0.02, 0.0))
    s = states()
    assert np.mean(cost.ended(s, s[:, :1], s / 3.0)) < 0.01
    assert "do not tell why" in str(cost) or cost.ends.found < 0.2


def test_a_log_without_ends() -> None:
    cost = LoggedCost(walks(lambda s: False, 0.0))
    s = states()
    assert not cost.ended(s, s[:, :1], s).any()
    assert cost.end_price == 0.0
    assert "end" not in str(cost).split("episodes")[-1]


def test_a_scaled_cost_scales_the_price() -> None:
    def over(s: Array) -> bool:
        return bool(s[0] > 0.8)

    table = walks(over, 30.0)
    columns = table.values()
    changed = TransitionTable.from_arrays(
        columns.observations,
        columns.actions,
        1e3 * columns.costs + 5e4,
        columns.next_observations,
        columns.terminations,
        table.episode_ids,
    )
    assert LoggedCost(changed).end_price == pytest.approx(1e3 * LoggedCost(table).end_price, rel=1e-3)
