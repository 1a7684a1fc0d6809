"""What trimming leaves out of rows of which a table is an excerpt."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .math import farness, middles
from .transitions import TransitionTable


class Inside:
    """Leaves out the rows farther out than those that a table keeps when it is trimmed (:meth:`TransitionTable.trim`).

    Args:
        middle: What distances are from, ``(count,)``, of the first coordinates.
        half: Their unit, ``(count,)``.
        farthest: The largest distance that stays.
    """

    def __init__(self, middle: NDArray[np.float64], half: NDArray[np.float64], farthest: float) -> None:
        self._middle, self._half, self._farthest = middle, half, farthest

    @classmethod
    def of(cls, table: TransitionTable, fraction: float, count: int | None = None) -> Inside:
        """That of a share of a table's rows.

        Args:
            table: The table, in memory.
            fraction: Share of its rows that stay, in (0, 1].
            count: How many coordinates decide, the first ones; all by default.
        """
        middle, half = middles(table.rows, table.ny if count is None else count)
        far = farness(table.centring.states(table.rows), middle, half)
        kept = max(1, round(fraction * len(table)))
        return cls(middle, half, float(np.partition(far, kept - 1)[kept - 1]))

    def __call__(self, table: TransitionTable) -> TransitionTable:
        """The rows that stay."""
        far = farness(table.centring.states(table.rows), self._middle, self._half)
        return table.take(np.flatnonzero(far <= self._farthest))
