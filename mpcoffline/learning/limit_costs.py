"""What soft limits cost, in the unit of logged costs: a part of L that V sees and (FIT) need not explain."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.math import CHUNK, split
from mpcoffline.datasets.table.transitions import TransitionTable


@dataclass(frozen=True)
class LimitCosts:
    """P(s, a): the prices that an MPC states for violating its soft limits along the horizon.

    Attributes:
        function: ``(x, u, theta) -> P`` in the unit of the MPC's stage cost.
        theta: The MPC's parameters.
        scale: What a unit of the MPC's stage cost is in logged costs.
        logged: Whether the logged costs contain ``scale P`` already.
    """

    function: ca.Function
    theta: Array
    scale: float
    logged: bool

    def __str__(self) -> str:
        """The relation, in words."""
        there = "contain" if self.logged else "do not contain, but V does,"
        return f"logged costs {there} what soft limits cost, {self.scale:.4g} times the MPC's prices"

    def __call__(self, s: Array, a: Array) -> Array:
        """``scale P`` of states ``(B, nx)`` and inputs ``(B, nu)``, ``(B,)``; 0 where it is no number."""
        found = self.scale * self.function(s.T, a.T, self.theta).full().ravel()
        return np.asarray(np.where(np.isfinite(found), found, 0.0))

    def without(self, table: TransitionTable) -> TransitionTable:
        """Transitions as they were logged, with the costs that a stage cost has to explain: without P."""
        return changed_costs(table, lambda s, a, cost: cost - self(s, a)) if self.logged else table

    def added(self, table: TransitionTable) -> TransitionTable:
        """The transitions of :meth:`without` with all that the MPC minimises: with P."""
        return changed_costs(table, lambda s, a, cost: cost + self(s, a))

    def whole(self, table: TransitionTable) -> TransitionTable:
        """Transitions as they were logged, with P."""
        return table if self.logged else self.added(table)


def changed_costs(table: TransitionTable, change: Callable[[Array, Array, Array], Array]) -> TransitionTable:
    """A table with other costs.

    Args:
        table: The transitions.
        change: ``(s, a, cost) -> cost``, for some rows at a time.
    """

    def blocks() -> Iterator[tuple[NDArray[np.float32], NDArray[np.int64]]]:
        for first in range(0, len(table), CHUNK):
            some = slice(first, first + CHUNK)
            values = table.centring.values(np.asarray(table.rows[some]))
            columns = split(values, table.ny, table.nu)
            columns.costs[:] = change(columns.observations, columns.actions, columns.costs)
            yield table.centring.packed(values), table.episode_ids[some]

    return table.rewritten(blocks())
