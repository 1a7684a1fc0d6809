"""Episodes of a log, scaled: what linear models of outputs and inputs are fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable

_ROWS = 10_000


class ScaledEpisodes(NamedTuple):
    """Episodes, scaled: what is seen has mean 0 and spread 1 over the log.

    Attributes:
        y: Outputs of each episode, the last one included, ``(T + 1, ny)`` each.
        w: Inputs and signals, ``(T, nu + n_signals)`` each.
        nu: Number of inputs.
        y_scale: Mean and spread of outputs.
        w_scale: The same of the others.
    """

    y: list[Array]
    w: list[Array]
    nu: int
    y_scale: tuple[Array, Array]
    w_scale: tuple[Array, Array]

    @classmethod
    def of(cls, log: TransitionTable, n_outputs: int, signals: Sequence[int]) -> Self:
        """The first episodes of a log, of many rows at most; see :func:`~mpcoffline.estimation.linear_model`."""
        values, (_, firsts, lengths) = log.values(), log.episodes
        y_scale, w_scale = (
            _mean_and_spread(each)
            for each in (
                values.observations[:, :n_outputs],
                np.hstack([values.actions, values.observations[:, list(signals)]]),
            )
        )
        still = np.flatnonzero(np.ptp(values.observations[:, :n_outputs], axis=0) == 0.0)
        if len(still):
            actual = f"output {still[0]} is one number throughout"
            raise InvalidDataError("log", expected="outputs that move", actual=actual)
        y, w, rows = list[Array](), list[Array](), 0
        for first, length in sorted(zip(firsts.tolist(), lengths.tolist(), strict=True)):
            own = slice(first, first + length)
            last = values.next_observations[first + length - 1, :n_outputs]
            outputs = np.vstack([values.observations[own, :n_outputs], last])
            others = np.hstack([values.actions[own], values.observations[own][:, list(signals)]])
            y.append((outputs - y_scale[0]) / y_scale[1])
            w.append((others - w_scale[0]) / w_scale[1])
            rows += length
            if rows >= _ROWS:
                break
        return cls(y, w, log.nu, y_scale, w_scale)

    @property
    def episodes_of_rows(self) -> NDArray[np.intp]:
        """The episode of each row."""
        return np.repeat(np.arange(len(self.w)), [len(each) for each in self.w])

    def late(self, delay: Sequence[int], moving: NDArray[np.bool_]) -> list[Array]:
        """What acts in each step, with a one behind; the first values stand for what is older than the episode."""
        found = []
        for each in self.w:
            acting = each * np.append(np.ones(self.nu), moving)
            for i, d in enumerate(delay):
                acting[:, i] = each[np.maximum(np.arange(len(each)) - d, 0), i]
            found.append(np.hstack([acting, np.ones((len(each), 1))]))
        return found


def _mean_and_spread(values: Array) -> tuple[Array, Array]:
    spread = values.std(axis=0)
    return values.mean(axis=0), np.where(spread > 0.0, spread, 1.0)
