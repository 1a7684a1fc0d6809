"""How long simulated episodes are, from those of the log, and how many."""

from __future__ import annotations

import numpy as np
import pytest

from mpcoffline import MPC, Model, QuadraticCost, TransitionTable
from mpcoffline.simulation.surroundings import _usual_length, affordable_starts


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


@pytest.mark.parametrize(
    ("nx", "horizon", "n_steps", "starts"),
    [
        (4, 30, 100, 64),
        (4, 20, 1_000, 27),
        (10, 30, 80, 24),  # 80 x 30 x 12^2 x 10 products, 8e7 / 3.456e6 = 23
        (32, 30, 100, 24),
        (2, 400, 4_000, 24),
    ],
)
def test_large_problems_begin_from_fewer_starts(nx: int, horizon: int, n_steps: int, starts: int) -> None:
    model = Model(lambda x, u, p: 0.9 * x + u[0], nx=nx, nu=2, dt=1.0, discrete=True)
    cost, bounds = QuadraticCost(W=np.eye(nx), R=np.eye(2)), {"action_low": [-1.0] * 2, "action_high": [1.0] * 2}
    assert affordable_starts(MPC(model, cost, cost, horizon=horizon, discount=1.0, **bounds), n_steps) == starts
