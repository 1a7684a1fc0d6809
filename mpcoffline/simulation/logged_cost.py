"""The stage cost L(s, a) as a function, learned from the logged costs: simulations need it where nothing was logged."""

from __future__ import annotations

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.memory import gathered
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.features import RandomFeatures, Ridge
from mpcoffline.learning.known_cost import COST_ROWS, known_cost
from mpcoffline.mpc import MPC

_ROWS = 20_000
_N_FEATURES = 400
_EXACT = 1.0 - 1e-6  # R2 of a quadratic beyond which nothing else is needed
_HELD_OUT = 0.2


class LoggedCost:
    """L(s, a) by regression of the logged costs.

    The MPC's stage cost, where that is what was logged (:func:`~mpcoffline.learning.known_cost`); a full quadratic in
    (s, a) where that is exact. Otherwise the quadratic with random features (hyperbolic tangents, which stay bounded
    outside the data, so that there the quadratic decides), by ridge regression, and never below the cheapest logged
    cost, as beyond the data it is a guess. A part of the episodes is held out to measure how good it is.

    Args:
        table: The transitions; smoothed, where s is noisy.
        seed: Seeds features and split.
        seen: How many coordinates of s the cost may depend on, the first ones; all by default.
        mpc: Its stage cost may be the logged one.
        logged: The transitions as they were logged, where ``table`` is smoothed.

    Attributes:
        r2: Share of the variance of held-out costs that it explains.
        low: The cheapest logged cost.
        exact: Whether the MPC's stage cost or a quadratic is exact.
    """

    def __init__(
        self,
        table: TransitionTable,
        seed: int = 0,
        seen: int | None = None,
        *,
        mpc: MPC | None = None,
        logged: TransitionTable | None = None,
    ) -> None:
        known = None if mpc is None else known_cost(mpc, excerpt(table if logged is None else logged, COST_ROWS, seed))
        self._known = None if known is None or known.constant or known.agreeing < 1.0 else known
        self._mpc = mpc
        rng = np.random.default_rng(seed)
        self._seen = table.ny if seen is None else seen
        table = table if self._seen == table.ny else gathered(table, range(self._seen))
        train, test = table.split(1.0 - _HELD_OUT, seed) if table.n_episodes > 4 else _rows_split(table, rng)
        (x, cost), (x_test, cost_test) = (_sample(part, rng) for part in (train, test))
        self._level = float(cost.mean())  # a large constant, which ridges would shrink
        self._features = RandomFeatures(x, 0, rng)
        self._fit(x, cost)
        self.exact = self._known is not None or self._r2(x_test, cost_test) > _EXACT
        if not self.exact:
            self._features = RandomFeatures(x, _N_FEATURES, rng)
            self._fit(x, cost)
        self.r2 = self._r2(x_test, cost_test) if self._known is None else 1.0 - self._known.missed
        self.low = float(min(cost.min(), cost_test.min()))

    def _fit(self, x: Array, cost: Array) -> None:
        self._regression = Ridge.fit(self._features(x), cost[:, None] - self._level)

    def _r2(self, x: Array, cost: Array) -> float:
        missed = cost - self._level - self._regression(self._features(x))[:, 0]
        variance = float(np.var(cost))
        return 1.0 - float(np.mean(missed**2)) / variance if variance > 0.0 else 1.0

    def __call__(self, s: Array, a: Array) -> Array:
        """L of states ``(B, nx)`` and inputs ``(B, nu)``, ``(B,)``."""
        if self._known is not None and self._mpc is not None:
            ours = self._mpc.stage_function(s.T, a.T, self._mpc.theta).full().ravel()
            return np.asarray(self._known.scale * ours + self._known.offset)
        cost = self._regression(self._features(np.hstack([s[:, : self._seen], a])))[:, 0] + self._level
        return np.asarray(cost if self.exact else np.maximum(cost, self.low))


def _rows_split(table: TransitionTable, rng: np.random.Generator) -> tuple[TransitionTable, TransitionTable]:
    """A split by rows, where there are hardly any episodes."""
    order = rng.permutation(len(table))
    cut = max(1, int((1.0 - _HELD_OUT) * len(table)))
    train, test = np.sort(order[:cut]), np.sort(order[min(cut, len(table) - 1) :])
    return table.take(train), table.take(test)


def _sample(table: TransitionTable, rng: np.random.Generator) -> tuple[Array, Array]:
    """Some rows as (s, a) and cost in float64."""
    columns = table.sample(_ROWS, rng).values()
    return np.hstack([columns.observations, columns.actions]), columns.costs
