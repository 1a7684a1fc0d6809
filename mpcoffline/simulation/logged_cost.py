"""The stage cost L(s, a) as a function, from the logged costs: simulations need it where nothing was logged."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.learning.known_cost import COST_ROWS, agreeing_cost, as_applied
from mpcoffline.learning.known_limits import limit_costs_of
from mpcoffline.learning.limit_costs import LimitCosts
from mpcoffline.learning.stages import ROUNDING, KnownCost
from mpcoffline.mpc import MPC

from .cost_ends import Ends, learned_ends
from .cost_regression import CostRegression, cost_regressions, folds_of

_ROWS = 20_000
_FEW = 1_000  # for other weights, which agree with all rows or are none


class LoggedCost:
    """L(s, a) as the log has it: the MPC's stage cost where that was logged, else a regression of the logged costs.

    The MPC's own expression counts where it agrees with all logged costs, up to scale, offset, other weights, and
    noise in the states, also in that of s+ (:func:`~mpcoffline.learning.known_cost.agreeing_cost`). Else it is the
    better one of a quadratic and a small network
    (:func:`~mpcoffline.simulation.cost_regression.cost_regressions`), of the rows as they were logged: with smoothed
    ones a regulated plant's cost looks like that of another plant. Where L depends on s+, such a regression is its mean
    given (s, a). Rows that end an episode are no part of it; what an end costs is learned by itself. ``L -> a L + b``
    changes all costs likewise and nothing else. What the MPC's soft limits cost is added as it is written, whether the
    logged costs contain it or not (:func:`~mpcoffline.learning.known_limits.limit_costs_of`).

    Args:
        table: The transitions.
        seed: Seeds the split and the weights.
        seen: How many coordinates of s the cost may depend on, the first ones; all by default.
        mpc: Its stage cost may be the logged one; its soft limits cost what they say.
        logged: The transitions as they were logged, where ``table`` is smoothed.

    Attributes:
        known: How the logged costs follow from the MPC's stage cost; None where they do not.
        r2: Share of the variance of the costs on held-out episodes that it explains; of those in the log, where it is
            the MPC's.
        r2_second: The same of the second regression.
        exact: Whether the MPC's stage cost or a quadratic is exact.
        low: The cheapest logged cost.
        limits: What the soft limits cost; None where nothing is soft.
        ends: Where episodes end, and at what price.
    """

    low: float

    def __init__(
        self,
        table: TransitionTable,
        seed: int = 0,
        seen: int | None = None,
        *,
        mpc: MPC | None = None,
        logged: TransitionTable | None = None,
    ) -> None:
        table = table if logged is None else logged
        self.limits: LimitCosts | None = None if mpc is None else limit_costs_of(mpc, excerpt(table, COST_ROWS, seed))
        table = table if self.limits is None else self.limits.without(table)
        self._seen = table.ny if seen is None else seen
        agreeing = None if mpc is None else _agreeing(mpc, excerpt(table, COST_ROWS, seed))
        self._partly = agreeing
        whole = agreeing is not None and agreeing[1].agreeing == 1.0
        self._mpc: MPC | None = agreeing[0] if agreeing is not None and whole else None
        self.known: KnownCost | None = agreeing[1] if agreeing is not None and whole else None
        over = np.asarray(table.terminations) > 0.0
        going = table.take(np.flatnonzero(~over)) if over.any() and not over.all() else table
        rows = going.take(_some(len(going), seed))
        cost = rows.values().costs
        self._dearest, self.low = float(cost.max()), float(cost.min())
        self._reached = self.known is not None and self.known.reached
        self._regressions: tuple[CostRegression, ...] = ()
        if self.known is None or self.known.missed > ROUNDING:
            self._regressions = self._regressed(rows, self._reached, seed)
        self._others = self._regressions[0 if self.known is not None else 1 :] or self._regressions
        self.r2: float = 1.0 - (self._regressions[0].error if self.known is None else self.known.missed)
        self.r2_second: float = 1.0 - self._others[0].error if self._others else self.r2
        self.exact: bool = self.known is not None or self._regressions[0].exact
        last = table.take(np.flatnonzero(over)).values()
        prices = last.costs - self._stage(last.observations, last.actions, last.next_observations)
        self.ends: Ends = learned_ends(table, prices, seed, self._seen)

    def __call__(self, s: Array, a: Array, reached: Array) -> Array:
        """L of states ``(B, nx)``, inputs ``(B, nu)`` and states reached ``(B, nx)``, ``(B,)``.

        It is the dearest logged cost where it is no number.
        """
        return self._with_limits(self._stage(s, a, reached), s, a)

    def _stage(self, s: Array, a: Array, reached: Array) -> Array:
        """The same without the prices of soft limits."""
        s = reached if self._reached else s
        if self._mpc is None or self.known is None:
            return self._regressions[0](np.hstack([s[:, : self._seen], a]))
        ours = self._mpc.stage_costs(s, a)
        cost = self.known.scale * ours + self.known.offset
        return np.asarray(np.where(np.isfinite(cost), cost, self._dearest))

    @property
    def alike(self) -> bool:
        """Whether :meth:`second` is the same function."""
        return self.exact and (self.known is None or not self._others)

    def second(self, s: Array, a: Array, reached: Array) -> Array:
        """L by another regression: what both agree on hardly hangs on how L was learned.

        It is the same function where that is exact.
        """
        if self.alike:
            return self(s, a, reached)
        of = reached if self._reached else s
        return self._with_limits(self._others[0](np.hstack([of[:, : self._seen], a])), s, a)

    def _with_limits(self, cost: Array, s: Array, a: Array) -> Array:
        return cost if self.limits is None else cost + self.limits(s, a)

    def as_applied(self, table: TransitionTable) -> NDArray[np.bool_]:
        """In which rows of a table the plant took the logged input, as far as the costs tell, ``(n,)``.

        See :func:`~mpcoffline.learning.known_cost.as_logged`.
        """
        if self._partly is None:
            return np.ones(len(table), dtype=bool)
        rows = table if self.limits is None else self.limits.without(table)
        return as_applied(self._partly[0], rows, self._partly[1])

    def ended(self, s: Array, a: Array, reached: Array) -> NDArray[np.bool_]:
        """Whether steps from s ``(B, nx)`` under a ``(B, nu)`` to ``reached`` end an episode, ``(B,)``.

        Then the step costs :attr:`end_price` more than L(s, a), and nothing follows.
        """
        del s, a  # of an end these tell less than the state it is reached with
        return self.ends(reached[:, : self._seen])

    @property
    def end_price(self) -> float:
        """What a step that ends an episode costs more than L(s, a); 0 where none was logged."""
        return self.ends.price

    def __str__(self) -> str:
        """What the cost is, and how well it agrees with the log, in a sentence."""
        if self.known is not None:
            own = "a regression of the logged costs" if self.known.regressed else "the MPC's own stage cost"
            said = f"{own}, {self.known}"
        elif self.exact:
            said = f"{self._regressions[0].name} of states and inputs, exact to rounding"
        else:
            said = (
                f"{self._regressions[0].name} of states and inputs, learned from the logged costs, of whose variance it"
                f" explains {_share(self.r2)} on held-out episodes ({self._others[0].name} beside it, as a check,"
                f" {_share(self.r2_second)})"
            )
        if self.limits is not None:
            said += f", and {self.limits.scale:.3g} times the prices of soft limits"
        return f"Costs in simulations: {said}; {self.ends}." if self.ends.count else f"Costs in simulations: {said}."

    def _regressed(self, rows: TransitionTable, reached: bool, seed: int) -> tuple[CostRegression, ...]:
        """Regressions of the costs of transitions on (s, a), or on (s+, a)."""
        columns = rows.values()
        s = columns.next_observations if reached else columns.observations
        x = np.hstack([s[:, : self._seen], columns.actions])
        return cost_regressions(x, columns.costs, folds_of(rows, seed), seed)


def _agreeing(mpc: MPC, table: TransitionTable) -> tuple[MPC, KnownCost] | None:
    """The MPC whose stage cost agrees with the logged costs, all of them or a part, if there is one."""
    found = agreeing_cost(mpc, table, count=_FEW)
    return None if found is None or found[1].constant else found


def _share(r2: float) -> str:
    """In per cent, with as many digits as tell it from all."""
    missed = max(1.0 - r2, 1e-12)
    return f"{100.0 * r2:.{int(np.clip(np.ceil(-np.log10(100.0 * missed)), 0, 4)) + 1}f} %"


def _some(n: int, seed: int) -> NDArray[np.intp]:
    return np.arange(n) if n <= _ROWS else np.sort(np.random.default_rng(seed).permutation(n)[:_ROWS])
