"""Profiles of signals over a clock, learned from a log: what an MPC without a preview expects of prices or weather."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.math import Columns
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC, Signal
from mpcoffline.mpc.signals import harmonics, turned

logger = logging.getLogger(__name__)

_ROWS = 50_000
_HARMONICS = 3
_ROUNDS = 20
_OFF = 0.05  # rad a step, or of the radius: a clock that is none


def with_profiles(mpc: MPC, table: TransitionTable) -> MPC:
    """The MPC with the profiles of its signals that follow a clock, where they are not known yet.

    ::

        min_{m, a}  E_D[ (d+ - m(phase+) - a (d - m(phase)))^2 ],      0 <= a <= 1

    in turn for the coefficients of m and for a (Cochrane and Orcutt, J. American Stat. Assoc. 44, 1949), which counts
    deviations that last for what they are: few.

    Args:
        mpc: The MPC.
        table: Transitions; their first columns are the MPC's observation.

    Raises:
        InvalidDataError: If the columns of a clock do not turn as its period says.
    """
    layout = mpc.layout
    if not any(signal.follows is not None and not signal.profile for signal in layout.signals):
        return mpc
    rows = excerpt(table, _ROWS, 0).values()
    clocks = {
        signal.name: (signal, _phases(signal, at, rows))
        for signal, at in zip(layout.signals, layout.present.tolist(), strict=True)
        if signal.period is not None
    }
    found = []
    for signal, at in zip(layout.signals, layout.present.tolist(), strict=True):
        if signal.follows is None or signal.profile:
            found.append(signal)
            continue
        clock, phases = clocks[signal.follows]
        count = min(_HARMONICS, int(np.ceil(clock.period or 0.0) - 1) // 2)
        learned = _learned(signal, rows.observations[:, at], rows.next_observations[:, at], phases, count)
        text = "%s follows %s; of a deviation %.3g is left a step later"
        logger.info(text, signal.name, signal.follows, learned.persistence)
        found.append(learned)
    return mpc.replace(model=mpc.model.with_signals(found))


def _phases(clock: Signal, at: int, rows: Columns) -> tuple[Array, Array]:
    """Cosine and sine in each row and in the next, ``(n, 2)`` both."""
    before, after = (np.asarray(part[:, at : at + 2]) for part in (rows.observations, rows.next_observations))
    step = 2.0 * np.pi / float(clock.period or np.inf)
    expected = np.stack(turned(before[:, 0], before[:, 1], step), axis=1)
    off = float(np.median(np.abs(after - expected).max(axis=1)))
    radius = float(np.median(np.abs(np.hypot(*before.T) - 1.0)))
    if not max(off, radius) <= _OFF:
        raise InvalidDataError(
            f"clock {clock.name}",
            expected=f"cosine and sine of a phase that turns once in {clock.period:g} sampling steps",
            actual=f"columns {at} and {at + 1}, off by {max(off, radius):.2g} a step",
            hint="Is the period given in sampling steps, and is the cosine the first of the two columns?",
        )
    return before, after


def _learned(signal: Signal, now: Array, after: Array, phases: tuple[Array, Array], count: int) -> Signal:
    """The signal with its profile and persistence."""
    X, X_after = (np.stack([np.ones(len(p)), *harmonics(p[:, 0], p[:, 1], count)], axis=1) for p in phases)
    mean, size = float(now.mean()), float(now.std()) or 1.0
    d, d_after = (now - mean) / size, (after - mean) / size
    a = 0.0
    for _ in range(_ROUNDS):
        weights = np.linalg.lstsq(X_after - a * X, d_after - a * d, rcond=1e-6)[0]
        off, off_after = d - X @ weights, d_after - X_after @ weights
        squares = float(off @ off)
        a = float(np.clip(off @ off_after / squares, 0.0, 1.0)) if squares > 0.0 else 0.0
    weights = size * weights
    weights[0] += mean
    return replace(signal, profile=tuple(weights.tolist()), persistence=a)
