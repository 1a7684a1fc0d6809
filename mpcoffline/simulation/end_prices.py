"""What the end of an episode costs, by the state that it is reached with: a lander's touch-down is good or bad."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.estimation.features import RandomFeatures, Ridge
from mpcoffline.estimation.structure import clearly_negative
from mpcoffline.mpc.scaling import spread_of

_FEWEST = 20  # ends, of which fewer do not tell what their prices depend on
_FOLDS = 5
_NEIGHBOURS = 3
_ROWS_A_FEATURE = 4  # for a polynomial
_RIDGE = 1e-4
_FLATTER = 1e-2  # of the one that tells two kinds of ends apart, of which one may be rare
_LEVEL = 0.2  # of the gap between two levels: prices of one scatter by less
_OF_A_KIND = 5  # ends, of which fewer make no kind
_SURE = 2.0  # standard errors


class _Prices(Protocol):
    """Prices of states ``(n, d)``, ``(n,)``."""

    def __call__(self, states: Array) -> Array: ...


class _Nearest(NamedTuple):
    """The mean price of the nearest logged ends, coordinates in their spreads."""

    states: Array
    prices: Array
    spread: Array

    def __call__(self, states: Array) -> Array:
        found, count = np.empty(len(states)), min(_NEIGHBOURS, len(self.prices))
        for i, state in enumerate(states):
            far = np.square((self.states - state) / self.spread).sum(axis=1)
            found[i] = self.prices[np.argpartition(far, count - 1)[:count]].mean()
        return found


class _Polynomial(NamedTuple):
    """A linear or quadratic function."""

    features: RandomFeatures
    ridge: Ridge

    def __call__(self, states: Array) -> Array:
        return np.asarray(self.ridge(self.features(states))[:, 0])


class _TwoLevels(NamedTuple):
    """One of two prices: which, a quadratic says to which both kinds of ends weigh the same."""

    score: _Polynomial
    low: float
    high: float

    def __call__(self, states: Array) -> Array:
        return np.where(self.score(states) > 0.0, self.high, self.low)

    @classmethod
    def of(cls, states: Array, prices: Array, dear: NDArray[np.bool_]) -> _TwoLevels:
        """Learns it from ends of which some are dear."""
        features = RandomFeatures(states, 0, np.random.default_rng(0))
        weights = np.sqrt(np.where(dear, 1.0 / dear.sum(), 1.0 / (~dear).sum()))[:, None]
        ridge = Ridge.fit(features(states) * weights, np.where(dear, 1.0, -1.0)[:, None] * weights, _FLATTER)
        return cls(_Polynomial(features, ridge), float(np.median(prices[~dear])), float(np.median(prices[dear])))


class EndPrices(NamedTuple):
    """Prices of ends as a function of the state reached; never lower or higher than logged ones.

    Attributes:
        low: The lowest logged price.
        high: The highest.
        kind: What the function is, in words.
        seen: How many coordinates it looks at, the first ones.
        function: Prices without these bounds.
    """

    low: float
    high: float
    kind: str
    seen: int
    function: _Prices

    def __call__(self, states: Array) -> Array:
        """Prices of ends in states ``(n, d)``, of which further coordinates do not matter, ``(n,)``."""
        return np.clip(self.function(states[:, : self.seen]), self.low, self.high)

    @classmethod
    def of(cls, states: Array, prices: Array, seed: int) -> EndPrices | None:
        """The function that predicts prices of other ends best; None where none does so better than one number.

        A plane, a quadratic where the ends suffice for it, or the nearest ends, each judged on one fifth of the ends
        after the other by the function of the rest: taken if its squared error is below that of what is plainer, at
        first of their median, beyond two standard errors. Where prices are at two levels, which of them it is: taken if
        both kinds are recognised beyond chance, however rare one is in the log.

        Args:
            states: In which logged episodes ended, ``(n, d)``.
            prices: What these ends cost, ``(n,)``.
            seed: Draws the fifths.
        """
        n, low, high = len(prices), float(prices.min(initial=np.inf)), float(prices.max(initial=-np.inf))
        if n < _FEWEST or not high > low:
            return None
        folds = np.random.default_rng(seed).permutation(n) % _FOLDS
        if (levels := _two_levels(states, prices, folds)) is not None:
            return cls(low, high, "whether they are good or bad ones", states.shape[1], levels)
        unit, best = high - low, _squares(prices, folds, lambda rows: _constant(float(np.median(prices[rows]))), states)
        found: EndPrices | None = None
        for kind, make in _kinds(states, prices).items():
            missed = _squares(prices, folds, make, states, (low, high))
            if clearly_negative((missed - best) / unit**2, np.arange(n)):
                best, found = missed, cls(low, high, kind, states.shape[1], make(np.arange(n)))
        return found


def _two_levels(states: Array, prices: Array, folds: NDArray[np.intp]) -> _TwoLevels | None:
    """See :meth:`EndPrices.of`; None where there are no two levels, or the states do not tell them."""
    dear = prices > 0.5 * (prices.min() + prices.max())
    if min(dear.sum(), (~dear).sum()) < _OF_A_KIND:
        return None
    kinds = prices[~dear], prices[dear]
    if max(kind.std() for kind in kinds) > _LEVEL * (np.median(kinds[1]) - np.median(kinds[0])):
        return None
    right = np.zeros(len(prices), dtype=bool)
    for k in range(_FOLDS):
        rows, others = folds == k, folds != k
        if not 0 < dear[others].sum() < others.sum():
            return None
        score = _TwoLevels.of(states[others], prices[others], dear[others]).score
        right[rows] = (score(states[rows]) > 0.0) == dear[rows]
    shares = np.array([right[kind].mean() for kind in (dear, ~dear)])
    error = 0.5 * np.sqrt(np.sum(shares * (1.0 - shares) / [dear.sum(), (~dear).sum()]))
    return _TwoLevels.of(states, prices, dear) if shares.mean() - _SURE * error > 0.5 else None


class _Make(Protocol):
    """Learns prices from some of the ends."""

    def __call__(self, rows: NDArray[np.intp]) -> _Prices: ...


def _constant(price: float) -> _Prices:
    def always(states: Array) -> Array:
        return np.full(len(states), price)

    return always


def _kinds(states: Array, prices: Array) -> dict[str, _Make]:
    """What is tried, the plainest first: of those that are alike it stays."""
    n, d = states.shape

    def polynomial(multiplied: int) -> _Make:
        def make(rows: NDArray[np.intp]) -> _Prices:
            features = RandomFeatures(states[rows], 0, np.random.default_rng(0), multiplied=multiplied)
            return _Polynomial(features, Ridge.fit(features(states[rows]), prices[rows, None], _RIDGE))

        return make

    def nearest(rows: NDArray[np.intp]) -> _Prices:
        return _Nearest(states[rows], prices[rows], spread_of(states[rows]))

    found: dict[str, _Make] = {"a plane": polynomial(0)} if n >= _ROWS_A_FEATURE * (1 + d) else {}
    if n >= _ROWS_A_FEATURE * (1 + d + d * (d + 1) // 2):
        found["a quadratic"] = polynomial(d)
    return {**found, "the nearest ends": nearest}


def _squares(
    prices: Array, folds: NDArray[np.intp], make: _Make, states: Array, within: tuple[float, float] = (-np.inf, np.inf)
) -> Array:
    """Squared errors of each price by the function of the other fifths, ``(n,)``."""
    missed = np.empty(len(prices))
    for k in range(_FOLDS):
        rows, others = np.flatnonzero(folds == k), np.flatnonzero(folds != k)
        missed[rows] = np.clip(make(others)(states[rows]), *within) - prices[rows]
    return missed**2
