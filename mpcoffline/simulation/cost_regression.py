"""Regressions of costs on (s, a) from which a controller gains nothing where nothing was logged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.features import RandomFeatures, Ridge
from mpcoffline.estimation.norms import Norms, fit_norms
from mpcoffline.estimation.small_network import SmallNetwork, fit_small_network
from mpcoffline.mpc.scaling import cost_spread

_FOLDS = 5
_BLOCKS = 4  # of consecutive rows in a fold, where there are hardly any episodes
_RIDGES = (1e-9, 1e-6, 1e-4, 1e-2)
_HIDDEN = (10, 10)
_NETWORK_ROWS = 6_000
_HELD_OUT = ((0, 1), (1, 0))  # folds that each network is judged by, and ends by
_EXACT = 1e-6  # share of the variance that rounding may leave open
_INNER = 0.8  # share of the rows, from which a quadratic must predict the outer ones to be believed beyond all
_AS_GOOD = 2.0  # times the squared error that it has when it has seen others of them
_NEXT_TO_NONE = 0.01  # of the variance of the outer ones, which is good enough in any case
_WIDER = 2.0
_BETTER = 0.75  # times the squared error of the quadratic on held-out episodes, which is worth another regression
_LITTLE = 1e-3  # of the variance: what misses no more needs no norms


class Fitted(NamedTuple):
    """A regression that is linear in features.

    Attributes:
        features: Of x ``(n, d)``, ``(n, m)``.
        regression: Their weights, ``(m, 1)``.
        missed: What it misses in the rows of each fold when learned from the others, ``(n,)``.
    """

    features: RandomFeatures
    regression: Ridge
    missed: Array

    def __call__(self, x: Array) -> Array:
        """Of x ``(n, d)``, ``(n,)``."""
        return self.regression(self.features(x))[:, 0]


class Corrected(NamedTuple):
    """A quadratic and a small network of what it misses."""

    quadratic: Fitted
    network: SmallNetwork

    def __call__(self, x: Array) -> Array:
        """Of x ``(n, d)``, ``(n,)``."""
        return np.asarray(self.quadratic(x) + self.network(x)[:, 0])


Regressed = Fitted | Corrected | Norms


@dataclass(frozen=True)
class CostRegression:
    """A cost as a function of x = (s, a): a regression g within a box, and beyond it what a quadratic q adds.

    With c for x moved into the box, which holds all logged x::

        L(x) = level + scale (g(c) + max(0, q(x) - q(c)))

    So it grows outside as the quadratic does, and is nowhere cheaper than at the border. What is exact, a quadratic or
    one with norms, is taken as it is.

    Attributes:
        name: ``"a quadratic"``, ``"a quadratic with norms"`` or ``"a small network"``.
        level: Mean of the costs.
        scale: Their spread.
        g: The regression, of costs in these units.
        q: The quadratic; g itself, where that is enough.
        low: Corner of the box, ``(d,)``.
        high: The other one.
        error: Share of the variance of costs on held-out episodes that it misses.
    """

    name: str
    level: float
    scale: float
    g: Regressed
    q: Regressed
    low: Array
    high: Array
    error: float

    @property
    def exact(self) -> bool:
        """Whether it is no network, and misses nothing."""
        return not isinstance(self.g, Corrected) and self.error <= _EXACT

    def __call__(self, x: Array) -> Array:
        """L of x ``(n, d)``, ``(n,)``."""
        if self.exact:
            return np.asarray(self.level + self.scale * self.g(x))
        inside = np.clip(x, self.low, self.high)
        cost, beyond = self.g(inside), np.flatnonzero((inside != x).any(axis=1))
        if len(beyond):
            cost[beyond] += np.maximum(self.q(x[beyond]) - self.q(inside[beyond]), 0.0)
        return np.asarray(self.level + self.scale * cost)


def cost_regressions(x: Array, cost: Array, folds: NDArray[np.intp], seed: int) -> tuple[CostRegression, ...]:
    """A quadratic, and small networks or norms, by their errors on held-out episodes.

    The quadratic comes first, unless what is richer has at most three quarters of its squared error: that finds
    structure in noise, and a controller that is simulated on it gains from that. Then there are two of them, from
    other episodes each. (Of 17 logs, 13 kept the quadratic. Where the cost has kinks, or is a norm, a network missed
    between a third and an eightieth of what random features did; where it is a distance, norms missed a quarter of what
    a network did, which is too dear near the goal, where controllers stay.)

    Args:
        x: (s, a), ``(n, d)``.
        cost: ``(n,)``.
        folds: Of each row, the part of the data that it is held out with, see :func:`folds_of`, ``(n,)``.
        seed: Draws features and weights.

    Returns:
        The one to use, then the others; one only, where the quadratic is exact.
    """
    rng = np.random.default_rng(seed)
    level, scale = float(cost.mean()), cost_spread(cost)
    y = (cost - level) / scale
    variance = float(np.mean(y**2)) or 1.0

    def regression(name: str, g: Regressed, q: Regressed, missed: Array) -> CostRegression:
        return CostRegression(name, level, scale, g, q, low, high, float(np.mean(missed**2)) / variance)

    q = _fitted(RandomFeatures(x, 0, rng), x, y, folds)
    low, high = _believed(x, y, folds, q)
    quadratic = regression("a quadratic", q, q, q.missed)
    if quadratic.exact or len(np.unique(folds)) < _FOLDS:
        return (quadratic,)
    name, fit = "a small network", _network
    found = [fit(x, y, folds, _HELD_OUT[0], rng)]
    if quadratic.error > _LITTLE:
        other = [_with_norms(x, y, folds, _HELD_OUT[0], rng)]
        if _ratio(other, y, x, q) <= _BETTER * _ratio(found, y, x, q):
            name, fit, found = "a quadratic with norms", _with_norms, other
    if _ratio(found, y, x, q) <= _BETTER:
        found += [fit(x, y, folds, pair, rng) for pair in _HELD_OUT[1:]]
    relative = _ratio(found, y, x, q)
    richer = [regression(name, g, q, q.missed * np.sqrt(relative)) for g, _ in found]
    return (*richer, quadratic) if relative <= _BETTER else (quadratic, *richer)


def folds_of(table: TransitionTable, seed: int) -> NDArray[np.intp]:
    """Which of five parts of the data each row belongs to, ``(n,)``: episodes, or stretches of a few long ones."""
    n = len(table)
    groups = np.unique(table.episode_ids, return_inverse=True)[1]
    if table.n_episodes < _FOLDS:
        groups = np.arange(n) * min(n, _FOLDS * _BLOCKS) // max(n, 1)
    count = int(groups.max(initial=0)) + 1
    return np.asarray(np.random.default_rng(seed).permutation(count) % _FOLDS)[groups]


def _fitted(features: RandomFeatures, x: Array, y: Array, folds: NDArray[np.intp]) -> Fitted:
    """Ridge regression with the penalty that is best on held-out rows; the constant has none."""
    phi = features(x)
    middle, y_mean = phi[:, 1:].mean(axis=0), float(y.mean())
    parts = [np.flatnonzero(folds == k) for k in np.unique(folds)]
    moments = [_moments(phi[rows, 1:] - middle, y[rows] - y_mean) for rows in parts]
    whole = tuple(np.sum([m[i] for m in moments], axis=0) for i in range(4))
    missed = np.empty((len(y), len(_RIDGES)))
    for rows, own in zip(parts, moments, strict=True):
        left = whole if len(parts) == 1 else tuple(all_ - part for all_, part in zip(whole, own, strict=True))
        weights, constants = _path(*left)
        missed[rows] = (y[rows] - y_mean)[:, None] - (phi[rows, 1:] - middle) @ weights - constants
    best = int(np.argmin(np.mean(missed**2, axis=0)))
    weights, constants = (part[..., best] for part in _path(*whole))
    constant = y_mean + constants - middle @ weights
    return Fitted(features, Ridge(np.append(constant, weights)[:, None]), missed[:, best])


def _moments(phi: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    return np.array(float(len(y))), np.append(phi.sum(axis=0), y.sum()), phi.T @ phi, phi.T @ y


def _path(n: Array, sums: Array, gram: Array, slope: Array) -> tuple[Array, Array]:
    """The weights ``(m, r)`` and constants ``(r,)`` for each penalty, from the sums over the rows."""
    means = sums / max(float(n), 1.0)
    gram = gram - n * np.outer(means[:-1], means[:-1])
    strengths, axes = np.linalg.eigh(gram)
    penalties = np.array(_RIDGES) * max(float(np.trace(gram)) / max(len(gram), 1), np.finfo(np.float64).tiny)
    along = axes.T @ (slope - n * means[:-1] * means[-1])
    weights = axes @ (along[:, None] / (np.maximum(strengths, 0.0)[:, None] + penalties))
    return weights, means[-1] - means[:-1] @ weights


def _believed(x: Array, y: Array, folds: NDArray[np.intp], q: Fitted) -> tuple[Array, Array]:
    """The corners of the box of the logged x; one twice as wide, where the log shows that a quadratic goes on so.

    That is: where one that is learned from the inner rows predicts the outer ones.
    """
    middle, low, high = x.mean(axis=0), x.min(axis=0), x.max(axis=0)
    distance = np.abs((x - middle) / np.where(high > low, high - low, 1.0)).max(axis=1)
    limit = float(np.quantile(distance, _INNER))
    inner, outer = np.flatnonzero(distance <= limit), np.flatnonzero(distance > limit)
    if not limit > 0.0 or not len(outer):
        return low, high
    features = RandomFeatures(x[inner], 0, np.random.default_rng(0))
    missed = y[outer] - _fitted(features, x[inner], y[inner], folds[inner])(x[outer])
    allowed = max(_AS_GOOD * float(np.mean(q.missed[outer] ** 2)), _NEXT_TO_NONE * float(np.var(y[outer])))
    if not np.mean(missed**2) <= allowed:
        return low, high
    return middle + _WIDER * (low - middle), middle + _WIDER * (high - middle)


def _with_norms(
    x: Array, y: Array, folds: NDArray[np.intp], held_out: tuple[int, int], rng: np.random.Generator
) -> tuple[Regressed, NDArray[np.intp]]:
    """A quadratic with norms, as :func:`_network`."""
    test, stop = (np.flatnonzero(folds == k) for k in held_out)
    seen = np.flatnonzero((folds != held_out[0]) & (folds != held_out[1]))
    return fit_norms((x[seen], y[seen]), (x[stop], y[stop]), rng), test


def _network(
    x: Array, y: Array, folds: NDArray[np.intp], held_out: tuple[int, int], rng: np.random.Generator
) -> tuple[Regressed, NDArray[np.intp]]:
    """A quadratic and a network of what it misses, which ends by one fold, and the rows of the other, not seen."""
    test, stop = (np.flatnonzero(folds == k) for k in held_out)
    seen = np.flatnonzero(folds != held_out[0])
    q = _fitted(RandomFeatures(x, 0, rng), x[seen], y[seen], folds[seen])
    rest = (y - q(x))[:, None]
    data, ends = ((x[rows], rest[rows]) for rows in (_some(np.setdiff1d(seen, stop), rng), _some(stop, rng)))
    return Corrected(q, fit_small_network(data, ends, _HIDDEN, int(rng.integers(2**31)))), test


def _ratio(found: list[tuple[Regressed, NDArray[np.intp]]], y: Array, x: Array, q: Fitted) -> float:
    """The squared error of regressions in that of the quadratic, on the rows that none has seen."""
    own = sum(float(np.sum((y[rows] - g(x[rows])) ** 2)) for g, rows in found)
    other = sum(float(np.sum(q.missed[rows] ** 2)) for _, rows in found)
    return own / other if other > 0.0 else 1.0


def _some(rows: NDArray[np.intp], rng: np.random.Generator) -> NDArray[np.intp]:
    return rows if len(rows) <= _NETWORK_ROWS else np.sort(rng.permutation(rows)[:_NETWORK_ROWS])
