"""Closed loops that a reader looks at: from a few starts, on every model that the log leaves possible."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC
from mpcoffline.mpc.layout import Layout
from mpcoffline.simulation.episodes import Episodes
from mpcoffline.simulation.trials import Surroundings, Trials

from .marks import Marks, marks_of

SHOWN_OF = 64  # starts, the first ones, among which those that are shown are chosen


@dataclass(frozen=True)
class Loop:
    """What happens from one start: by the log, and by controllers on each model with a vote.

    Attributes:
        row: Where in the log.
        why: What is special about it.
        states: The log's from there, ``(T + 1, n)``; NaN after the end of its episode.
        actions: Likewise, ``(T, nu)``.
        states_on: Of each controller, ``(models, T + 1, n)``.
        actions_on: Likewise, ``(models, T, nu)``.
        marks: Set-points, limits, and what came from outside: the same for all.
    """

    row: int
    why: str
    states: Array = field(repr=False)
    actions: Array = field(repr=False)
    states_on: Mapping[str, Array] = field(repr=False)
    actions_on: Mapping[str, Array] = field(repr=False)
    marks: Marks = field(default_factory=Marks, repr=False)


def chosen_loops(
    trials: Trials,
    proposal: str,
    episodes: Mapping[str, Episodes],
    layout: Layout,
    around: Surroundings,
    given: MPC,
) -> tuple[Loop, ...]:
    """The start with the median gain, and those where the proposal gains most and least.

    Args:
        trials: What they cost; only models with a vote count.
        proposal: The controller that is judged.
        episodes: What each controller does from the first starts.
        layout: Of the states.
        around: The starts, and the transitions of which they are rows.
        given: MPC_1, which says what is to be followed and kept.

    Returns:
        Up to three loops; none where no model has a vote.
    """
    if not trials.votes.any():
        return ()
    kept = min(each.states_kept.shape[1] for each in episodes.values())
    chosen = _chosen(trials, proposal, kept)
    n, found = layout.n_states, []
    for k, why in chosen.items():
        states, actions = _logged(around.logged, int(around.rows[k]), around.n_steps)
        on = {name: each.states_kept[trials.votes, k, :, :n] for name, each in episodes.items()}
        inputs = {name: each.actions_kept[trials.votes, k] for name, each in episodes.items()}
        marks = marks_of(given, _outside(around, k, layout))
        found.append(Loop(int(around.rows[k]), why, states[:, :n], actions, on, inputs, marks))
    return tuple(found)


def _outside(around: Surroundings, k: int, layout: Layout) -> Array:
    """Observations along a start of which the signals are those of the simulations, ``(T + 1, ny)``."""
    begun, signals = np.asarray(around.starts[k])[: layout.ny], around.signals[k]
    held = np.broadcast_to(begun[: layout.n_states], (len(signals), layout.n_states))
    return np.vstack([begun, np.hstack([held, signals])])


def _chosen(trials: Trials, proposal: str, kept: int) -> dict[int, str]:
    """Which starts, and why."""
    if proposal == trials.names[0]:
        costs = np.median(trials.of(proposal)[trials.votes][:, :kept], axis=0)
        titles = ("A start of usual cost", "The cheapest of these starts", "The dearest of these starts")
    else:
        costs = np.median(trials.differences(proposal)[trials.votes][:, :kept], axis=0)
        titles = ("A usual start: the median gain", "Where it gains most", "Where it gains least, or loses most")
    known = np.flatnonzero(np.isfinite(costs))
    if not len(known):
        return {}
    order = known[np.argsort(costs[known], kind="stable")]
    found: dict[int, str] = {}
    for place, title in zip((len(order) // 2, 0, len(order) - 1), titles, strict=True):
        found.setdefault(int(order[place]), title)
    return found


def _logged(table: TransitionTable, row: int, n_steps: int) -> tuple[Array, Array]:
    """What the log did from a row on."""
    ids = table.episode_ids
    rows: NDArray[np.intp] = np.arange(row, min(row + n_steps, len(table)))
    rows = rows[ids[rows] == ids[row]]
    part = table.take(slice(int(rows[0]), int(rows[-1]) + 1)).values()
    states = np.full((n_steps + 1, part.observations.shape[1]), np.nan)
    actions = np.full((n_steps, part.actions.shape[1]), np.nan)
    states[: len(rows)], states[len(rows)] = part.observations, part.next_observations[-1]
    actions[: len(rows)] = part.actions
    return states, actions
