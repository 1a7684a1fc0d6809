"""A network of two small hidden layers with bounded outputs: as an expression, as arrays, and how it is fitted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import casadi as ca
import numpy as np

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
    rng: np.random.Generator,
    effort: Effort | None = None,
) -> SmallNetwork:
    """The network nearest to targets in mean square, by Levenberg and Marquardt (doi:10.1137/0111030).

    Each step is on a random part of the rows; what is best on the rows held out is kept. Weights are pulled towards
    zero as much as these rows allow: a rough network fits noise, and makes plans on it hard to find.

    Args:
        data: Inputs ``(rows, n)`` and targets ``(rows, m)``, of which errors of one size mean the same.
        stop: Rows held out.
        hidden: Widths.
        rng: Draws weights and rows.
        effort: Rows, steps, and the pulls that are tried.
    """
    effort = effort or Effort()
    gate = Gate.of(data[0])
    limit = np.maximum(_REACH * np.abs(data[1]).max(axis=0), np.finfo(np.float64).tiny)
    (z, open_), (z_stop, open_stop) = (gate.standardised(part[0]) for part in (data, stop))
    sizes, draw = (z.shape[1], *hidden, data[1].shape[1]), int(rng.integers(2**31))
    batches, size = (z, open_[:, None] * limit, data[1]), float(np.mean(data[1] ** 2))
    held_out = z_stop, open_stop[:, None] * limit, stop[1]

    def descended(decay: float) -> tuple[Layers, float]:
        return _descended(sizes, batches, held_out, decay * size, np.random.default_rng(draw), effort)

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
            diagonal = damping * (np.diag(curvature) + decay) + decay
            trial = p + np.linalg.solve(curvature + np.diag(diagonal), slope)
            if _error(_layers(trial, shapes), *batch) + decay * trial @ trial < error + decay * p @ p:
                p, damping = trial, max(damping / 3.0, least)
                break
            damping = min(4.0 * damping, most)
        now = _error(_layers(p, shapes), *held_out)
        best, least_error, since = (p, now, 0) if now < least_error else (best, least_error, since + 1)
        if since >= _PATIENCE:
            break
    return _layers(best, shapes), least_error


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
    """J'J, J'(targets - y) and the squared error, per row; J by back-propagation, one output after the other."""
    weights, biases = layers
    signals, slopes = _signals(weights, biases, z)
    missed = targets - unit * signals[-1]
    curvature, slope = np.zeros((size, size)), np.zeros(size)
    n_weights = sum(A.size for A in weights)
    for o in range(targets.shape[1]):
        to_a = unit[:, o] * slopes[2][:, o]
        to_second = to_a[:, None] * weights[2][o] * slopes[1]
        to_first = (to_second @ weights[1]) * slopes[0]
        blocks = [
            (to_first[:, :, None] * signals[0][:, None, :]).reshape(len(z), -1),
            (to_second[:, :, None] * signals[1][:, None, :]).reshape(len(z), -1),
            to_a[:, None] * signals[2],
            to_first,
            to_second,
            to_a[:, None],
        ]
        n_0, n_1, _ = (A.size for A in weights)
        m_0, m_1 = biases[0].size, biases[1].size
        width = weights[2].shape[1]
        places = np.concatenate(
            [
                np.arange(n_0 + n_1),
                n_0 + n_1 + o * width + np.arange(width),
                n_weights + np.arange(m_0 + m_1),
                [n_weights + m_0 + m_1 + o],
            ]
        )
        J = np.concatenate(blocks, axis=1, dtype=np.float32)
        curvature[np.ix_(places, places)] += J.T @ J
        slope[places] += J.T @ missed[:, o].astype(np.float32)
    return curvature / len(z), slope / len(z), float(np.sum(missed**2) / len(z))
