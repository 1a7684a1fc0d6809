"""A network of two small hidden layers with bounded outputs: as an expression, as arrays, and how it is fitted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Self

import casadi as ca
import numpy as np
import torch
from numpy.typing import NDArray

from mpcoffline.core.threads import at_leisure
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


Layers = list[Array]  # matrices [A, b], next to each other: signals are followed by a 1
Rows = tuple[Array, Array, Array]  # inputs, unit of each output, targets
Single = NDArray[np.float32]


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
        layers = [np.column_stack([A, b]) for A, b in zip(self.weights, self.biases, strict=True)]
        return np.asarray(gate[:, None] * self.limit * _signals(layers, z)[0][-1])

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
    # Squares of targets in any unit are numbers of single precision; a power of two, so that it changes no bit.
    unit = np.exp2(np.floor(np.log2(limit.max())))
    batches = z, open_[:, None] * (limit / unit), data[1] / unit
    held_out, size = (z_stop, open_stop[:, None] * (limit / unit), stop[1] / unit), float(np.mean(batches[2] ** 2))

    def descended(decay: float) -> tuple[Layers, float]:
        return _descended(sizes, batches, held_out, decay * size, np.random.default_rng(seed), effort)

    # Which pulls are worth it is known behind the first ones; but a core that has nothing else to do may as well try.
    tried = at_leisure([partial(descended, decay) for decay in effort.decays])
    chosen, (best, error) = effort.decays[0], next(tried)
    for decay, (other, smaller) in zip(effort.decays[1:], tried, strict=True):
        if not smaller < _WORTH * error:
            break
        best, error, chosen = other, smaller, decay
    return SmallNetwork(gate, tuple(M[:, :-1] for M in best), tuple(M[:, -1] for M in best), limit, chosen)


def _descended(
    sizes: tuple[int, ...],
    data: Rows,
    held_out: Rows,
    decay: float,
    rng: np.random.Generator,
    effort: Effort,
) -> tuple[Layers, float]:
    """Weights and biases with the smallest error on the rows held out, and that error."""
    layers = [np.column_stack([A, b]) for A, b in zip(*random_layers(sizes, rng), strict=True)]
    layers[-1] = np.column_stack([_NARROW * layers[-1][:, :-1], np.zeros(sizes[-1])])
    p, shapes = np.concatenate([M.ravel() for M in layers]), [M.shape for M in layers]
    best, least_error, since = p, _error(_layers(p, shapes), *held_out), 0
    damping, least, most = _DAMPING
    for _ in range(effort.steps):
        rows = rng.permutation(len(data[0]))[: effort.rows]
        batch = data[0][rows], data[1][rows], data[2][rows]
        curvature, slope, error = _normal_equations(_layers(p, shapes), *batch)
        slope, diagonal = slope - decay * p, np.diag(curvature).astype(np.float64)
        for _ in range(_ATTEMPTS):
            step = _solved(curvature, damping * (diagonal + decay) + decay, slope)
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


def _solved(curvature: Single, diagonal: Array, slope: Array) -> Array | None:
    """The step ``(curvature + diag(diagonal))^-1 slope``; None where rounding has left the sum without a root.

    A step is a trial, so single precision is enough. At these sizes torch's factor takes a fifth of numpy's time, and
    other members of an ensemble go on meanwhile, for which scipy's would not let go of the interpreter.
    """
    matrix = torch.from_numpy(curvature.copy())
    matrix.diagonal().add_(torch.from_numpy(diagonal))
    root, failed = torch.linalg.cholesky_ex(matrix)
    if failed:
        return None
    step = torch.cholesky_solve(torch.from_numpy(slope.astype(np.float32))[:, None], root)
    return np.asarray(step[:, 0].numpy(), dtype=np.float64)


def _layers(flat: Array, shapes: list[tuple[int, ...]]) -> Layers:
    """The matrices of a flat vector."""
    ends = np.cumsum([np.prod(shape, dtype=int) for shape in shapes])
    return [part.reshape(shape) for part, shape in zip(np.split(flat, ends[:-1]), shapes, strict=True)]


def _signals(layers: Layers, z: Array) -> tuple[list[Array], list[Array]]:
    """The signals z, s(..), s(..), y, and the slopes of the three activations."""
    signals, slopes = [z], []
    for M in layers:
        a = signals[-1] @ M[:, :-1].T + M[:, -1]
        norm = 1.0 / np.sqrt(1.0 + a * a)
        signals.append(a * norm)
        slopes.append(norm * norm * norm)  # a power takes ten times as long
    return signals, slopes


def _error(layers: Layers, z: Array, unit: Array, targets: Array) -> float:
    return float(np.sum((unit * _signals(layers, z)[0][-1] - targets) ** 2) / len(z))


def _normal_equations(layers: Layers, z: Array, unit: Array, targets: Array) -> tuple[Single, Array, float]:
    """J'J, on and below its diagonal, J'(targets - y), and the squared error, per row.

    A layer's part of a row of J is an outer product, of what back-propagation gives for an output o and the layer's
    input, ``d_o v'``. So nothing needs J: of two layers, with sums over outputs before those over rows::

        J_l'J_k = sum_rows (sum_o d_lo d_ko') x (v_l v_k')

    The sum of the second layer is linear in the squared slopes of outputs, and those of the first one are products of
    it with A_1. Where l = k both factors are symmetric, and a quarter of their entries is enough.
    """
    signals, slopes = _signals(layers, z)
    n, single = len(z), np.float32
    missed, last = targets - unit * signals[-1], unit * slopes[2]
    A_1, A_2 = (layer[:, :-1].astype(single) for layer in layers[1:])
    # Rows come last: then every product below is one of whole lines.
    v = [np.vstack([signal.T, np.ones(n)], dtype=single) for signal in signals[:3]]
    out, s_0, s_1 = (np.ascontiguousarray(each.T, dtype=single) for each in (last, slopes[0], slopes[1]))
    size_1, size_2 = len(A_1), len(out)
    second_second = (_pairs(A_2.T, A_2.T) @ out**2).reshape(size_1, size_1, n) * s_1[:, None] * s_1
    first_second = _through(A_1, second_second) * s_0[:, None]
    second_first = np.ascontiguousarray(first_second.transpose(1, 0, 2))
    first_first = _through(A_1, second_first) * s_0[:, None]
    second = A_2.T[:, :, None] * out * s_1[:, None]
    first = _through(A_1, second) * s_0[:, None]
    below = {
        (0, 0): _symmetric_sums(first_first, v[0]),
        (1, 0): _sums(second_first, v[1], v[0]),
        (1, 1): _symmetric_sums(second_second, v[1]),
        (2, 0): _sums((first * out).transpose(1, 0, 2), v[2], v[0]),
        (2, 1): _sums((second * out).transpose(1, 0, 2), v[2], v[1]),
    }
    ends = np.cumsum([0, *(M.size for M in layers)])
    parts = [slice(ends[k], ends[k + 1]) for k in range(3)]
    curvature = np.zeros((ends[-1], ends[-1]), dtype=single)
    for (i, k), block in below.items():
        np.divide(block, n, out=curvature[parts[i], parts[k]])
    for o, block in enumerate((out**2 @ _pairs(v[2], v[2]).T).reshape(size_2, len(v[2]), -1)):
        at = slice(ends[2] + o * len(block), ends[2] + (o + 1) * len(block))
        np.divide(block, n, out=curvature[at, at])
    pulled_2 = last * missed
    pulled_1 = (pulled_2 @ layers[2][:, :-1]) * slopes[1]
    pulled_0 = (pulled_1 @ layers[1][:, :-1]) * slopes[0]
    slope = [(signal @ pulled).T.ravel() for pulled, signal in zip((pulled_0, pulled_1, pulled_2), v, strict=True)]
    return curvature, np.concatenate(slope) / n, float(np.sum(missed**2) / n)


def _through(A: Single, d: Single) -> Single:
    """``sum_a A_ab d_a..``: what back-propagation makes of the outputs of a matrix."""
    return np.asarray((A.T @ d.reshape(len(d), -1)).reshape(A.shape[1], *d.shape[1:]))


def _pairs(a: Single, b: Single) -> Single:
    """Products of each line of one and each of the other, ``(lines of a x lines of b, n)``."""
    return np.asarray((a[:, None] * b).reshape(-1, a.shape[1]))


def _sums(d: Single, v: Single, w: Single) -> Single:
    """``sum_rows d_ab v_c w_e`` as a matrix of rows (a, c) and columns (b, e)."""
    summed = d.reshape(-1, d.shape[2]) @ _pairs(v, w).T
    return np.asarray(summed.reshape(*d.shape[:2], len(v), -1).transpose(0, 2, 1, 3).reshape(len(d) * len(v), -1))


def _symmetric_sums(d: Single, v: Single) -> Single:
    """The same of symmetric d, and v twice: of the entries above the diagonals alone."""
    (above_d, of_d), (above_v, of_v) = (_above(len(each)) for each in (d, v))
    whole, size = (d[above_d] @ (v[above_v[0]] * v[above_v[1]]).T)[of_d][:, of_v], len(d) * len(v)
    return np.asarray(whole.reshape(len(d), len(d), len(v), -1).transpose(0, 2, 1, 3).reshape(size, size))


def _above(size: int) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], NDArray[np.intp]]:
    """Indices of a matrix's upper triangle, and for each entry of the matrix which of them it is."""
    above = np.triu_indices(size)
    where = np.zeros((size, size), dtype=np.intp)
    where[above] = where[above[1], above[0]] = np.arange(len(above[0]))
    return above, where.ravel()
