"""What sensors do to a log: spikes, and values that stand still while the plant moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array

_SPIKE = 25.0  # times what a value usually is away from the middle of its neighbours
_BEYOND = 4.0  # times the step between these neighbours
_SURE = 1e-6  # chance of a run in a log, by which it is none
_FEWEST = 20  # values that stand still
_MOVED = 0.05  # of its range, by which something else has moved meanwhile
_SOME = 1_000_000  # values that thresholds are taken from


def spikes(v: Array) -> NDArray[np.intp]:
    """Where single values ``(n,)`` lie far from both neighbours, which lie together."""
    if len(v) < 10:
        return np.zeros(0, dtype=np.intp)
    some = v[:_SOME]
    away = np.abs(some[1:-1] - 0.5 * (some[:-2] + some[2:]))
    moving = away[away > 0.0]
    if not len(moving):
        return np.zeros(0, dtype=np.intp)
    size = max(1.4826 * float(np.median(away)), float(np.quantile(away, 0.9)) / 1.645, float(moving.min()))
    found = []
    for start in range(0, len(v) - 2, _SOME):
        part = v[start : start + _SOME + 2]
        step, middle = np.abs(part[2:] - part[:-2]), 0.5 * (part[2:] + part[:-2])
        off = np.abs(part[1:-1] - middle)
        found.append(start + 1 + np.flatnonzero((off > _SPIKE * size) & (off > _BEYOND * step)))
    return np.concatenate(found)


def stuck(v: Array, others: Sequence[Array]) -> list[tuple[int, int]]:
    """Runs of one value, from and to, that are too long for chance and in which something else moves.

    At the ends of a quantity's range it may well rest: such runs are none.

    Args:
        v: Values, ``(n,)``.
        others: Other quantities at the same times, ``(n,)`` each.
    """
    n = len(v)
    if n < 2 * _FEWEST:
        return []
    starts = np.append(0, np.flatnonzero(v[1:] != v[:-1]) + 1)
    lengths = np.diff(np.append(starts, n))
    if len(lengths) < 3:
        return []
    usual = np.sort(lengths)[: max(1, int(0.98 * len(lengths)))]
    q = max(1.0 - 1.0 / float(usual.mean()), 0.02)
    least = max(_FEWEST, 2.0 * np.log(_SURE / n) / np.log(q), 6.0 * float(usual[-1]))
    low, high = float(v.min()), float(v.max())
    spans = [float(np.ptp(other)) for other in others]
    found = []
    for i in np.flatnonzero(lengths >= least):
        a, e = int(starts[i]), int(starts[i] + lengths[i])
        moved = any(s > 0.0 and np.ptp(o[a:e]) > _MOVED * s for o, s in zip(others, spans, strict=True))
        if low < v[a] < high and moved:
            found.append((a, e))
    return found
