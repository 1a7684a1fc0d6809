"""Where simulated episodes begin, and what comes from outside along them: as the log has it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc.layout import Layout


def initial_rows(table: TransitionTable, count: int, seed: int) -> NDArray[np.intp]:
    """Rows in which the log's own episodes began, at random; further rows where there are too few episodes."""
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(table.episodes.firsts)[:count]
    if len(chosen) < count:
        chosen = np.concatenate([chosen, rng.integers(len(table), size=count - len(chosen))])
    return np.sort(chosen)


def signals_along(table: TransitionTable, rows: NDArray[np.intp], n_steps: int, layout: Layout) -> Array:
    """The signals that were logged after some rows, ``(count, n_steps, ny - n_states)``: one after each step.

    Where an episode ends before, its signals go on as they would along a horizon.
    """
    n, ny, length = layout.n_states, layout.ny, len(table)
    moved = layout.sources[: ny - n] - n
    reached, ids = table.next_observations[:, n:ny], table.episode_ids
    now = np.asarray(table.observations[rows, n:ny], dtype=np.float64)
    found, goes_on = [], np.ones(len(rows), dtype=bool)
    for k in range(n_steps):
        row = np.minimum(rows + k, length - 1)
        goes_on &= (rows + k < length) & (ids[row] == ids[rows])
        now = np.where(goes_on[:, None], reached[row], now[:, moved])
        found.append(now)
    return np.stack(found, axis=1)


def returns_along(table: TransitionTable, rows: NDArray[np.intp], n_steps: int) -> Array:
    """What the log cost over the steps that begin in some rows, ``(rows,)``.

    An episode that ends in a terminal state costs nothing afterwards; one that is cut off before ``n_steps`` gives NaN.
    """
    lasts = np.append(table.episodes.firsts[1:], len(table)) - 1
    own = lasts[np.searchsorted(lasts, rows)]
    ends = np.minimum(own, rows + n_steps - 1)
    total = np.concatenate([[0.0], np.cumsum(table.values().costs)])
    whole = (rows + n_steps - 1 <= own) | (np.asarray(table.terminations)[own] > 0.0)
    return np.where(whole, total[ends + 1] - total[rows], np.nan)
