"""Where episodes end, and at what price: against the rules that the logs were made with."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable
from mpcoffline.simulation.end_prices import EndPrices
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


def landings(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """States in which landers touch down, and what that costs: 100, or -100 where they are slow and upright."""
    s = rng.uniform(-1.0, 1.0, (count, 4)) * [5.0, 0.1, 3.0, 30.0]  # place, height, speed, degrees
    return s, np.where((np.abs(s[:, 2]) < 1.2) & (np.abs(s[:, 3]) < 15.0), -100.0, 100.0)


@pytest.mark.parametrize("count", [80, 150, 400])
def test_the_price_of_an_end_by_the_state_that_it_is_reached_with(count: int) -> None:
    """Good and bad landings are told apart; the median alone would make every landing as bad as most of the log's."""
    rng = np.random.default_rng(0)
    states, prices = landings(rng, count)
    found = EndPrices.of(states, prices + rng.normal(size=count), 0)
    assert found is not None
    fresh, true = landings(rng, 2_000)
    told = found(fresh)
    assert np.mean((told < 0.0) == (true < 0.0)) > 0.75
    assert told[true < 0.0].mean() < told[true > 0.0].mean() - 100.0
    soft, hard = found(np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, -2.5, 25.0]]))
    np.testing.assert_allclose([soft, hard], [-100.0, 100.0], atol=1.0)
    np.testing.assert_array_equal(found(np.hstack([fresh, np.ones((len(fresh), 2))])), told)  # past inputs beside them


def test_the_price_of_an_end_that_is_a_product() -> None:
    """A batch whose product counts at the end, concentration times volume: within the prices that were logged."""
    rng = np.random.default_rng(1)

    def batches(count: int) -> tuple[Array, Array]:
        s = np.column_stack([rng.uniform(1.0, 4.0, count), rng.uniform(8.0, 12.0, count)])
        return s, -s[:, 0] * s[:, 1]

    states, prices = batches(40)
    found = EndPrices.of(states, prices, 0)
    assert found is not None
    fresh, true = batches(500)
    assert np.std(found(fresh) - true) < 0.1 * true.std()
    np.testing.assert_array_equal(found(np.array([[100.0, 100.0]])), prices.min())


def test_two_levels_that_no_state_tells_are_one_number() -> None:
    rng = np.random.default_rng(3)
    assert EndPrices.of(rng.normal(size=(60, 3)), np.where(rng.random(60) < 0.3, -100.0, 100.0), 0) is None


@pytest.mark.parametrize("count", [5, 60])
def test_a_price_that_no_state_tells_is_one_number(count: int) -> None:
    rng = np.random.default_rng(2)
    assert EndPrices.of(rng.normal(size=(count, 3)), 30.0 + rng.normal(size=count), 0) is None
    assert EndPrices.of(rng.normal(size=(count, 3)), np.full(count, 30.0), 0) is None


@pytest.mark.parametrize(("each", "price", "good"), [(1.0, 0.0, True), (-1.0, 0.0, False), (0.0, -5.0, True)])
def test_whether_an_end_is_a_goal(each: float, price: float, good: bool) -> None:
    """Where every step costs 1 it is, where each is paid 1 it is none, and where it alone is paid it is."""
    table = walks(lambda s: s[0] > 0.8, 0.0)
    columns = table.values()
    ends = columns.terminations > 0.0
    costs = np.where(ends, each + price, each)
    parts = columns.observations, columns.actions, costs, columns.next_observations, columns.terminations
    cost = LoggedCost(TransitionTable.from_arrays(*parts, table.episode_ids))
    assert bool((cost.ends.paid(columns.next_observations[ends]) < cost.ends.good_below).all()) is good


def test_an_end_far_out_without_a_price_is_no_goal() -> None:
    cost = LoggedCost(walks(lambda s: s[0] > 0.8, 0.0))
    assert not (cost.ends.paid(states()) < cost.ends.good_below).any()
