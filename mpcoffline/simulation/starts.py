"""Where simulated episodes begin, and what comes from outside along them: as the log has it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc.layout import Layout

_FEW = 5  # episodes
_ROWS = 50_000  # of the log that are looked at for states like those in which episodes begin
_NEAR = 0.1  # spreads of all states: of one that is always the same at the beginning, too, what is as near is alike


def initial_rows(
    table: TransitionTable, count: int, seed: int, seen: int | None = None, spare: int = 0
) -> NDArray[np.intp]:
    """Rows in which the log's own episodes began, and where there are too few, others in states like those.

    These are the rows nearest to states that are drawn from the first ones' distribution, a smoothed one
    (Silverman and Young, doi:10.1093/biomet/74.3.469), each row once. A controller that fails from one of thirty
    states would else be found by chance alone; and one that the log never left, as at the begin of a runaway, is no
    initial state. Of a log of hardly any episodes rows anywhere.

    Args:
        table: The transitions.
        count: How many rows.
        seed: Draws them.
        seen: How many columns of s make states alike, the first ones; all by default.
        spare: How many more, for where these do not suffice.

    Returns:
        The rows, ``(count + spare,)``, each of the two parts in random order.
    """
    rng, (_, firsts, _) = np.random.default_rng(seed), table.episodes
    chosen = rng.permutation(firsts)[: count + spare]
    more = count + spare - len(chosen)
    if more and len(firsts) < _FEW:
        chosen = np.concatenate([chosen, rng.integers(len(table), size=more)])
    elif more:
        chosen = np.concatenate([chosen, _like_the_first(table, firsts, more, rng, seen)])
    return np.concatenate([rng.permutation(chosen[:count]), chosen[count:]]).astype(np.intp)


def _like_the_first(
    table: TransitionTable, firsts: NDArray[np.intp], count: int, rng: np.random.Generator, seen: int | None
) -> NDArray[np.intp]:
    """Rows nearest to draws from the smoothed distribution of the first states, no row twice while there are others."""
    others = np.setdiff1d(np.arange(len(table)), firsts)
    others = others if len(others) <= _ROWS else np.sort(rng.permutation(others)[:_ROWS])
    if len(others) < count:
        return np.asarray(rng.choice(firsts, size=count))
    states = np.asarray(table.observations[others, :seen], dtype=np.float64)
    first = np.asarray(table.observations[firsts, :seen], dtype=np.float64)
    mean, (n, d) = first.mean(axis=0), first.shape
    width = (4.0 / ((d + 2) * n)) ** (1.0 / (d + 4))  # Silverman's
    about = first - mean
    moved = about[rng.integers(n, size=count)] + width * rng.standard_normal((count, n)) @ about / np.sqrt(n)
    drawn = mean + moved / np.sqrt(1.0 + width**2)
    scale = np.hypot(about.std(axis=0), _NEAR * states.std(axis=0))
    scale, found = np.where(scale > 0.0, scale, 1.0), np.empty(count, dtype=np.intp)
    for i, state in enumerate(drawn):
        found[i] = np.argmin(np.square((states - state) / scale).sum(axis=1))
        states[found[i]] = np.inf
    return np.asarray(others[found])


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


def cheapest_step(table: TransitionTable) -> float:
    """What the cheapest step of a log cost; no more than nothing where an episode has ended, whose rest is free."""
    columns = table.values()
    return min(float(columns.costs.min()), 0.0 if np.any(columns.terminations) else np.inf)


def costs_before(logged: TransitionTable, table: TransitionTable, rows: NDArray[np.intp], steps: int) -> Array:
    """What the log cost in the first steps of its episodes, which a table with past inputs cannot hold.

    What acts that late changes no state in these steps: whoever controls, they cost what was logged, nearly.

    Args:
        logged: The transitions as they were logged.
        table: Those with past inputs beside the observations.
        rows: Of the table.
        steps: How far back the past inputs reach.

    Returns:
        The costs, ``(rows,)``; 0 for a row that does not stand so many steps after the begin of an episode.
    """
    all_ids, all_firsts, all_lengths = logged.episodes
    ids, firsts, lengths = table.episodes
    k = np.searchsorted(all_ids, ids)
    whole = all_lengths[k] - lengths == steps  # else rows are left out elsewhere, too
    begun = dict(zip(firsts[whole].tolist(), all_firsts[k][whole].tolist(), strict=True))
    found = np.zeros(len(rows))
    for i, row in enumerate(rows.tolist()):
        if row in begun:
            found[i] = logged.take(slice(begun[row], begun[row] + steps)).values().costs.sum()
    return found
