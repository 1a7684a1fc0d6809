"""Regressions with norms: costs that are distances, or sums of absolute errors, beside a quadratic."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.estimation.features import RandomFeatures
from mpcoffline.mpc.scaling import spread_of

_SHAPES = ((1, 3), (2, 3), (3, 1))  # norms, and how many directions each is of: a distance, two, absolute errors
_EXACT = 1e-8  # of the variance of unit costs: no need to look further
_STARTS = 4  # of each
_FIRST_ITERATIONS, _FEW = 40, 3  # of all starts; those that go on
_OPTIONS: Any = {"maxiter": 300, "maxcor": 30, "ftol": 1e-9, "gtol": 1e-8}
_REFINING: Any = {"maxiter": 500, "maxfun": 2_000, "maxcor": 50, "ftol": 1e-12, "gtol": 1e-12}
_NEARLY = 1e-4  # of the variance of unit costs, missed: may be exact
_LIGHTER = 1e-5  # the penalty on weights then
_ROWS = 2_000
_RIDGE = 1e-9  # of the mean square of the features
_WIDTH = 0.4  # of a kink, in spreads, to begin with
_SHARPEST, _WIDEST = 1e-6, 1e2  # likewise, at the end


class Norms(NamedTuple):
    """A quadratic and norms of affine functions, which may have sharp kinks.

    ::

        L(x) = c' q(x) + sum_j w_j sqrt(|C_j z + d_j|^2 + e_j^2),   z = (x - mean) / spread

    Attributes:
        features: q, the products of two entries of x, the entries, and 1.
        mean: Of x, ``(d,)``.
        spread: Likewise.
        directions: C, ``(j, r, d)``.
        offsets: d, ``(j, r)``.
        widths: Logarithms of e, ``(j,)``.
        weights: c and w, ``(m + j,)``.
    """

    features: RandomFeatures
    mean: Array
    spread: Array
    directions: Array
    offsets: Array
    widths: Array
    weights: Array

    def __call__(self, x: Array) -> Array:
        """Of x ``(n, d)``, ``(n,)``."""
        norms = _norms(((x - self.mean) / self.spread).T, self.directions, self.offsets, self.widths)[1]
        return np.asarray(np.hstack([self.features(x), norms.T]) @ self.weights)

    def expression(self, x: ca.SX, least: Array) -> ca.SX:
        """The same as a CasADi scalar in x ``(d, 1)``.

        Args:
            x: The symbols.
            least: What the widths are at least, ``(j,)``: a method that follows slopes creeps at sharp kinks.
        """
        z = (x - self.mean) / self.spread
        quadratic = [ca.SX(1), *ca.vertsplit(z), *(z[int(i)] * z[int(j)] for i, j in zip(*self._pairs, strict=True))]
        widths = np.maximum(np.exp(self.widths), least)
        each = zip(self.directions, self.offsets, widths, strict=True)
        norms = [ca.sqrt(ca.sumsqr(ca.DM(C) @ z + ca.DM(d)) + e**2) for C, d, e in each]
        return ca.dot(ca.DM(self.weights), ca.vertcat(*quadratic, *norms))

    def sizes(self, x: Array) -> Array:
        """How large the norms are at x ``(n, d)``: the roots of their mean squares, ``(j,)``."""
        norms = _norms(((x - self.mean) / self.spread).T, self.directions, self.offsets, self.widths)[1]
        return np.asarray(np.sqrt(np.mean(norms**2, axis=1)))

    @property
    def _pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        return np.triu_indices(len(self.mean))


def fit_norms(data: tuple[Array, Array], ends: tuple[Array, Array], rng: np.random.Generator) -> Norms:
    """Learns one by least squares from several starts: of some shapes, the one that is best on other rows.

    What enters linearly is solved for at each step (variable projection: Golub and Pereyra,
    doi:10.1137/0710036).

    Args:
        data: x ``(n, d)`` and costs ``(n,)`` to learn from, costs of about unit size.
        ends: Others, by which the shape is chosen.
        rng: Draws rows and starts.
    """
    x, y = data
    if len(x) > _ROWS:
        kept = np.sort(rng.permutation(len(x))[:_ROWS])
        x, y = x[kept], y[kept]
    features, mean, spread = RandomFeatures(x, 0, rng), x.mean(axis=0), spread_of(x)
    projected = _Projected(features(x), (x - mean) / spread, y)

    def judged(parts: tuple[Array, Array, Array, Array]) -> tuple[float, Norms]:
        norms = Norms(features, mean, spread, *parts)
        return float(np.mean((norms(ends[0]) - ends[1]) ** 2)), norms

    begun = [judged(projected.begun(directions, rng)) for directions in _starts(x.shape[1], rng)]
    found: list[tuple[float, Norms]] = []
    for _, norms in sorted(begun, key=lambda each: each[0])[:_FEW]:
        found.append(judged(projected.solved(norms)))
        if found[-1][0] <= _EXACT:
            break
    missed, best = min(found, key=lambda each: each[0])
    return best if missed > _NEARLY else Norms(features, mean, spread, *projected.refined(best))


def _starts(d: int, rng: np.random.Generator) -> Iterator[Array]:
    """Directions ``(j, r, d)`` to begin with: at random of each shape; along all axes, for absolute errors."""
    for count, size in _SHAPES:
        for _ in range(_STARTS):
            yield rng.standard_normal((count, min(size, d), d)) / np.sqrt(d)
    if d > 1:
        yield np.eye(d)[:, None, :]


class _Projected:
    """The squared error as a function of what enters nonlinearly, the rest being the best."""

    def __init__(self, q: Array, z: Array, y: Array) -> None:
        # Rows in a row of memory each: what is done thousands of times goes along them.
        self._q, self._z, self._y = (np.ascontiguousarray(each.T) for each in (q, z, y))
        self._gram, self._slope = q.T @ q / len(q), q.T @ y / len(q)
        self._ridge = _RIDGE * float(np.trace(self._gram)) / len(self._gram)

    def begun(self, directions: Array, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
        """Directions, offsets, logarithms of widths and weights of norms, some steps from directions ``(j, r, d)``."""
        count, size, _ = directions.shape
        start = directions, 0.3 * rng.standard_normal((count, size)), np.full(count, np.log(_WIDTH))
        return self._descended(self._error, start, _OPTIONS | {"maxiter": _FIRST_ITERATIONS})

    def solved(self, norms: Norms) -> tuple[Array, Array, Array, Array]:
        """The same, from what was begun."""
        return self._descended(self._error, (norms.directions, norms.offsets, norms.widths), _OPTIONS)

    def refined(self, norms: Norms) -> tuple[Array, Array, Array, Array]:
        """The same, from some that are nearly exact: what is exact becomes so to rounding, nothing else does.

        It is the logarithm of the error that falls, and hardly any weight is too large.
        """
        self._ridge *= _LIGHTER

        def logarithm(p: Array) -> tuple[float, Array]:
            error, slope = self._error(p)
            error = max(error, np.finfo(np.float64).tiny)
            return float(np.log(error)), slope / error

        return self._descended(logarithm, (norms.directions, norms.offsets, norms.widths), _REFINING)

    def _descended(
        self, error: Callable[[Array], tuple[float, Array]], start: tuple[Array, Array, Array], options: Any
    ) -> tuple[Array, Array, Array, Array]:
        self._shapes: tuple[tuple[int, ...], ...] = tuple(part.shape for part in start)
        first = np.concatenate([part.ravel() for part in start])
        bounds = self._bounds()
        done = scipy.optimize.minimize(error, first, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return self._whole(done.x)

    def _bounds(self) -> list[tuple[float | None, float | None]]:
        *free, widths = (int(np.prod(shape)) for shape in self._shapes)
        low, high = float(np.log(_SHARPEST)), float(np.log(_WIDEST))
        return [*[(None, None)] * sum(free), *[(low, high)] * widths]

    def _whole(self, p: Array) -> tuple[Array, Array, Array, Array]:
        parts = self._parts(p)
        return (*parts, self._weights(_norms(self._z, *parts)[1]))

    def _parts(self, p: Array) -> tuple[Array, Array, Array]:
        directions, offsets, widths = self._shapes
        first, last = math.prod(directions), len(p) - math.prod(widths)
        return p[:first].reshape(directions), p[first:last].reshape(offsets), p[last:]

    def _weights(self, norms: Array) -> Array:
        n, m = len(self._y), len(self._q)
        mixed = self._q @ norms.T / n
        gram = np.empty((m + len(norms), m + len(norms)))
        gram[:m, :m], gram[:m, m:], gram[m:, :m], gram[m:, m:] = self._gram, mixed, mixed.T, norms @ norms.T / n
        gram[np.diag_indices_from(gram)] += self._ridge
        return np.asarray(np.linalg.solve(gram, np.append(self._slope, norms @ self._y / n)))

    def _error(self, p: Array) -> tuple[float, Array]:
        directions, offsets, widths = self._parts(p)
        v, norms = _norms(self._z, directions, offsets, widths)
        weights = self._weights(norms)
        m, n = len(self._q), len(self._y)
        missed = weights[:m] @ self._q + weights[m:] @ norms - self._y
        # At the best weights their own derivatives are zero: only the explicit ones are left.
        pull = (2.0 / n * weights[m:, None]) * missed / norms
        by_offset = pull[:, None] * v
        by_width = pull.sum(axis=1) * np.exp(2.0 * widths)
        by_direction = by_offset.reshape(-1, n) @ self._z.T
        error = float(missed @ missed) / n + self._ridge * float(weights @ weights)
        return error, np.concatenate([by_direction.ravel(), by_offset.sum(axis=2).ravel(), by_width])


def _norms(z: Array, directions: Array, offsets: Array, widths: Array) -> tuple[Array, Array]:
    """Of z ``(d, n)``: ``C_j z + d_j`` ``(j, r, n)`` and the norms ``(j, n)``."""
    j, r, d = directions.shape
    v = (directions.reshape(j * r, d) @ z).reshape(j, r, -1) + offsets[:, :, None]
    return v, np.sqrt(np.square(v).sum(axis=1) + np.exp(2.0 * widths)[:, None])
