"""Trajectories, and the transitions in them one by one: what every reader of another tool's layout must find."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable

Array = NDArray[np.float64]


class Episode(NamedTuple):
    """``s (T+1, 2)``, ``a (T, 1)``, ``cost (T,)``, none of them zero; all of them exact in float32."""

    s: Array
    a: Array
    cost: Array
    terminated: bool


def trajectories(lengths: Sequence[int] = (4, 1, 6), terminated: Sequence[bool] = (False, True, True)) -> list[Episode]:
    """No two numbers in them are the same, so that nothing exchanged or moved by a row stays unseen."""
    rng = np.random.default_rng(0)
    numbers = iter(rng.permutation(np.arange(1, 1000)) / 64.0 - 8.0 - 1.0 / 128.0)
    return [
        Episode(
            np.array([[next(numbers), next(numbers)] for _ in range(n + 1)]),
            np.array([[next(numbers)] for _ in range(n)]),
            np.array([next(numbers) for _ in range(n)]),
            end,
        )
        for n, end in zip(lengths, terminated, strict=True)
    ]


def assert_same(table: TransitionTable, episodes: Sequence[Episode], *, without_last: bool = False) -> None:
    """Compares a table with trajectories, transition by transition.

    Args:
        table: What a reader made of them.
        episodes: The trajectories.
        without_last: Whether the last transition of each is missing, as the observation that it led to is.
    """
    row = 0
    columns, ids = table.values(), table.episode_ids
    for episode in episodes:
        steps = len(episode.a) - without_last
        for k in range(steps):
            np.testing.assert_array_equal(columns.observations[row], episode.s[k])
            np.testing.assert_array_equal(columns.actions[row], episode.a[k])
            assert columns.costs[row] == episode.cost[k]
            np.testing.assert_array_equal(columns.next_observations[row], episode.s[k + 1])
            last = k == len(episode.a) - 1
            assert bool(columns.terminations[row]) == (last and episode.terminated)
            if row:
                assert (ids[row] == ids[row - 1]) == (k > 0)
            row += 1
    assert row == len(table)
