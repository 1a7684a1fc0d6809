"""Dead time of the inputs, found in a log of outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

_RANGE, _PATIENCE = 3, 3  # steps that are tried in any case, and beyond the best
_SHARE = 3  # of the longest episode one, at most
_GAIN = 20.0  # of the log likelihood, at least: a hundred million times as likely
_NO_WORSE = 1.05  # of what is missed ahead: the same episodes, by another model
_ROUNDS = 3


class Fit(NamedTuple):
    """What was found with some dead time.

    Attributes:
        loss: Minus the logarithm of the posterior.
        point: Where, in scaled coordinates.
        missed: How far outputs are missed some steps ahead, in what they move, root of the mean square.
    """

    loss: float
    point: Array
    missed: float


def search_delays(
    mpc: MPC, late: Sequence[bool], longest: int, fitted: Callable[[tuple[int, ...], Array | None], Fit]
) -> tuple[tuple[int, ...], Fit]:
    """The dead time with which outputs are likeliest, by a descent from the best so far for each that is tried.

    One input after the other, until nothing changes. Another dead time counts where its likelihood is larger by far
    more than chance and predictions some steps ahead are no worse.

    Args:
        mpc: Says where to begin.
        late: Which inputs may act later than it says, ``(nu,)``.
        longest: Steps of the longest episode.
        fitted: Fits with a dead time, from a point, or from the beginning.

    Returns:
        Dead time in steps, ``(nu,)``, and what was found with it.
    """
    best, delay = fitted(mpc.layout.delay, None), mpc.layout.delay
    for _ in range(_ROUNDS):
        before = delay
        for i in np.flatnonzero(late).tolist():
            given = found = delay[i]
            d, most = given, longest // _SHARE
            while d < min(most, max(given + _RANGE, found + _PATIENCE)):
                d += 1
                tried = (*delay[:i], d, *delay[i + 1 :])
                fit = fitted(tried, best.point)
                if fit.loss < best.loss - _GAIN and fit.missed <= _NO_WORSE * best.missed:
                    best, delay, found = fit, tried, d
        if delay == before or sum(late) == 1:
            break
    return delay, best
