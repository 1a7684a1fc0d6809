"""A network of two small hidden layers with bounded outputs: as an expression, as arrays, and how it is fitted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.mpc.networks import random_layers

_RADIUS = 0.999  # quantile of the data's distance from their middle
_BEYOND = 1.5  # times its square, at which the gate is half shut
_FLATTEST = 0.05  # variance of the flattest direction, in spreads: data of a control law lie on a surface
_REACH = 1.25  # times the largest target: the bound of an output
_DAMPING = (1e-2, 1e-7, 1e8)  # at first, least, most
_ATTEMPTS = 8
_WORTH = 0.95  # times the error on the data held out
_PATIENCE = 12  # steps without a smaller error on the data held out
_NARROW = 0.1  # of the size that random_layers gives to the output layer: the first guess is next to nothing


Layers = tuple[list[Array], list[Array]]  # weights and biases
Rows = tuple[Array, Array, Array]  # inputs, unit of each output, targets
Single = NDArray[np.float32]
Places = NDArray[np.intp]


class Effort(NamedTuple):
    """How a network is fitted.

    Attributes:
        rows: Number of rows that a step looks at.
        steps: Most of them.
        decays: How much weights are pulled towards zero: of the targets' mean square, a weight squared. The first, and
            each next one where it is worth it.
    """

    rows: int = 1_500
    steps: int = 60
    decays: tuple[float, ...] = (1e-2, 1e-3, 1e-4)


class Gate(NamedTuple):
    """1 within the data, 0 outside them: ``1 / (1 + |K z|^8)`` with z standardised and the data within |K z| < 0.8.

    Attributes:
        mean: Middle of the data, ``(n,)``.
        slope: One over their spread, 0 where they do not vary, ``(n,)``.
        K: Makes z white, divided by the radius, ``(n, n)``.
    """

    mean: Array
    slope: Array
    K: Array

    @classmethod
    def of(cls, data: Array) -> Self:
        """The gate of data ``(rows, n)``."""
        mean, spread = data.mean(axis=0), data.std(axis=0)
        moves = spread > 1e-9 * np.abs(data).max(axis=0)
        slope = np.where(moves, 1.0 / np.where(moves, spread, 1.0), 0.0)
        z = (data - mean) * slope
        variances, axes = np.linalg.eigh(z.T @ z / len(z))
        K = axes.T / np.sqrt(np.maximum(variances, _FLATTEST))[:, None]
        radius = float(np.quantile(np.sum((z @ K.T) ** 2, axis=1), _RADIUS))
        return cls(mean, slope, K / np.sqrt(_BEYOND * max(radius, 1.0)))

    def standardised(self, data: Array) -> tuple[Array, Array]:
        """Z ``(rows, n)`` and the gate ``(rows,)``."""
        z = (data - self.mean) * self.slope
        return z, 1.0 / (1.0 + np.sum((z @ self.K.T) ** 2, axis=1) ** 4)


@dataclass(frozen=True)
class SmallNetwork:
    """y = gate(v) limit s(A_2 s(A_1 s(A_0 z + b_0) + b_1) + b_2), z standardised v, s(a) = a / sqrt(1 + a^2).

    Attributes:
        gate: Keeps it at zero outside the data.
        weights: A_0, A_1, A_2.
        biases: b_0, b_1, b_2.
        limit: Bound of each output, ``(m,)``.
        decay: How much its weights were pulled towards zero.
    """

    gate: Gate
    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    limit: Array
    decay: float = 0.0

    def __call__(self, data: Array) -> Array:
        """The outputs ``(rows, m)`` at inputs ``(rows, n)``."""
        z, gate = self.gate.standardised(data)
        return np.asarray(gate[:, None] * self.limit * _signals(self.weights, self.biases, z)[0][-1])

    def expression(self, v: ca.SX) -> ca.SX:
        """The same for a symbol v ``(n, 1)``, ``(m, 1)``."""
        z = (v - self.gate.mean) * self.gate.slope
        gate = 1.0 / (1.0 + ca.sumsqr(ca.mtimes(self.gate.K, z)) ** 4)
        for A, b in zip(self.weights, self.biases, strict=True):
            a = ca.mtimes(ca.DM(A), z) + b
            z = a / ca.sqrt(1.0 + a**2)
        return gate * self.limit * z


def fit_small_network(
    data: tuple[Array, Array],
    stop: tuple[Array, Array],
    hidden: tuple[int, int],
    seed: int,
    effort: Effort | None = None,
) -> SmallNetwork:
    """The network nearest to targets in mean square, by Levenberg and Marquardt (doi:10.1137/0111030).

    Each step is on a random part of the rows; what is best on the rows held out is kept. Weights are pulled towards
    zero as much as these rows allow: a rough network fits noise, and makes plans on it hard to find.

    Args:
        data: Inputs ``(rows, n)`` and targets ``(rows, m)``, of which errors of one size mean the same.
        stop: Rows held out.
        hidden: Widths.
        seed: Draws weights and rows.
        effort: Rows, steps, and the pulls that are tried.
    """
    effort = effort or Effort()
    gate = Gate.of(data[0])
    limit = np.maximum(_REACH * np.abs(data[1]).max(axis=0), np.finfo(np.float64).tiny)
    (z, open_), (z_stop, open_stop) = (gate.standardised(part[0]) for part in (data, stop))
    sizes = (z.shape[1], *hidden, data[1].shape[1])
    batches, size = (z, open_[:, None] * limit, data[1]), float(np.mean(data[1] ** 2))
    held_out = z_stop, open_stop[:, None] * limit, stop[1]

    def descended(decay: float) -> tuple[Layers, float]:
        return _descended(sizes, batches, held_out, decay * size, np.random.default_rng(seed), effort)

    chosen = effort.decays[0]
    best, error = descended(chosen)
    for decay in effort.decays[1:]:
        other, smaller = descended(decay)
        if not smaller < _WORTH * error:
            break
        best, error, chosen = other, smaller, decay
    return SmallNetwork(gate, tuple(best[0]), tuple(best[1]), limit, chosen)


def _descended(
    sizes: tuple[int, ...],
    data: Rows,
    held_out: Rows,
    decay: float,
    rng: np.random.Generator,
    effort: Effort,
) -> tuple[Layers, float]:
    """Weights and biases with the smallest error on the rows held out, and that error."""
    weights, biases = random_layers(sizes, rng)
    weights[-1], biases[-1] = _NARROW * weights[-1], 0.0 * biases[-1]
    p = np.concatenate([part.ravel() for part in (*weights, *biases)])
    shapes = [part.shape for part in (*weights, *biases)]
    best, least_error, since = p, _error(_layers(p, shapes), *held_out), 0
    damping, least, most = _DAMPING
    for _ in range(effort.steps):
        rows = rng.permutation(len(data[0]))[: effort.rows]
        batch = data[0][rows], data[1][rows], data[2][rows]
        curvature, slope, error = _normal_equations(_layers(p, shapes), *batch, len(p))
        slope -= decay * p
        for _ in range(_ATTEMPTS):
            step = _solved(curvature, damping * (np.diag(curvature) + decay) + decay, slope)
            trial = p if step is None else p + step
            if (
                step is not None
                and _error(_layers(trial, shapes), *batch) + decay * trial @ trial < error + decay * p @ p
            ):
                p, damping = trial, max(damping / 3.0, least)
                break
            damping = min(4.0 * damping, most)
        now = _error(_layers(p, shapes), *held_out)
        best, least_error, since = (p, now, 0) if now < least_error else (best, least_error, since + 1)
        if since >= _PATIENCE:
            break
    return _layers(best, shapes), least_error


def _solved(curvature: Array, diagonal: Array, slope: Array) -> Array | None:
    """The step ``(curvature + diag(diagonal))^-1 slope``; None where rounding has left the sum without a root."""
    matrix = curvature.copy()
    np.fill_diagonal(matrix, np.diag(curvature) + diagonal)
    try:
        factor = scipy.linalg.cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(scipy.linalg.cho_solve(factor, slope, check_finite=False))


def _layers(flat: Array, shapes: list[tuple[int, ...]]) -> Layers:
    """Weights and biases of a flat vector."""
    ends = np.cumsum([np.prod(shape, dtype=int) for shape in shapes])
    parts = [part.reshape(shape) for part, shape in zip(np.split(flat, ends[:-1]), shapes, strict=True)]
    return parts[: len(parts) // 2], parts[len(parts) // 2 :]


def _signals(weights: list[Array] | tuple[Array, ...], biases: list[Array] | tuple[Array, ...], z: Array) -> Layers:
    """The signals z, s(..), s(..), y, and the slopes of the three activations."""
    signals, slopes = [z], []
    for A, b in zip(weights, biases, strict=True):
        a = signals[-1] @ A.T + b
        norm = 1.0 / np.sqrt(1.0 + a * a)
        signals.append(a * norm)
        slopes.append(norm**3)
    return signals, slopes


def _error(layers: Layers, z: Array, unit: Array, targets: Array) -> float:
    return float(np.sum((unit * _signals(*layers, z)[0][-1] - targets) ** 2) / len(z))


def _normal_equations(layers: Layers, z: Array, unit: Array, targets: Array, size: int) -> tuple[Array, Array, float]:
    """J'J, J'(targets - y) and the squared error, per row.

    A layer's part of a row of J is an outer product, of what back-propagation gives for an output o and the layer's
    input, ``d_o v'``. So nothing needs J: of two layers, with sums over outputs before those over rows::

        J_l'J_k = sum_rows (sum_o d_lo d_ko') x (v_l v_k')
    """
    weights, biases = layers
    signals, slopes = _signals(weights, biases, z)
    missed = targets - unit * signals[-1]
    n, single = len(z), np.float32
    last = (unit * slopes[2]).astype(single)
    second = last[:, :, None] * weights[2].astype(single) * slopes[1].astype(single)[:, None, :]
    first = (second @ weights[1].astype(single)) * slopes[0].astype(single)[:, None, :]
    back, inputs = (first, second), [np.hstack([v, np.ones((n, 1))], dtype=single) for v in signals[:3]]
    places = _places(weights, biases)
    curvature, slope = np.zeros((size, size)), np.zeros(size)

    def summed(d: Single, v: Single, w: Single) -> Single:
        """``sum_rows d v w'``, (entries of d, of v, of w)."""
        outer = (v[:, :, None] * w[:, None, :]).reshape(n, -1)
        return (d.reshape(n, -1).T @ outer).reshape(-1, v.shape[1], w.shape[1])

    def put(rows: Places, columns: Places, block: Single) -> None:
        curvature[np.ix_(rows, columns)] = block
        curvature[np.ix_(columns, rows)] = block.T

    for i, k in ((0, 0), (0, 1), (1, 1)):
        blocks = summed(back[i].transpose(0, 2, 1) @ back[k], inputs[i], inputs[k])
        shape = back[i].shape[2], back[k].shape[2], *blocks.shape[1:]
        block = blocks.reshape(shape).transpose(0, 2, 1, 3).reshape(places[i].size, places[k].size)
        put(places[i].ravel(), places[k].ravel(), block)
    own = summed(last**2, inputs[2], inputs[2])
    across = [summed(last[:, :, None] * d, v, inputs[2]) for d, v in zip(back, inputs, strict=False)]
    for o, mine in enumerate(places[2]):
        put(mine, mine, own[o])
        for theirs, blocks in zip(places, across, strict=False):
            put(theirs.ravel(), mine, blocks.reshape(len(places[2]), theirs.size, len(mine))[o])
    off = missed.astype(single)
    for d, v, where in zip((*back, None), inputs, places, strict=True):
        pulled = last * off if d is None else (off[:, None, :] @ d)[:, 0]
        slope[where] = pulled.T @ v
    return curvature / n, slope / n, float(np.sum(missed**2) / n)


def _places(weights: list[Array], biases: list[Array]) -> list[Places]:
    """Where the entries of each layer's ``[A, b]`` are in the flat vector of all weights and biases."""
    ends, sizes = np.cumsum([A.size for A in weights]), np.cumsum([b.size for b in biases])
    return [
        np.hstack(
            [
                np.arange(end - A.size, end).reshape(A.shape),
                ends[-1] + np.arange(stop - b.size, stop)[:, None],
            ]
        )
        for A, b, end, stop in zip(weights, biases, ends, sizes, strict=True)
    ]
