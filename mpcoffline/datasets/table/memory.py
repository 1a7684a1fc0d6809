"""Tables with past inputs beside each observation, and tables of what the plant's map alone is given.

All are gathers of packed columns: no number changes, and a table that is a memory map gives another one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.types import Array

from .centring import Centring
from .math import CHUNK
from .transitions import TransitionTable

if TYPE_CHECKING:
    from mpcoffline.mpc.layout import Layout

_CUT = 1e-3  # share of the pairs of measurements of one state that may be taken for a gap
_ROUNDING = 1e-5  # of a coordinate's spread

Indices = Sequence[int] | NDArray[np.intp]


def with_memory(table: TransitionTable, layout: Layout, usual: Array | None = None) -> TransitionTable:
    """The table with the past inputs that an MPC's state holds as further coordinates of s and s+.

    They come from the rows before of the same episode, without a gap between. Rows of which not all past inputs are
    known, the first ones of each episode and those after a gap, are left out: what was applied before them would be a
    guess.

    Args:
        table: Transitions, ``ny`` coordinates each.
        layout: Which past inputs.
        usual: The input that counts as applied before an episode begins, ``(nu,)``: its first rows are kept then.

    Returns:
        A table of ``layout.nx`` coordinates; the given one where the layout holds no memory.

    Raises:
        InvalidDataError: For a table of other sizes, or if no episode is longer than the memory reaches back.
    """
    table.check_fits(layout.ny, layout.nu)
    if not layout.n_memory:
        return table
    before = rows_before(table)
    known = before >= layout.steps
    if usual is not None:
        known |= np.isin(np.arange(len(table)) - before, table.episodes.firsts)
    kept = np.flatnonzero(known)
    if not len(kept):
        raise InvalidDataError(
            f"{table.name}: episodes",
            expected=f"more than {layout.steps} consecutive rows, as inputs of {layout.steps} steps before are needed",
            actual=f"at most {int(before.max(initial=-1)) + 1}",
            hint="Is the delay given in sampling steps? Keep the rows of an episode together and in time order.",
        )
    ny, nu = table.ny, table.nu
    inputs, ages = layout.ages
    centre = table.centring.centre
    of_past = centre[ny + inputs]
    filled = np.asarray(0.0 * of_past if usual is None else layout.filled(usual) - of_past, dtype=np.float32)

    def blocks() -> Iterator[tuple[NDArray[np.float32], NDArray[np.int64]]]:
        for part in (kept[i : i + CHUNK] for i in range(0, len(kept), CHUNK)):
            rows = table.rows[part]
            first = max(int(part[0]) - layout.steps, 0)
            actions = np.ascontiguousarray(table.rows[first : int(part[-1]) + 1, ny : ny + nu])
            past, next_past = (
                np.where(age <= before[part, None], actions[np.maximum(row - age, first) - first, inputs], filled)
                for row, age in ((part[:, None], ages), (part[:, None], ages - 1))
            )
            joined = [rows[:, :ny], past, rows[:, ny : 2 * ny + nu + 1], next_past, rows[:, -1:]]
            yield np.hstack(joined), table.episode_ids[part]

    joined = [centre[:ny], of_past, centre[ny : 2 * ny + nu + 1], of_past, centre[-1:]]
    increments = np.append(table.centring.increments, np.zeros(layout.n_memory, dtype=bool))
    return table.rewritten(blocks(), centring=Centring(np.concatenate(joined), increments), sizes=(layout.nx, nu))


def remembering(table: TransitionTable, layout: Layout) -> TransitionTable:
    """:func:`with_memory` of some consecutive rows: empty where no past inputs are known of any of them."""
    try:
        return with_memory(table, layout)
    except InvalidDataError:
        return table.take(slice(0, 0))


def gathered(table: TransitionTable, states: Indices, inputs: Indices | None = None) -> TransitionTable:
    """A table of some of the columns.

    Args:
        table: Transitions.
        states: Which coordinates of s and s+ stay.
        inputs: What is an input: places in [s, a]; the inputs by default.
    """
    ny, nu = table.ny, table.nu
    s = np.asarray(states, dtype=np.intp)
    a = np.arange(ny, ny + nu) if inputs is None else np.asarray(inputs, dtype=np.intp)
    columns = np.concatenate([s, a, [ny + nu], ny + nu + 1 + s, [2 * ny + nu + 1]])
    centring = Centring(table.centring.centre[columns], table.centring.increments[s])
    parts = (slice(i, i + CHUNK) for i in range(0, len(table), CHUNK))
    blocks = ((np.ascontiguousarray(table.rows[part][:, columns]), table.episode_ids[part]) for part in parts)
    return table.rewritten(blocks, centring=centring, sizes=(len(s), len(a)))


def plant_table(table: TransitionTable, layout: Layout) -> TransitionTable:
    """What the plant's map is given: its states and, as inputs, those that act; from a table of states z."""
    return table if layout.is_plain else gathered(table, range(layout.n_states), layout.acting)


def with_plant_states(table: TransitionTable, plant: TransitionTable) -> TransitionTable:
    """The table of states z with the plant's states of a :func:`plant_table` of the same rows."""
    if plant.ny == table.ny:
        return plant
    n, ny, nu = plant.ny, table.ny, table.nu

    def blocks() -> Iterator[tuple[NDArray[Any], NDArray[np.int64]]]:
        for part in (slice(i, i + CHUNK) for i in range(0, len(table), CHUNK)):
            rows, own = table.rows[part].copy(), plant.rows[part]
            rows[:, :n], rows[:, ny + nu + 1 : ny + nu + 1 + n] = own[:, :n], own[:, n + plant.nu + 1 : -1]
            yield rows, table.episode_ids[part]

    return table.rewritten(blocks())


def rows_before(table: TransitionTable) -> NDArray[np.intp]:
    """How many rows come before each without a break, ``(n,)``: of the same episode, each beginning where one ended.

    Where s+ of a row and s of the next are two measurements of one state, they may differ as such measurements do.
    """
    n = len(table)
    ids, goes_on = table.episode_ids, np.zeros(n, dtype=bool)
    size = _size_of_differences(table)
    limit = scipy.stats.chi2(table.ny).isf(_CUT)
    for start in range(0, n - 1, CHUNK):
        block = table.take(slice(start, start + CHUNK + 1))
        within = (ids[start + 1 : start + len(block)] == ids[start : start + len(block) - 1]) & (
            block.terminations[:-1] == 0.0
        )
        if size is None:
            within &= block.goes_on()
        else:
            values = block.values()
            missed = (values.next_observations[:-1] - values.observations[1:]) / size
            within &= np.sum(missed**2, axis=1) <= limit
        goes_on[start + 1 : start + len(block)] = within
    firsts = np.where(goes_on, 0, np.arange(n))
    return np.asarray(np.arange(n) - np.maximum.accumulate(firsts))


def _size_of_differences(table: TransitionTable) -> NDArray[np.float64] | None:
    """How much two measurements of one state differ, ``(ny,)``; None where states are measured once."""
    block = table.take(slice(0, CHUNK))
    within = (block.episode_ids[1:] == block.episode_ids[:-1]) & (block.terminations[:-1] == 0.0)
    if not within.any() or block.goes_on()[within].mean() >= 0.5:
        return None
    values = block.values()
    difference = np.abs(values.next_observations[:-1] - values.observations[1:])[within]
    spread = values.observations.std(axis=0)
    return np.asarray(1.4826 * np.median(difference, axis=0) + _ROUNDING * np.where(spread > 0.0, spread, 1.0))
