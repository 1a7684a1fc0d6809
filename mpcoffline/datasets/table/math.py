"""A table's columns, and what is computed of all its rows, block by block: they may be larger than memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError

CHUNK = 1 << 16
_SIGN = np.uint32(1 << 31)

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


class Episodes(NamedTuple):
    """Where the episodes of a table lie, ordered by their ids.

    Attributes:
        ids: Ids, ``(E,)``.
        firsts: First row of each, ``(E,)``.
        lengths: Number of rows of each, ``(E,)``.
    """

    ids: NDArray[np.int64]
    firsts: NDArray[np.intp]
    lengths: NDArray[np.intp]

    def rows(self, number: int) -> slice:
        """The rows of the episode of that place among the ids; a negative one counts from the end."""
        return slice(int(self.firsts[number]), int(self.firsts[number] + self.lengths[number]))


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


def split(block: Any, ny: int, nu: int) -> Columns:
    """The five columns of a block ``(B, 2 ny + nu + 2)``, as views of it."""
    after = ny + nu + 1
    return Columns(
        block[:, :ny],
        block[:, ny : ny + nu],
        block[:, ny + nu],
        block[:, after : after + ny],
        block[:, after + ny],
    )


class Moments:
    """Mean and sum of squares about it of some columns, block by block.

    Args:
        size: Number of columns.

    Attributes:
        count: Rows so far.
        mean: ``(size,)``.
        squares: ``(size,)``.
    """

    count: int
    mean: Any
    squares: Any

    def __init__(self, size: int) -> None:
        self.count, self.mean, self.squares = 0, np.zeros(size), np.zeros(size)

    def add(self, block: Floats) -> None:
        """Takes in rows ``(B, size)``, by the update of Chan, Golub and LeVeque: a large mean does not cancel."""
        along = None if block.shape[1] == 1 else 0  # numpy reduces a single column many times faster as a whole
        difference, n, count = block.mean(axis=along) - self.mean, len(block), self.count
        self.squares += block.var(axis=along) * n + difference**2 * count * n / (count + n)
        self.mean, self.count = self.mean + difference * n / (count + n), count + n


def merged_moments(lanes: Sequence[Floats]) -> tuple[Floats, ...]:
    """Mean, standard deviation, smallest and largest value of each column from those of parts (Chan, Golub, LeVeque).

    Args:
        lanes: Of each part count, mean, sum of squares about it, smallest and largest value, ``(5, width)``.
    """
    count, mean, squares, low, high = lanes[0]
    for n, other, about, least, most in lanes[1:]:
        total = np.maximum(count + n, 1.0)
        difference = other - mean
        squares = squares + about + difference**2 * count * n / total
        mean, count = mean + difference * n / total, count + n
        low, high = np.minimum(low, least), np.maximum(high, most)
    return mean, np.sqrt(squares / count), low, high


def moments(
    rows: NDArray[np.float32], values: Callable[[NDArray[np.float32]], Floats]
) -> tuple[Floats, Floats, Floats, Floats]:
    """Mean, standard deviation, smallest and largest value of each column, in one pass.

    Args:
        rows: ``(n, width)``, n >= 1.
        values: From a block of packed rows to its values in float64.

    Returns:
        Four arrays ``(width,)``.
    """
    found = Moments(rows.shape[1])
    low, high = np.full(rows.shape[1], np.inf), np.full(rows.shape[1], -np.inf)
    for i in range(0, len(rows), CHUNK):
        block = values(rows[i : i + CHUNK])
        found.add(block)
        low, high = np.minimum(low, block.min(axis=0)), np.maximum(high, block.max(axis=0))
    return found.mean, np.sqrt(found.squares / found.count), low, high


def innermost(
    rows: NDArray[np.float32],
    ny: int,
    nu: int,
    fraction: float,
    states: Callable[[NDArray[np.float32]], tuple[Any, Any]] | None = None,
    count: int | None = None,
) -> NDArray[np.intp]:
    """The ``fraction`` of rows with the smallest max(|s - m| / h, |s+ - m| / h), m and h of :func:`middles`.

    Args:
        rows: The packed rows ``(n, 2 ny + nu + 2)``; where they are centred, it is the distance from the centre.
        ny: Number of observation coordinates.
        nu: Number of action coordinates.
        fraction: In (0, 1].
        states: From a block of centred rows to s and s+, ``(B, ny)`` each, both from the centre.
        count: How many coordinates count, the first ones; all by default.

    Returns:
        Their numbers, ascending.
    """
    middle, half = middles(rows, ny if count is None else count)
    score = np.empty(len(rows))
    for i in range(0, len(rows), CHUNK):
        block = rows[i : i + CHUNK]
        score[i : i + CHUNK] = farness(split(block, ny, nu)[::3] if states is None else states(block), middle, half)
    kept = max(1, round(fraction * len(rows)))
    farthest = np.partition(score, kept - 1)[kept - 1]
    inside = score < farthest
    inside[np.flatnonzero(score == farthest)[: kept - inside.sum()]] = True  # ties by order: the same on each machine
    return np.flatnonzero(inside)


def farness(states: tuple[Any, Any], middle: Floats, half: Floats) -> Floats:
    """How far out each row is, ``(B,)``: max(|s - m| / h, |s+ - m| / h) over the first coordinates.

    Args:
        states: s and s+ of the rows, ``(B, ny)`` each.
        middle: m of those coordinates that count, ``(count,)``.
        half: h, ``(count,)``.
    """
    both = (part[:, : len(middle)] for part in states)
    # float64: ratios of float32 numbers can overflow.
    far = (np.abs(part.T.astype(np.float64, order="C") - middle[:, None]) for part in both)
    return np.asarray((np.maximum(*far) / half[:, None]).max(axis=0))


def middles(rows: NDArray[np.float32], ny: int) -> tuple[Floats, Floats]:
    """The middle between the quartiles of each observation, and half their distance, ``(ny,)`` both.

    The quartiles are values of the rows. Where they are one number, the mean distance from it stands for the half
    distance; where that is zero too, 1.
    """
    n = len(rows)
    first = (n - 1) // 4
    ranked = _ranked_in_file if isinstance(rows, np.memmap) else _ranked
    low, high = ranked(rows, ny, [first, n - 1 - first]).astype(np.float64)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    if not half.all():
        blocks = (rows[i : i + CHUNK, :ny].astype(np.float64) - middle for i in range(0, n, CHUNK))
        half = np.where(half > 0.0, half, sum(np.abs(block).sum(axis=0) for block in blocks) / n)
    return middle, np.where(half > 0.0, half, 1.0)


def _ranked(rows: NDArray[np.float32], ny: int, ranks: list[int]) -> NDArray[np.float32]:
    """The entries of those ranks among each observation, ``(ranks, ny)``."""
    return np.stack([np.partition(rows[:, i], ranks)[ranks] for i in range(ny)], axis=1)


def _ranked_in_file(rows: NDArray[np.float32], ny: int, ranks: list[int]) -> NDArray[np.float32]:
    """The same of a memory map, in two passes and little memory, whatever n is.

    A float32 has the order of its bits read as an integer, once those of a negative one are inverted and the sign of
    others is set. So one pass counts the upper halves of these, and a second one the lower halves where the upper one
    is that of the rank.
    """
    upper = np.zeros((ny, 1 << 16), dtype=np.int64)
    for high, _ in _halves(rows, ny):
        for i in range(ny):
            upper[i] += np.bincount(high[:, i], minlength=1 << 16)
    ends = np.cumsum(upper, axis=1)
    bins = np.array([[np.searchsorted(ends[i], rank, side="right") for i in range(ny)] for rank in ranks])
    lower = np.zeros((len(ranks), ny, 1 << 16), dtype=np.int64)
    for high, low in _halves(rows, ny):
        for k in range(len(ranks)):
            for i in range(ny):
                lower[k, i] += np.bincount(low[high[:, i] == bins[k, i], i], minlength=1 << 16)
    found = np.empty((len(ranks), ny), dtype=np.uint32)
    for k, rank in enumerate(ranks):
        for i in range(ny):
            before = ends[i, bins[k, i]] - upper[i, bins[k, i]]
            found[k, i] = (bins[k, i] << 16) + np.searchsorted(np.cumsum(lower[k, i]), rank - before, side="right")
    return np.where(found & _SIGN, found ^ _SIGN, ~found).view(np.float32)


def _halves(rows: NDArray[np.float32], ny: int) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """Upper and lower halves of the ordered bits of s, block by block."""
    for i in range(0, len(rows), CHUNK):
        bits = np.ascontiguousarray(rows[i : i + CHUNK, :ny]).view(np.uint32)
        bits = np.where(bits & _SIGN, ~bits, bits | _SIGN)
        yield bits >> 16, bits & 0xFFFF


def drawn_episodes(name: str, ids: NDArray[np.int64], fraction: float, seed: int) -> NDArray[np.bool_]:
    """Whether each row is of the episodes that are drawn, ``(n,)``: at least one of them, and not all.

    Args:
        name: What error messages call the table.
        ids: Episode of each row, ``(n,)``.
        fraction: Share of the episodes that are drawn, in (0, 1).
        seed: Seed of the draw.

    Raises:
        InvalidArgumentError: For another fraction, or fewer than two episodes.
    """
    if not 0.0 < fraction < 1.0:
        raise InvalidArgumentError("fraction", expected="a number in (0, 1)", actual=str(fraction))
    episodes = np.unique(ids)
    if len(episodes) < 2:
        raise InvalidArgumentError(f"{name}: episodes", expected="two or more to split", actual="1")
    count = min(max(1, round(fraction * len(episodes))), len(episodes) - 1)
    return np.isin(ids, np.random.default_rng(seed).permutation(episodes)[:count])
