"""How inputs move from step to step: whether they do so at a limit that the description does not state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.text import figure
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.plants import Input, Plant

from .page import LogCheck

_AT = 0.02  # of the largest change: as large as that
_BELOW = 0.9  # of the largest change: a little smaller than that
_MANY, _SHARE = 20, 0.02  # changes at the bound, and of all steps
_OUTSTANDING = 2.0  # times as many as a little below: a sine has 0.8
_IN_A_ROW = 10  # times that it goes on in one direction
_FREE = 0.2  # of the moves that are smaller: inputs that only ever jump by one size tell nothing
_WHOLE = 0.8  # of an input's range: that is how far it can go, not how fast
_LEVELS = 12  # fewer values, or fewer changes: it is switched, or coarse


def unstated_rates(plant: Plant, table: TransitionTable, found: LogCheck) -> None:
    """Advises a rate for inputs that never change by more than a bound, and often by just that, several steps in a row.

    Args:
        plant: What is described.
        table: The log.
        found: The page.
    """
    actions, ids = np.asarray(table.actions, dtype=np.float64), np.asarray(table.episode_ids)
    for j, each in enumerate(plant.inputs):
        if each.rate is None and (rate := rate_of(actions[:, j], ids, _reach(each, actions[:, j]))) is not None:
            most, share = rate
            unit = f" {each.unit}" if each.unit else ""
            text = (
                f"{each.name} never changes by more than {figure(most, 3)}{unit} from one step to the next, and by just"
                f" that in {share:.0%} of the steps, several in a row: something limits how fast it moves. Write"
                f" rate={figure(most, 3)} into the plant file where that is the actuator, or is to stay so; without it"
                " plans have jumps that the plant does not make"
            )
            found.add("advice", "rate", text)


def rate_of(input_: Array, ids: NDArray[Any], reach: float) -> tuple[float, float] | None:
    """The bound of an input's changes, and in which share of the steps it is met; None where none shows.

    A bound shows by changes that pile up at the largest one, more than there are a little below it, and that go on in
    the same direction at that pace: noise, sines, relays, steps of a test and what is coarse do not.

    Args:
        input_: The input in each step, ``(n,)``.
        ids: Of the episode of each step, ``(n,)``.
        reach: How far it can go.
    """
    same = np.asarray(ids[1:]) == np.asarray(ids[:-1])
    change = np.where(same, np.diff(input_), 0.0)
    size = np.abs(change)
    most = float(size.max(initial=0.0))
    if not 0.0 < most < _WHOLE * reach or len(np.unique(input_)) < _LEVELS:
        return None
    at, moved = size >= (1.0 - _AT) * most, size > _AT * most
    if len(np.unique(np.round(size[moved] / most, 3))) < _LEVELS:
        return None
    below = (size >= _BELOW * most) & ~at
    goes_on = at[1:] & at[:-1] & (change[1:] * change[:-1] > 0.0)
    many = at.sum() >= max(_MANY, _SHARE * len(size), _OUTSTANDING * float(below.sum()))
    free = moved.sum() - at.sum() >= _FREE * moved.sum()
    return (most, float(at.mean())) if many and free and goes_on.sum() >= _IN_A_ROW else None


def _reach(each: Input, logged: Array) -> float:
    """How far an input goes in the log, or could, where its bounds are nearer."""
    return float(min(np.ptp(logged), each.high - each.low))
