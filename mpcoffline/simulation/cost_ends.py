"""Where episodes end, and at what price, as the log shows it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.features import RandomFeatures, Ridge

from .end_prices import EndPrices

_OTHERS = 20_000  # states that did not end an episode and are looked at
_LEAST = 0.1  # share of the ends that another limit must explain
_PLAIN = 0.9  # share of what the score explains that suffices for a limit of one coordinate


@dataclass(frozen=True)
class Ends:
    """The states s+ that end an episode: beyond one of some limits, of coordinates or of a quadratic of all of them.

    Attributes:
        limits: Coordinate (``nx`` stands for the quadratic), sign and value of each: ended where ``sign y > value``.
        found: Share of the logged ends that lie beyond one.
        wrong: Share of what lies beyond one that did not end an episode.
        price: What the step costs that ends an episode, more than the same step elsewhere; a median.
        count: Number of logged ends.
        prices: The same by the state that the step reaches; None where one number says as much.
        good_below: A price below which an end is a good one, as a goal reached: cheaper than other steps by more than
            half of what these differ; where all cost the same, than half of such a step.
    """

    limits: tuple[tuple[int, float, float], ...] = ()
    found: float = 0.0
    wrong: float = 0.0
    price: float = 0.0
    count: int = 0
    features: RandomFeatures | None = None
    weights: Ridge | None = None
    prices: EndPrices | None = None
    good_below: float = -np.inf

    def __call__(self, reached: Array) -> NDArray[np.bool_]:
        """Whether states s+ ``(n, d)`` end an episode, ``(n,)``."""
        ended = np.zeros(len(reached), dtype=bool)
        for k, sign, value in self.limits:
            if k < reached.shape[1]:
                ended |= sign * reached[:, k] > value
            elif self.features is not None and self.weights is not None:
                ended |= self.weights(self.features(reached))[:, 0] > value
        return ended

    def paid(self, reached: Array) -> Array:
        """The prices of ends in states s+ ``(n, d)``, ``(n,)``."""
        return np.full(len(reached), self.price) if self.prices is None else self.prices(reached)

    def __str__(self) -> str:
        """In words; empty where no episode of the log was ended."""
        if not self.count:
            return ""
        if not self.limits:
            return f"{self.count} episodes end where the states do not tell why; simulated ones do not"
        said = [f"s{k} {'>' if sign > 0 else '<'} {sign * value:.4g}" for k, sign, value in self.limits]
        if self.features is not None:
            said = [*said[:-1], "a quadratic of the states says so"]
        price = f", at {self.price:.4g} more than elsewhere" if self.price else ""
        if self.prices is not None:
            price = f", at {self.prices.low:.4g} to {self.prices.high:.4g} more than elsewhere, by {self.prices.kind}"
        return f"episodes end where {' or '.join(said)} ({self.found:.0%} of {self.count} logged ends){price}"


def learned_ends(table: TransitionTable, prices: Array, seed: int, seen: int) -> Ends:
    """The limits that tell the logged ends from other states, one after the other while they explain a tenth more.

    A limit is worth the ends beyond it less the other states there. One of a quadratic, which ridge regression finds,
    is taken where it is worth more than those of coordinates, as of angles that are given by sine and cosine.

    Args:
        table: The transitions.
        prices: What the steps that end an episode cost more than others, ``(n_ends,)``.
        seed: Draws rows from large logs.
        seen: How many coordinates of s+ are looked at, the first ones.
    """
    over = np.asarray(table.terminations) > 0.0
    if not over.any() or over.all():
        return Ends(price=float(np.median(prices)) if len(prices) else 0.0, count=int(over.sum()))
    rng = np.random.default_rng(seed)
    last, others = np.flatnonzero(over), np.flatnonzero(~over)
    others = others if len(others) <= _OTHERS else np.sort(rng.permutation(others)[:_OTHERS])
    bad, good = (np.asarray(table.take(rows).next_observations[:, :seen], dtype=np.float64) for rows in (last, others))
    price, count, by_state = float(np.median(prices)), len(last), EndPrices.of(bad, prices, seed)
    plain = _limits(bad, good)
    features = RandomFeatures(np.vstack([bad, good]), 0, rng)
    weights = _score(features, bad, good)
    one = _best(weights(features(bad)), weights(features(good)))
    if one is not None and _worth(plain, bad, good) < _PLAIN * one[3]:
        found = Ends(((bad.shape[1], 1.0, one[2]),), price=price, count=count, features=features, weights=weights)
    else:
        found = Ends(plain, price=price, count=count)
    hits, false = int(found(bad).sum()), int(found(good).sum())
    below, share = _good_below(table.take(np.flatnonzero(~over))), false / max(hits + false, 1)
    return replace(found, found=hits / count, wrong=share, prices=by_state, good_below=below)


def _good_below(going: TransitionTable) -> float:
    """See :class:`Ends`; of the steps that end no episode.

    Of a plant whose every step costs 1 an end without a price is a goal, where each is paid 1 it is a loss. Elsewhere
    an end without a price may be a plant that was switched off far out: no good one.
    """
    costs = going.values().costs
    low, high = float(costs.min()), float(costs.max())
    return 0.5 * low if low == high else -0.5 * (high - low)


def _limits(bad: Array, good: Array) -> tuple[tuple[int, float, float], ...]:
    """Of coordinates, the most explaining one first."""
    limits: list[tuple[int, float, float]] = []
    count = len(bad)
    while (one := _best(bad, good)) is not None and one[3] >= max(_LEAST * count, 1):
        k, sign, value, _ = one
        limits.append((k, sign, value))
        bad, good = (part[sign * part[:, k] <= value] for part in (bad, good))
    return tuple(limits)


def _best(bad: Array, good: Array) -> tuple[int, float, float, int] | None:
    """Coordinate, sign and value of the limit that is worth most, and what it is worth."""
    found: tuple[int, float, float, int] | None = None
    for k in range(bad.shape[1]):
        for sign in (1.0, -1.0):
            own, others = np.sort(sign * bad[:, k]), np.sort(sign * good[:, k])
            if not len(own):
                return found
            worth = np.arange(len(own), 0, -1) - (len(others) - np.searchsorted(others, own, side="left"))
            i = int(np.argmax(worth))
            if worth[i] > (found[3] if found else 0):
                below = np.searchsorted(others, own[i], side="left")
                inner = max(others[below - 1] if below else -np.inf, own[i - 1] if i else -np.inf)
                value = 0.5 * (own[i] + inner) if np.isfinite(inner) else np.nextafter(own[i], -np.inf)
                found = k, sign, float(value), int(worth[i])
    return found


def _worth(limits: tuple[tuple[int, float, float], ...], bad: Array, good: Array) -> int:
    ends = Ends(limits)
    return int(ends(bad).sum()) - int(ends(good).sum())


def _score(features: RandomFeatures, bad: Array, good: Array) -> Ridge:
    """A quadratic that is 1 where episodes end and 0 elsewhere, both weighing the same."""
    weights = np.sqrt(np.concatenate([np.full(len(bad), 1.0 / len(bad)), np.full(len(good), 1.0 / len(good))]))
    targets = np.concatenate([np.ones(len(bad)), np.zeros(len(good))])
    return Ridge.fit(features(np.vstack([bad, good])) * weights[:, None], (targets * weights)[:, None])
