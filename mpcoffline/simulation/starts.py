"""Where simulated episodes begin, and what comes from outside along them: as the log has it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc.layout import Layout

_FEW = 5  # episodes
_EARLY = 0.2  # of an episode


def initial_rows(table: TransitionTable, count: int, seed: int) -> NDArray[np.intp]:
    """Rows in which the log's own episodes began, in random order.

    Where there are too few, further ones early in an episode, which are nearly such; of a log of hardly any episodes
    rows anywhere.
    """
    rng, (_, firsts, lengths) = np.random.default_rng(seed), table.episodes
    chosen = rng.permutation(firsts)[:count]
    more = count - len(chosen)
    if more and len(firsts) < _FEW:
        chosen = np.concatenate([chosen, rng.integers(len(table), size=more)])
    elif more:
        k = rng.integers(len(firsts), size=more)
        late = np.ceil(_EARLY * rng.uniform(size=more) * lengths[k]).astype(np.intp)
        chosen = np.concatenate([chosen, firsts[k] + np.minimum(late, lengths[k] - 1)])
    return np.asarray(rng.permutation(chosen), dtype=np.intp)


def signals_along(table: TransitionTable, rows: NDArray[np.intp], n_steps: int, layout: Layout) -> Array:
    """The signals that were logged after some rows, ``(count, n_steps, ny - n_states)``: one after each step.

    Where an episode ends before, its signals go on as they would along a horizon.
    """
    n, ny, length = layout.n_states, layout.ny, len(table)
    reached, ids = table.next_observations[:, n:ny], table.episode_ids
    now = np.asarray(table.observations[rows, n:ny], dtype=np.float64)
    found, goes_on = [], np.ones(len(rows), dtype=bool)
    still, none = np.zeros((len(rows), n)), np.zeros((len(rows), layout.n_memory + layout.nu))
    for k in range(n_steps):
        row = np.minimum(rows + k, length - 1)
        goes_on &= (rows + k < length) & (ids[row] == ids[rows])
        z, u = np.split(np.hstack([still, now, none]), [layout.nx], axis=1)
        now = np.where(goes_on[:, None], reached[row], layout.joined(still, z, u)[:, n:ny])
        found.append(now)
    return np.stack(found, axis=1)


def returns_along(table: TransitionTable, rows: NDArray[np.intp], n_steps: int) -> Array:
    """What the log cost over the steps that begin in some rows, ``(rows,)``.

    An episode that ends in a terminal state costs nothing afterwards; one that is cut off before ``n_steps`` gives NaN.
    """
    lasts = np.append(np.sort(table.episodes.firsts)[1:], len(table)) - 1  # ids need not rise
    own = lasts[np.searchsorted(lasts, rows)]
    ends = np.minimum(own, rows + n_steps - 1)
    total = np.concatenate([[0.0], np.cumsum(table.values().costs)])
    whole = (rows + n_steps - 1 <= own) | (np.asarray(table.terminations)[own] > 0.0)
    return np.where(whole, total[ends + 1] - total[rows], np.nan)
