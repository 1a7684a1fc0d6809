"""The units in which V is learned."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mpcoffline.datasets.table.math import split
from mpcoffline.datasets.table.shards import ShardedTable
from mpcoffline.datasets.table.transitions import Columns, TableStatistics, TransitionTable

from .function import ValueFunction


class Units:
    """Transitions in the units of V's network, in which the Bellman equation keeps its form.

    ::

        V' = (V - offset) / scale,    L' = (L - offset + gamma (1 - terminated) offset) / scale

    Computed in float64, so that a large constant in the cost costs no accuracy.

    Every policy that does what is in the data has a value between min L / (1 - gamma) and max L / (1 - gamma) (or
    min L and max L, where episodes terminate). Held to these ``bounds``, a target cannot be drawn below by low
    expectiles of its own errors.

    Args:
        table: The transitions.
        value: V with its normalisation.
        discount: gamma.
        device: Torch device.
    """

    def __init__(
        self, table: TransitionTable | ShardedTable, value: ValueFunction, discount: float, device: str = "cpu"
    ) -> None:
        statistics = table.statistics()
        std = torch.from_numpy(statistics.std.actions)
        action_mean, action_std = torch.from_numpy(statistics.mean.actions), torch.where(std > 0.0, std, 1.0)
        one = torch.ones(1, dtype=torch.float64)
        offset, scale = value.offset.reshape(1), value.scale.reshape(1)
        shift = [value.mean, action_mean, (1.0 - discount) * offset, value.mean, 0.0 * one]
        spread = [value.std, action_std, scale, value.std, one]
        self._shift, self._spread = torch.cat(shift).to(device), torch.cat(spread).to(device)
        self._end = float(discount * offset / scale)
        self._ny, self._nu, self._increments = table.ny, table.nu, None
        if not table.centring.is_none:
            self._increments = torch.from_numpy(table.centring.increments.astype(np.float64)).to(device)
            self._shift[-1 - table.ny : -1] *= 1.0 - self._increments  # the difference of two states has none
            self._shift -= torch.from_numpy(table.centring.centre).to(device)
        low, high = value_bounds(statistics, discount)
        self.bounds: tuple[float, float] = float((low - offset) / scale), float((high - offset) / scale)

    def columns(self, rows: Tensor) -> Columns:
        """The columns of packed rows ``(B, 2 ny + nu + 2)`` of the table, float32."""
        batch = split((rows - self._shift) / self._spread, self._ny, self._nu)
        costs = batch.costs - self._end * batch.terminations
        if self._increments is not None:
            batch.next_observations.add_(self._increments * batch.observations)
        return Columns(*(column.float() for column in batch._replace(costs=costs)))


def value_bounds(statistics: TableStatistics, discount: float) -> tuple[float, float]:
    """Between which the discounted sum of costs like those in the data lies, whenever it may end."""
    forever = 1.0 / max(1.0 - discount, 1e-12)
    horizons = [1.0, forever] if statistics.high.terminations > 0.0 else [forever]
    low, high = float(statistics.low.costs), float(statistics.high.costs)
    return min(low * horizon for horizon in horizons), max(high * horizon for horizon in horizons)
