"""Fitting the network of an explicit policy to an MPC's inputs: Adam, then L-BFGS."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mpcoffline.core.types import Array

from .network import PolicyNetwork

_BATCH = 1024
_RATE, _LAST_RATE = 4e-3, 1e-5  # of Adam, at first and at last, along half a cosine
_AT_BOUND = 1e-6  # of an input's unit: what is nearer to a bound is at it
_HISTORY = 30


def fit_policy(
    network: PolicyNetwork, states: Array, actions: Array, *, n_steps: int, n_refined: int, seed: int
) -> PolicyNetwork:
    r"""The network that is nearest to the inputs of some states in mean square, beginning with a given one.

    An input at its bound asks for an output beyond that bound, however far::

        loss = mean r^2,    r = o - u        within the bounds
                            r = min(o - u, 0)  at the upper one,    max(o - u, 0)  at the lower one

    where o is the network before its clip: nothing is paid for what the clip takes away, and where the sign is wrong
    the slope does not vanish, as that of the clip would.

    Args:
        network: Where to begin; its scales stay.
        states: States z, ``(n, nz)``.
        actions: Inputs, ``(n, nu)``.
        n_steps: Steps of Adam, each on 1,024 random rows.
        n_refined: Iterations of L-BFGS on all rows thereafter.
        seed: Draws the rows.
    """
    x = torch.from_numpy(((states - network.mean) / network.spread).astype(np.float32))
    u = torch.from_numpy(((actions - network.centre) / network.unit).astype(np.float32))
    low, high = ((bound - network.centre) / network.unit for bound in (network.low, network.high))
    at_low, at_high = (u <= torch.from_numpy(low + _AT_BOUND)), (u >= torch.from_numpy(high - _AT_BOUND))
    n_layers = len(network.weights)
    given = [network.direct, *network.weights, *network.biases]
    parameters = [torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in given]

    def loss(rows: Any) -> Tensor:
        residual = _outputs(parameters, n_layers, x[rows]) - u[rows]
        residual = torch.where(at_high[rows], residual.clamp(max=0.0), residual)
        residual = torch.where(at_low[rows], residual.clamp(min=0.0), residual)
        return residual.square().mean()

    generator = torch.Generator().manual_seed(seed)
    adam = torch.optim.Adam(parameters, lr=_RATE, fused=True)
    for k in range(n_steps):
        adam.param_groups[0]["lr"] = _LAST_RATE + _RATE * 0.5 * (1.0 + math.cos(math.pi * k / n_steps))
        adam.zero_grad()
        loss(torch.randint(len(x), (min(_BATCH, len(x)),), generator=generator)).backward()  # type: ignore[no-untyped-call]
        adam.step()
    refine = torch.optim.LBFGS(
        parameters, max_iter=n_refined, history_size=_HISTORY, tolerance_change=0.0, line_search_fn="strong_wolfe"
    )

    def closure() -> Tensor:
        refine.zero_grad()
        value = loss(slice(None))
        value.backward()  # type: ignore[no-untyped-call]
        return value

    before = [parameter.detach().clone() for parameter in parameters]
    if n_refined:
        refine.step(closure)  # type: ignore[no-untyped-call]
    if not all(bool(torch.isfinite(parameter).all()) for parameter in parameters):
        parameters = before
    direct, *layers = (parameter.detach().double().numpy() for parameter in parameters)
    return replace(network, direct=direct, weights=tuple(layers[:n_layers]), biases=tuple(layers[n_layers:]))


def _outputs(parameters: list[Tensor], n_layers: int, x: Tensor) -> Tensor:
    """The network's output in its unit, before the clip, ``(n, nu)``."""
    direct, weights, biases = parameters[0], parameters[1 : 1 + n_layers], parameters[1 + n_layers :]
    signal = x
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        a = torch.addmm(bias, signal, weight.T)
        signal = a * torch.rsqrt(1.0 + a * a)
    return torch.addmm(biases[-1], signal, weights[-1].T) + x @ direct.T
