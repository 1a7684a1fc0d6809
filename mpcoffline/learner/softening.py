"""Exact penalties in place of the hard limits of whatever a learner hands out (``soften="auto"``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np

from mpcoffline.core.errors import InvalidArgumentError, MPCOfflineError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC, Constraint, Penalty, StateBounds
from mpcoffline.solvers import softened

Soften = Literal["auto"]

_STATES = 200  # of the log, that are asked for multipliers
_ROWS = 5_000  # that say in which unit a stage cost is


@dataclass(frozen=True)
class Softening:
    """The prices of limits that were hard, found from MPC_1 and states of the log.

    Attributes:
        prices: Of each limit that was softened, by name, in the unit of MPC_1's stage cost.
        observations: Logged ones, ``(n, ny)``.
        actions: The inputs there, ``(n, nu)``.
        spread: Of MPC_1's stage cost there.
    """

    prices: Mapping[str, Penalty]
    observations: Array
    actions: Array
    spread: float

    @classmethod
    def of(cls, mpc: MPC, table: TransitionTable, seed: int = 0) -> Softening:
        """Solves MPC_1 from states of the log; see :func:`mpcoffline.solvers.softened`.

        Args:
            mpc: MPC_1.
            table: The log.
            seed: Of the states.
        """
        rows = table.sample(_ROWS, seed).values()
        few = mpc.state(table.sample(_STATES, seed).values().observations)
        soft = softened(mpc, few)
        changed = {new.name: new.soft for old, new in zip(_limits(mpc), _limits(soft), strict=True) if new is not old}
        prices = {name: price for name, price in changed.items() if price is not None}
        return cls(prices, rows.observations, rows.actions, _spread(mpc, rows.observations, rows.actions))

    def __call__(self, mpc: MPC) -> MPC:
        """An MPC with these penalties in place of its hard limits, in the unit of its own stage cost."""
        if not self.prices:
            return mpc
        own = _spread(mpc, self.observations, self.actions)
        unit = own / self.spread if 0.0 < own / self.spread < np.inf else 1.0
        soft = {name: Penalty(price.l1 * unit, price.l2 * unit) for name, price in self.prices.items()}
        changed = [
            replace(limit, soft=soft[limit.name]) if limit.name in soft and limit.soft is None else limit
            for limit in _limits(mpc)
        ]
        return mpc.replace(constraints=changed)


def check_soften(given: Any, error: type[MPCOfflineError] = InvalidArgumentError) -> Soften | None:
    """The option as it is.

    Raises:
        MPCOfflineError: The given one, for anything but ``"auto"`` and None.
    """
    if given not in (None, "auto"):
        raise error("soften", expected="'auto' or None", actual=repr(given)[:200])
    return cast("Soften | None", given)


def softening_found(given: MPC, learned: MPC) -> tuple[str, ...]:
    """Which limits were softened, and at what price, in a sentence; none where none was."""
    before = {limit.name: limit for limit in _limits(given)}
    told = [
        f"{limit.name!r} at l1 = {limit.soft.l1:.3g}"
        for limit in _limits(learned)
        if limit.soft is not None and limit.name in before and before[limit.name].soft is None
    ]
    return (f"Limits softened by exact penalties: {', '.join(told)} a unit of violation and step.",) if told else ()


def _limits(mpc: MPC) -> list[Constraint | StateBounds]:
    given = mpc.constraints if isinstance(mpc.constraints, tuple) else ()
    return [each for each in given if isinstance(each, Constraint | StateBounds)]


def _spread(mpc: MPC, observations: Array, actions: Array) -> float:
    """How much the stage cost varies over some rows; 1 where it does not."""
    found = mpc.stage_costs(mpc.state(observations), actions)
    spread = float(found[np.isfinite(found)].std()) if np.isfinite(found).any() else 0.0
    return spread if spread > 0.0 else 1.0
