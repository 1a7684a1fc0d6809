"""Inputs and signals that act slowly, as through a lag that the equations do not know, found in a log."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

from .delays import Scan

_ROWS = 6_000  # of the log that are looked at
_FINE = 2.0**0.25  # the factor between neighbours, in the end
_COARSE = 2.0
_LEFT = 0.3  # of the spread that a lag leaves: of less it is the mean, as where a column does nothing
_WORSE = 2  # coarse steps beyond the best after which longer lags are not tried


@dataclass(frozen=True)
class Lag:
    """An input or a signal that acts as through a lag of first order.

    Attributes:
        place: Its place among inputs and present signals, inputs first.
        steps: Time constant, in sampling steps.
        gain: The one-step error on held-out rows, relative to that of the model without the lag.
        before: The parameters that the log gives to the model without it.
        after: And to the model with it.
    """

    place: int
    steps: float
    gain: float
    before: Array
    after: Array


def find_lags(mpc: MPC, table: TransitionTable, *, seed: int = 0) -> list[Lag]:
    """Finds inputs and measured signals of which the plant feels a lagged value, where the model says the present one.

    Each that the model's equations hold is put through a lag of first order, and the model is identified anew::

        f_{k+1} = f_k + (1 - exp(-1 / tau)) (v_k - f_k)

    A lag counts where a dead time would (:func:`find_delays`): one-step errors on held-out rows at least 5 % smaller,
    beyond three standard errors, and predictions over 15 steps no worse. The best one first, then others beside it.

    Args:
        mpc: The MPC, with the dead time that it should have.
        table: Transitions of observations, in the order of time within each episode.
        seed: Seeds the choice of what is held out.

    Returns:
        What was found; nothing where the log has too few consecutive rows to tell.

    Raises:
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    table.check_fits(mpc.ny, mpc.nu)
    scan, found = _LagScan(mpc, excerpt(table, _ROWS, seed), seed), list[Lag]()
    acting = mpc.nu + len(mpc.layout.present)
    best: tuple[float, ...] = (*mpc.layout.delay, *(0.0,) * acting)
    if not scan.tells(best):
        return found
    left = set(_felt(mpc))
    while left:
        tried = {place: scan.slowed(best, place) for place in left}
        tried = {place: each for place, each in tried.items() if scan.better(each, best)}
        if not tried:
            break
        place = min(tried, key=lambda each: scan.gain(tried[each], best))
        slow, before = tried[place], scan.errors(best).theta
        found.append(Lag(place, slow[mpc.nu + place], scan.gain(slow, best), before, scan.errors(slow).theta))
        best = slow
        left = {each for each in tried if each != place}
    return found


def _felt(mpc: MPC) -> list[int]:
    """Places of the inputs and signals that any state follows at once; clocks are none."""
    depends = ca.DM(mpc.plant_function.jac_sparsity(0, 1)).full()
    clocks = {mpc.nu + i for i, signal in enumerate(mpc.layout.signals) if signal.period is not None}
    return [int(i) for i in np.flatnonzero(depends.any(axis=0)) if int(i) not in clocks]


class _LagScan(Scan):
    """Compares lags as dead times are compared: behind the dead times stand the time constants, in steps."""

    def slowed(self, best: tuple[float, ...], place: int) -> tuple[float, ...]:
        """The best among time constants of one input or signal, up to a third of a typical stretch of the log.

        None is so long that little more than the mean is left.
        """
        at, column = self._u.shape[1] + place, np.hstack([self._u, self._signals])[:, place]
        least = _LEFT * float(column.std())

        def with_lag(steps: float) -> tuple[float, ...]:
            return (*best[:at], steps, *best[at + 1 :])

        chosen, lowest, worse = best, 1.0, 0
        for steps in itertools.takewhile(lambda n: n <= self._cap, (_COARSE**k for k in itertools.count(-1))):
            if self._slow(column, steps).std() < least:
                break
            score = self.gain(with_lag(steps), best)
            chosen, lowest, worse = (with_lag(steps), score, 0) if score < lowest else (chosen, lowest, worse + 1)
            if worse > _WORSE:
                break
        if chosen == best:
            return best
        near = (with_lag(min(chosen[at] * _FINE**k, self._cap)) for k in (-3, -2, -1, 1, 2, 3))
        return min((chosen, *near), key=lambda each: self.gain(each, best))

    def _acting(self, delay: tuple[float, ...]) -> Array:
        rows, nu = np.arange(len(self._u)), self._u.shape[1]
        lags = delay[nu:] or (0.0,) * (nu + self._signals.shape[1])
        slow = [self._slow(v, lag) for v, lag in zip(np.hstack([self._u, self._signals]).T, lags, strict=True)]
        late = [int(d) for d in delay[:nu]] + [0] * self._signals.shape[1]
        return np.stack([v[np.maximum(rows - d, 0)] for v, d in zip(slow, late, strict=True)], axis=1)

    def _slow(self, column: Array, steps: float) -> Array:
        """A column through a lag; at rest where an episode begins."""
        if steps == 0.0:
            return column
        share, slow, f = 1.0 - np.exp(-1.0 / steps), np.array(column, dtype=np.float64), 0.0
        for k, (first, value) in enumerate(zip(self._before == 0, column, strict=True)):
            f = float(value) if first else f
            slow[k], f = f, f + share * (float(value) - f)
        return slow
