"""A table's columns, and what is computed of all its rows, block by block: they may be larger than memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

CHUNK = 1 << 16

Floats = NDArray[np.float64]


class Columns(NamedTuple):
    """The five columns of a block of rows, as views of it (numpy or torch, whichever the block is).

    Attributes:
        observations: s, ``(B, ny)``.
        actions: a, ``(B, nu)``.
        costs: L(s, a), ``(B,)``.
        next_observations: s+, ``(B, ny)``.
        terminations: 1.0 where the episode terminated in s+ (no bootstrapping there), else 0.0, ``(B,)``.
    """

    observations: Any
    actions: Any
    costs: Any
    next_observations: Any
    terminations: Any


class TableStatistics(NamedTuple):
    """Moments and ranges of a table's columns, float64: vectors for observations and actions, else numbers.

    Attributes:
        mean: Mean.
        std: Standard deviation.
        low: Smallest value.
        high: Largest value.
    """

    mean: Columns
    std: Columns
    low: Columns
    high: Columns


def episodes_by_continuity(rows: NDArray[np.float32], ny: int, nu: int) -> NDArray[np.int64]:
    """Numbers of the episodes ``(n,)`` of packed rows: a row goes on where the one before ended, unless terminated."""
    after = ny + nu + 1
    goes_on = (rows[:-1, after : after + ny] == rows[1:, :ny]).all(axis=1) & (rows[:-1, after + ny] == 0.0)
    return np.concatenate([[0], np.cumsum(~goes_on)]).astype(np.int64)


def moments(rows: NDArray[np.float32]) -> tuple[Floats, Floats, Floats, Floats]:
    """Mean, standard deviation, smallest and largest value of each column, in one pass.

    Args:
        rows: ``(n, width)``, n >= 1.

    Returns:
        Four arrays ``(width,)``.
    """
    mean, squares, count = np.zeros(rows.shape[1]), np.zeros(rows.shape[1]), 0
    low, high = np.full(rows.shape[1], np.inf), np.full(rows.shape[1], -np.inf)
    for i in range(0, len(rows), CHUNK):
        block = rows[i : i + CHUNK].astype(np.float64)
        # The update of Chan, Golub and LeVeque, which does not cancel where the mean is large.
        difference, n = block.mean(axis=0) - mean, len(block)
        squares += block.var(axis=0) * n + difference**2 * count * n / (count + n)
        mean, count = mean + difference * n / (count + n), count + n
        low, high = np.minimum(low, block.min(axis=0)), np.maximum(high, block.max(axis=0))
    return mean, np.sqrt(squares / count), low, high


def innermost(rows: NDArray[np.float32], ny: int, nu: int, fraction: float) -> NDArray[np.intp]:
    """The ``fraction`` of rows with the smallest max(|s / med|, |s+ / med|), med as :func:`magnitudes` gives it.

    Args:
        rows: The packed rows ``(n, 2 ny + nu + 2)``.
        ny: Number of observation coordinates.
        nu: Number of action coordinates.
        fraction: In (0, 1].

    Returns:
        Their numbers, ascending.
    """
    scale, after = magnitudes(rows, ny), ny + nu + 1
    score = np.empty(len(rows))
    for i in range(0, len(rows), CHUNK):
        block = np.abs(rows[i : i + CHUNK])
        # float64: ratios of float32 numbers can overflow.
        reached = np.maximum(block[:, :ny], block[:, after : after + ny]).astype(np.float64)
        score[i : i + CHUNK] = (reached / scale).max(axis=1)
    kept = max(1, round(fraction * len(rows)))
    # Stable, so that ties are broken by order and the result does not depend on the machine.
    return np.sort(np.argsort(score, kind="stable")[:kept])


def magnitudes(rows: NDArray[np.float32], ny: int) -> Floats:
    """The exact median of |s| of each observation ``(ny,)``; where that is 0 its mean, where that is 0 too, 1.

    A non-negative float32 has the order of its bits read as an integer. So one pass counts the upper halves of these,
    and a second one the lower halves where the upper one is the median's: two passes, whatever n is.
    """
    n = len(rows)
    ranks = sorted({(n - 1) // 2, n // 2})
    upper = np.zeros((ny, 1 << 16), dtype=np.int64)
    total = np.zeros(ny)
    for high, _, size in _halves(rows, ny):
        total += size.sum(axis=0, dtype=np.float64)
        for i in range(ny):
            upper[i] += np.bincount(high[:, i], minlength=1 << 16)
    ends = np.cumsum(upper, axis=1)
    bins = np.array([[np.searchsorted(ends[i], rank, side="right") for i in range(ny)] for rank in ranks])
    lower = np.zeros((len(ranks), ny, 1 << 16), dtype=np.int64)
    for high, low, _ in _halves(rows, ny):
        for k in range(len(ranks)):
            for i in range(ny):
                lower[k, i] += np.bincount(low[high[:, i] == bins[k, i], i], minlength=1 << 16)
    found = np.empty((len(ranks), ny), dtype=np.uint32)
    for k, rank in enumerate(ranks):
        for i in range(ny):
            before = ends[i, bins[k, i]] - upper[i, bins[k, i]]
            found[k, i] = (bins[k, i] << 16) + np.searchsorted(np.cumsum(lower[k, i]), rank - before, side="right")
    scale = found.view(np.float32).mean(axis=0, dtype=np.float64)
    scale = np.where(scale > 0.0, scale, total / n)
    return np.where(scale > 0.0, scale, 1.0)


def _halves(rows: NDArray[np.float32], ny: int) -> Iterator[tuple[NDArray[Any], NDArray[Any], NDArray[np.float32]]]:
    """Upper and lower halves of the bits of |s|, and |s|, block by block."""
    for i in range(0, len(rows), CHUNK):
        size = np.abs(rows[i : i + CHUNK, :ny])
        bits = size.view(np.uint32)
        yield bits >> 16, bits & 0xFFFF, size
