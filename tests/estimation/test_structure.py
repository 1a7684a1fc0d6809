"""What is held out of a log: whole episodes where these are alike, pieces of them where they are not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mpcoffline.estimation.structure import HeldOut


def episodes_of(*lengths: int) -> np.ndarray:
    return np.repeat(np.arange(len(lengths)), lengths)


@pytest.mark.parametrize("seed", range(5))
def test_of_episodes_that_are_alike_a_quarter_is_held_out_whole(seed: int) -> None:
    episodes = episodes_of(*[50] * 20)
    held = HeldOut.of(episodes, seed).rows
    assert held.mean() == 0.25
    assert all(len(np.unique(held[episodes == e])) == 1 for e in range(20))


@pytest.mark.parametrize("seed", range(30))
def test_of_a_few_long_stretches_and_many_fragments_a_quarter_of_the_rows_is(seed: int) -> None:
    """Of a plant in operation: a quarter of its episodes may be a hundredth of its rows, or nine tenths."""
    held = HeldOut.of(episodes_of(1799, 579, 1478, 10, 2, 5, 2, 7, 10, 16, 9, 20, 3, 184), seed).rows
    assert 0.15 <= held.mean() <= 0.35


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(1, 400), min_size=1, max_size=30), st.integers(0, 1000))
def test_something_is_held_out_and_something_is_left(lengths: list[int], seed: int) -> None:
    episodes = episodes_of(*lengths)
    if len(episodes) < 8:
        return
    held, again = (HeldOut.of(episodes, seed).rows for _ in range(2))
    np.testing.assert_array_equal(held, again)
    assert 0 < held.sum() < len(episodes)
    assert held.mean() <= 0.5
