"""Fitting a small network to a function: nonlinear least squares by Levenberg and Marquardt."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from mpcoffline.core.types import Array
from mpcoffline.mpc.networks import random_layers

Layers = list[tuple[Tensor, Tensor]]

_DAMPING = (1e-2, 1e-7, 1e8)  # at first, least, most
_ATTEMPTS = 8  # at a step that lowers the error
_STRIPS = 4
_DECAY = 1e-7  # pull of the weights towards zero: keeps what few data leave open small


def fit_network(
    inputs: Array,
    targets: Array,
    hidden: Sequence[int],
    *,
    rng: np.random.Generator,
    n_steps: int,
    batch_size: int,
) -> tuple[list[Array], list[Array]]:
    """The network of :class:`~mpcoffline.NetworkCost` that is nearest to some targets in mean square.

    A network of some hundred weights is fitted several times closer, in the same time, by Gauss-Newton steps than by
    stochastic gradients. Each step solves the linear least-squares problem around the present weights p,
    damped until the error falls (Marquardt, doi:10.1137/0111030)::

        (J'J + lambda diag(J'J)) dp = J'(targets - net),       J = d net / dp,    on a random part of the rows

    Args:
        inputs: Standardised inputs, ``(n, nx)``.
        targets: Standardised targets, ``(n,)``.
        hidden: Widths of the hidden layers.
        rng: Draws the first weights and the rows of each step.
        n_steps: Number of steps.
        batch_size: Rows a step.

    Returns:
        Weights and biases of the layers.
    """
    z, wanted = (torch.from_numpy(array.astype(np.float32)) for array in (inputs, targets))
    first = random_layers((inputs.shape[1], *hidden, 1), rng)
    layers = [(torch.from_numpy(A).float(), torch.from_numpy(b).float()) for A, b in zip(*first, strict=True)]
    damping, least, most = _DAMPING
    for _ in range(n_steps):
        rows = torch.from_numpy(rng.permutation(len(z))[:batch_size])
        output, jacobian = network_jacobian(layers, z[rows])
        residual = wanted[rows] - output
        curvature = squares(jacobian).double() / len(rows)
        slope = (jacobian.T @ residual).double() / len(rows) - _DECAY * _flat(layers)
        error = _objective(layers, residual)
        for _ in range(_ATTEMPTS):
            diagonal = torch.diag(damping * (torch.diag(curvature) + _DECAY) + _DECAY)
            factor, failed = torch.linalg.cholesky_ex(curvature + diagonal)
            step = torch.cholesky_solve(slope[:, None], factor)[:, 0]
            trial = _moved(layers, step)
            if not failed and _objective(trial, wanted[rows] - network(trial, z[rows])) < error:
                layers, damping = trial, max(damping / 3.0, least)
                break
            damping = min(damping * 4.0, most)
    weights, biases = zip(*((A.double().numpy(), b.double().numpy()) for A, b in layers), strict=True)
    return list(weights), list(biases)


def network(layers: Layers, z: Tensor) -> Tensor:
    """The network's output ``(n,)`` at inputs ``(n, nx)``; its activation is a / sqrt(1 + a^2)."""
    return _signals(layers, z)[0]


def network_jacobian(layers: Layers, z: Tensor) -> tuple[Tensor, Tensor]:
    """The output ``(n,)`` and its derivatives ``(n, size)`` in all weights, layer by layer: A row by row, then b."""
    output, signals, slopes = _signals(layers, z)
    blocks: list[Tensor] = []
    sensitivity = torch.ones_like(output)[:, None]
    for k in reversed(range(len(layers))):
        in_weights = sensitivity[:, :, None] * signals[k][:, None, :]
        blocks[:0] = [in_weights.flatten(1), sensitivity]
        if k > 0:
            sensitivity = (sensitivity @ layers[k][0]) * slopes[k - 1]
    return output, torch.cat(blocks, dim=1)


def _signals(layers: Layers, z: Tensor) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """The output, the input of each layer, and the slope of each activation."""
    signals, slopes = [z], []
    for A, b in layers[:-1]:
        a = torch.addmm(b, signals[-1], A.T)
        norm = torch.rsqrt(1.0 + a * a)
        signals.append(a * norm)
        slopes.append(norm**3)
    A, b = layers[-1]
    return torch.addmm(b, signals[-1], A.T).squeeze(-1), signals, slopes


def squares(jacobian: Tensor) -> Tensor:
    """J'J on and below its diagonal, all that is asked for, strip by strip: five eighths of the products."""
    size = jacobian.shape[1]
    found, ends = jacobian.new_zeros(size, size), [size * k // _STRIPS for k in range(_STRIPS + 1)]
    for low, high in pairwise(ends):
        found[low:high, :high] = jacobian[:, low:high].T @ jacobian[:, :high]
    return found


def _flat(layers: Layers) -> Tensor:
    return torch.cat([part.flatten() for layer in layers for part in layer]).double()


def _moved(layers: Layers, step: Tensor) -> Layers:
    """The layers after a step ``(size,)``."""
    parts = iter(torch.split(step.float(), [part.numel() for layer in layers for part in layer]))
    return [(A + next(parts).view_as(A), b + next(parts)) for A, b in layers]


def _objective(layers: Layers, residual: Tensor) -> float:
    return float(residual.square().mean() + _DECAY * _flat(layers).square().sum())
