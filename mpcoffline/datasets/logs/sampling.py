"""From rows at any times to control intervals: inputs held, states in between, gaps kept apart."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array

_EXACT = 1e-6  # control intervals
_ALIGNED = 0.6  # share of an input's changes at one time of the control interval, for it to begin there
_CHANGES = 20  # of them, at least


class Series(NamedTuple):
    """The valid values of one quantity.

    Attributes:
        t: Their times, increasing, ``(m,)``.
        v: The values, ``(m,)``.
    """

    t: Array
    v: Array

    @classmethod
    def of(cls, t: Array, v: Array) -> Series:
        """Those that are numbers."""
        good = np.isfinite(v)
        return cls(t, v) if good.all() else cls(t[good], v[good])


def grid(t: Array, dt: float, phase: float, max_gap: float) -> tuple[NDArray[np.int64], Array]:
    """Control instants within stretches of rows without a gap: their numbers ``(n,)``, and their times."""
    tau = (t - phase) / dt
    ends = np.append(np.flatnonzero(np.diff(t) > max_gap), len(t) - 1)
    starts = np.append(0, ends[:-1] + 1)
    first = np.ceil(tau[starts] - 1e3 * _EXACT).astype(np.int64)
    counts = np.maximum(np.floor(tau[ends] + 1e3 * _EXACT).astype(np.int64) - first + 1, 0)
    offsets = np.cumsum(counts) - counts
    k = np.repeat(first - offsets, counts) + np.arange(int(counts.sum()))
    return k.astype(np.int64), np.asarray(phase + dt * k, dtype=np.float64)


def phase_of(t: Array, inputs: list[Series], dt: float) -> tuple[float, bool]:
    """When control intervals begin: where inputs change, if they do so once an interval; else at the first row."""
    begin = float(t[0])
    usual = float(np.median(np.diff(t))) if len(t) > 1 else dt
    if usual > 0.75 * dt:
        return begin, False
    changes = np.concatenate([s.t[1:][s.v[1:] != s.v[:-1]] for s in inputs] or [np.zeros(0)])
    if len(changes) < _CHANGES:
        return begin, False
    bins = max(2, round(dt / usual))
    places = np.floor(((changes - begin) / dt % 1.0) * bins + 1e-6).astype(np.int64) % bins
    counts = np.bincount(places, minlength=bins)
    best = int(np.argmax(counts))
    if counts[best] < _ALIGNED * len(changes):
        return begin, False
    return float(np.median(((changes - begin) % dt)[places == best])) + begin - dt, True


def between(s: Series, at: Array, dt: float, max_gap: float) -> Array:
    """Values at some times, linearly between the rows about them; NaN where these are farther apart than a gap."""
    if not len(s.t):
        return np.full(len(at), np.nan)
    i = np.searchsorted(s.t, at + 1e3 * _EXACT * dt, side="right") - 1
    known, i = i >= 0, np.maximum(i, 0)
    j = np.minimum(i + 1, len(s.t) - 1)
    width = s.t[j] - s.t[i]
    past = at - s.t[i]
    exact = past <= 1e3 * _EXACT * dt
    share = np.where(exact | (width <= 0.0), 0.0, past / np.where(width > 0.0, width, 1.0))
    value = s.v[i] + share * (s.v[j] - s.v[i])
    inside = exact | ((width > 0.0) & (width <= max_gap))
    return np.where(known & inside, value, np.nan)


def single_gaps(s: Series, t: Array, max_gap: float, reach: float) -> NDArray[np.bool_]:
    """After which values single ones are missing while rows go on, ``(m - 1,)``.

    Args:
        s: The values that are known.
        t: The times of all rows.
        max_gap: Time between rows beyond which there is a gap.
        reach: Time between two values that one is missing between.
    """
    missing = (np.diff(s.t) > max_gap) & (np.diff(s.t) <= reach)
    rows = np.searchsorted(t, s.t[1:]) - np.searchsorted(t, s.t[:-1])
    return np.asarray(missing & (rows > 1))


def bridge(s: Series, reach: float) -> tuple[float, float]:
    """How far off a value would be that is taken between its neighbours, and how far a step goes: root mean squares.

    Both are of the log's own values, where all three are known.

    Args:
        s: The values that are known.
        reach: How far the neighbours may be apart.
    """
    width = s.t[2:] - s.t[:-2]
    known = width <= reach
    if not known.any():
        return np.inf, 0.0
    share = (s.t[1:-1] - s.t[:-2]) / width
    off = (s.v[1:-1] - s.v[:-2] - share * (s.v[2:] - s.v[:-2]))[known]
    step = (s.v[1:-1] - s.v[:-2])[known]
    return float(np.sqrt(np.mean(off**2))), float(np.sqrt(np.mean(step**2)))


def held(s: Series, at: Array, dt: float, max_gap: float) -> Array:
    """The last value before some times; NaN where it is older than a gap."""
    if not len(s.t):
        return np.full(len(at), np.nan)
    i = np.searchsorted(s.t, at + 1e3 * _EXACT * dt, side="right") - 1
    j = np.maximum(i, 0)
    return np.where((i >= 0) & (at - s.t[j] <= max_gap), s.v[j], np.nan)


def averaged(s: Series, at: Array, dt: float, max_gap: float) -> tuple[Array, int]:
    """Means of a held input over the control intervals that begin at some times; in how many of them it changed.

    NaN where a gap lies in the interval.
    """
    if not len(s.t):
        return np.full(len(at), np.nan), 0
    eps = 1e3 * _EXACT * dt
    i = np.searchsorted(s.t, at + eps, side="right") - 1
    e = np.searchsorted(s.t, at + dt - eps, side="left") - 1
    known, i = i >= 0, np.maximum(i, 0)
    e = np.maximum(e, i)
    steps = np.diff(s.t)
    changes = np.append(0, np.cumsum(s.v[1:] != s.v[:-1]))
    gaps = np.append(0, np.cumsum(steps > max_gap))
    known &= (gaps[e] == gaps[i]) & (at + dt - s.t[e] <= max_gap) & (at - s.t[i] <= max_gap)
    value = s.v[i]
    moved = np.flatnonzero(known & (changes[e] != changes[i]))
    if len(moved):
        total = np.append(0.0, np.cumsum((s.v[:-1] - s.v[0]) * steps))  # about the first: fewer digits are lost
        a, b, begin = i[moved], e[moved], np.maximum(at[moved], s.t[i[moved]])
        end = at[moved] + dt
        until = total[b] + (s.v[b] - s.v[0]) * (end - s.t[b])
        value[moved] = s.v[0] + (until - total[a] - (s.v[a] - s.v[0]) * (begin - s.t[a])) / (end - begin)
    return np.where(known, value, np.nan), len(moved)


def free_of(t: Array, blocked: NDArray[np.bool_], at: Array, dt: float) -> NDArray[np.bool_]:
    """Whether no row between two control instants is one that was left out, ``(n,)``."""
    bad = t[blocked]
    eps = 1e3 * _EXACT * dt
    first, last = np.searchsorted(bad, at - eps, side="left"), np.searchsorted(bad, at + dt + eps, side="right")
    return np.asarray(first == last)
