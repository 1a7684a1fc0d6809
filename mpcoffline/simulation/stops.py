"""Where logged states stop: a full tank, an end switch, a speed that is limited. Models do not know of them."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array

_DIGITS = 1e-6  # of a state's range: rows nearer to its end than this are on it
_NEARLY = 0.01  # likewise, where something is known to have stopped it
_FEWEST = 3  # rows that say so: no two of a state that moves freely are alike
_BEYOND = 0.01  # of the increments' spread that the model would have gone farther there, in the median


class Stops(NamedTuple):
    """Ends of states' ranges that many rows of a log hit exactly though the model would have gone on.

    Attributes:
        low: ``(n,)``; -inf where a state has none.
        high: ``(n,)``; inf likewise.
    """

    low: Array
    high: Array

    @classmethod
    def of(cls, x: Array, reached: Array, predicted: Array, cut: NDArray[np.bool_] | None = None) -> Self:
        """Finds them.

        Args:
            x: Logged states, ``(N, n)``.
            reached: Their successors.
            predicted: What the identified model predicts for these.
            cut: In which rows the plant is known to have cut off the input, ``(N,)``: of these, hitting an end nearly
                will do, as of a full tank that leaks.
        """
        n = x.shape[1]
        low, high = np.full(n, -np.inf), np.full(n, np.inf)
        if not len(x):
            return cls(low, high)
        least, most = reached.min(axis=0), reached.max(axis=0)
        increments = (reached - x).std(axis=0)
        for k in range(n):
            for ends, end, sign in ((low, least[k], -1.0), (high, most[k], 1.0)):
                off = sign * (end - reached[:, k]) / max(most[k] - least[k], np.finfo(np.float64).tiny)
                there = off <= (_DIGITS if cut is None else np.where(cut, _NEARLY, _DIGITS))
                beyond = sign * (predicted[there, k] - end)
                if there.sum() >= _FEWEST and np.median(beyond) > _BEYOND * increments[k] > 0.0:
                    ends[k] = end
        return cls(low, high)

    def hit(self, reached: Array) -> NDArray[np.bool_]:
        """Whether one of the states ``(N, n)`` is at a stop, ``(N,)``, where the model does not say what holds it."""
        return np.asarray(((reached <= self.low) | (reached >= self.high)).any(axis=1))

    def kept(self, x: Array) -> Array:
        """States ``(..., n)`` no farther than that."""
        return np.clip(x, self.low, self.high)
