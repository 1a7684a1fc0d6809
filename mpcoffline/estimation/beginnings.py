"""What was applied before episodes began, where an MPC's state holds past inputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.memory import rows_before
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC
from mpcoffline.mpc.layout import Layout

_MOST, _LEAST = 200, 5  # episodes
_BETTER, _ERRORS = 0.95, 3.0  # of the squares that are missed; standard errors of the difference

Costs = Callable[[TransitionTable], Array]


def beginnings(table: TransitionTable, layout: Layout, seed: int = 0) -> TransitionTable | None:
    """The first rows of episodes, as many as the memory of a layout reaches back; None where there is nothing to see.

    Args:
        table: Transitions as they were logged.
        layout: What past inputs are needed.
        seed: Draws the episodes, where there are very many.
    """
    _, firsts, lengths = table.episodes
    if not layout.n_memory or len(firsts) < _LEAST:
        return None
    chosen = np.sort(np.random.default_rng(seed).permutation(len(firsts))[:_MOST])
    rows = [np.arange(firsts[i], firsts[i] + min(lengths[i], layout.steps)) for i in chosen]
    return table.take(np.concatenate(rows))


def applied_before(mpc: MPC, rows: TransitionTable, costs: Costs | None = None) -> Array | None:
    """The input that explains best, as the one applied before each episode, what these began with, ``(nu,)``.

    Least squares of what the model misses of the first states reached, in spreads of the increments; and of what the
    stage cost misses of the first costs, where it has a price on changes::

        min_v  sum |(f(z(v), u) - x+) / scale|^2  +  ((Lhat(z(v), u) - L) / scale)^2

    Args:
        mpc: The MPC, its model identified.
        rows: Of :func:`beginnings`.
        costs: The logged costs of a table in the unit of the MPC's stage cost; None where it is not the logged one.

    Returns:
        None where that is no better, beyond three standard errors over the episodes, than the input that the MPC takes
        for it already (:attr:`~mpcoffline.MPC.usual_input`).
    """
    layout, given, n = mpc.layout, mpc.usual_input, mpc.layout.n_states
    before, (inputs, ages) = rows_before(rows), layout.ages
    unknown = ages > before[:, None]
    rows, before, unknown = _some(rows, before, unknown)
    values = rows.values()
    episodes = np.cumsum(before == 0) - 1
    if episodes[-1] + 1 < _LEAST:
        return None
    past = values.actions[np.maximum(np.arange(len(rows))[:, None] - ages, 0), inputs]
    moved = (values.next_observations - values.observations)[:, :n].std(axis=0)
    scale, priced = np.where(moved > 0.0, moved, 1.0), None
    if costs is not None and layout.has_previous:
        logged = costs(rows)
        priced = logged, float(logged.std()) or 1.0

    def missed(applied: Array) -> Array:
        z = np.hstack([values.observations, np.where(unknown, layout.filled(applied), past)])
        found = (mpc.model(z, values.actions) - np.hstack([values.next_observations, z[:, mpc.ny :]]))[:, :n] / scale
        if priced is not None:
            stage = mpc.stage_costs(z, values.actions)
            found = np.hstack([found, ((stage - priced[0]) / priced[1])[:, None]])
        return np.asarray(np.nan_to_num(found, nan=0.0, posinf=1e6, neginf=-1e6))

    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    size = np.where((spread := values.actions.std(axis=0)) > 0.0, spread, 1.0)
    start = np.clip(values.actions.mean(axis=0), low, high)

    def residuals(applied: Array) -> Array:
        return missed(applied).ravel()

    found = scipy.optimize.least_squares(residuals, start, bounds=(low, high), x_scale=size)
    seen = np.abs(cast("Array", found.jac)).max(axis=0) > 0.0
    best = np.where(seen, found.x, given)  # of what nothing depends on nothing is known
    return best if _is_better(missed(best), missed(given), episodes) else None


def _some(
    rows: TransitionTable, before: NDArray[np.intp], unknown: NDArray[np.bool_]
) -> tuple[TransitionTable, NDArray[np.intp], NDArray[np.bool_]]:
    """Up to the first gap in each episode: what was applied in a gap is another matter."""
    ids, index = rows.episode_ids, np.arange(len(rows))
    begun = np.flatnonzero(np.append(True, ids[1:] != ids[:-1]))
    within = index - begun[np.searchsorted(begun, index, side="right") - 1] == before
    kept = np.flatnonzero(within)
    return rows.take(kept), before[kept], unknown[kept]


def _is_better(missed: Array, given: Array, episodes: NDArray[np.intp]) -> bool:
    """Whether less is missed, beyond what episodes differ by; its roots, of which a few large ones decide less."""
    less, more = (np.sqrt(np.bincount(episodes, np.sum(each**2, axis=1))) for each in (missed, given))
    gain = more - less
    error = gain.std(ddof=1) / np.sqrt(len(gain))
    return bool(np.sum(less**2) < _BETTER * np.sum(more**2) and gain.mean() > _ERRORS * error)
