"""How long simulated episodes are, from those of the log."""

from __future__ import annotations

import numpy as np
import pytest

from mpcoffline import TransitionTable
from mpcoffline.simulation.surroundings import _usual_length


@pytest.mark.parametrize(
    ("lengths", "ended", "usual"),
    [
        ([50] * 8, [], 50),
        ([1799, 579, 1478, 10, 2, 5, 2, 7, 10, 16, 9, 20, 3, 184], [], 1478),  # fragments of a plant in operation
        ([12, 100, 30, 100], [0, 2], 100),  # what the plant ended is no usual length
        ([12, 30, 8], [0, 1, 2], 30),
    ],
)
def test_an_episode_is_as_long_as_that_in_which_half_of_the_rows_are_reached(
    lengths: list[int], ended: list[int], usual: int
) -> None:
    n, last = sum(lengths), np.cumsum(lengths) - 1
    s, over = np.arange(n, dtype=float)[:, None], np.zeros(n)
    over[last[ended]] = 1.0
    table = TransitionTable.from_arrays(s, s, np.zeros(n), s, over, np.repeat(np.arange(len(lengths)), lengths))
    assert _usual_length(table) == usual
