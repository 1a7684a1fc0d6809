"""The networks while they learn: all weights of one in one vector, and the gradient in it written out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mpcoffline.datasets.table.transitions import Columns
from mpcoffline.learning.adam import STATE, Adam
from mpcoffline.learning.reduction import Parts, Reduction

from .methods import ValueMethod


class FlatNetwork:
    r"""A tanh network with one output as a differentiable function of one vector of weights.

    ::

        h_0 = x,    h_k = tanh(h_{k-1} W_k + b_k),    y = h_K w + b

    The same function as :func:`~mpcoffline.learning.value.function.tanh_network`. Optimiser and target network become
    operations on one vector, and the gradient costs little more than its matrix products: one operation a layer
    instead of a graph, tanh(z) = 2 sigmoid(2z) - 1 (torch's sigmoid is three times as fast as its tanh on a CPU), and
    W stored as ``(n_in, n_out)``, so that a narrow input makes no thin matrix product.

    Args:
        widths: Number of inputs, widths of the hidden layers, 1.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        self.n_in: int = widths[0]
        self.shapes: list[tuple[int, int]] = list(pairwise(widths))

    @classmethod
    def like(cls, net: nn.Sequential) -> FlatNetwork:
        """One of the same layers."""
        linear = [layer for layer in net if isinstance(layer, nn.Linear)]
        return cls([linear[0].in_features, *(layer.out_features for layer in linear)])

    def layers(self, weights: Tensor) -> list[tuple[Tensor, Tensor]]:
        """W ``(n_in, n_out)`` and b ``(n_out,)`` of each layer, as views of the vector."""
        sizes = [size for n_in, n_out in self.shapes for size in (n_in * n_out, n_out)]
        parts = torch.split(weights, sizes)
        return [(parts[2 * i].view(shape), parts[2 * i + 1]) for i, shape in enumerate(self.shapes)]

    def weights_of(self, net: nn.Sequential) -> Tensor:
        """The weights of a network of these layers as a vector."""
        linear = [layer for layer in net if isinstance(layer, nn.Linear)]
        parts = [part for layer in linear for part in (layer.weight.t().reshape(-1), layer.bias)]
        return torch.cat([part.detach() for part in parts])

    def store(self, weights: Tensor, net: nn.Sequential) -> None:
        """Writes a vector of weights into a network of these layers."""
        linear = [layer for layer in net if isinstance(layer, nn.Linear)]
        with torch.no_grad():
            for layer, (W, b) in zip(linear, self.layers(weights), strict=True):
                layer.weight.copy_(W.t())
                layer.bias.copy_(b)

    def __call__(self, weights: Tensor, x: Tensor) -> Tensor:
        """Outputs ``(...)`` at inputs ``(..., n_in)``, differentiable in the weights alone."""
        y: Tensor = _Output.apply(weights, x.reshape(-1, self.n_in), self)  # type: ignore[no-untyped-call]
        return y.reshape(x.shape[:-1])


class _Output(torch.autograd.Function):
    """y(weights, x) of a :class:`FlatNetwork`, ``(B,)``."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, x: Tensor, network: FlatNetwork) -> Tensor:
        *hidden_layers, (w, b) = network.layers(weights)
        activations = [x]
        for W, bias in hidden_layers:
            z = torch.addmm(bias, activations[-1], W, beta=2, alpha=2).sigmoid_()
            activations.append(z.mul_(2).sub_(1))
        ctx.network = network
        ctx.save_for_backward(weights, *activations)
        return torch.addmm(b, activations[-1], w).squeeze(-1)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None, None]:
        weights, *activations = ctx.saved_tensors
        gradient = torch.empty_like(weights)
        layers, gradients = ctx.network.layers(weights), ctx.network.layers(gradient)
        back = slope[:, None]
        for k in reversed(range(len(layers))):
            dW, db = gradients[k]
            torch.mm(activations[k].t(), back, out=dW)
            torch.sum(back, dim=0, out=db)
            if k > 0:
                back = back @ layers[k][0].t()
                squares = activations[k].square_()  # in place: large new tensors cost page faults
                back.addcmul_(back, squares, value=-1)  # tanh' = 1 - tanh^2
        return gradient, None, None


class FlatCritic:
    """V, and Q where the method learns one, each a :class:`FlatNetwork` with its vector of weights.

    Args:
        networks: V, and perhaps Q on (s, a).
        weights: One vector a network.
        bounds: Between which all outputs are held.
    """

    networks: list[FlatNetwork]
    weights: list[Tensor]
    bounds: tuple[float, float] | None

    def __init__(
        self,
        networks: Sequence[FlatNetwork],
        weights: Sequence[Tensor],
        bounds: tuple[float, float] | None = None,
    ) -> None:
        self.networks, self.weights, self.bounds = list(networks), list(weights), bounds

    def __call__(self, observations: Tensor) -> Tensor:
        """V of observations ``(..., ny)``, shape ``(...)``."""
        return self._outputs(0, observations)

    def q(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Q of observations ``(..., ny)`` and actions ``(..., nu)``, shape ``(...)``."""
        return self._outputs(1, torch.cat([observations, actions], dim=-1))

    def _outputs(self, i: int, x: Tensor) -> Tensor:
        y = self.networks[i](self.weights[i], x)
        return y if self.bounds is None else y.clamp(*self.bounds)


class Member:
    """One critic that learns, its target and its optimiser.

    Args:
        nets: V's initial network, and Q's where the method learns one.
        bounds: Between which the target is held.
        device: Torch device.
        reduction: How a gradient over a minibatch is taken.
    """

    def __init__(
        self, nets: Sequence[nn.Sequential], bounds: tuple[float, float], device: str, reduction: Reduction
    ) -> None:
        networks = [FlatNetwork.like(net) for net in nets]
        start = [network.weights_of(net).to(device) for network, net in zip(networks, nets, strict=True)]
        self.critic: FlatCritic = FlatCritic(networks, [weights.clone().requires_grad_() for weights in start])
        self.target: FlatCritic = FlatCritic(networks, start, bounds)
        self._optimiser, self._reduction = Adam(self.critic.weights, fused=True), reduction

    def descend(self, method: ValueMethod, parts: Parts, discount: float, learning_rate: float, polyak: float) -> float:
        """One step of Adam, after which the target follows; nothing changes where the gradient is not finite.

        Returns:
            The loss; NaN where no step was made.
        """

        def loss(batch: Columns) -> tuple[Tensor, Tensor]:
            found = method.loss(self.critic, self.target, batch, discount)
            return found, found

        self._optimiser.zero_grad()
        shown = self._reduction.gradient(loss, parts, self.critic.weights)
        steepness = sum(float(weights.grad.norm()) for weights in self.critic.weights if weights.grad is not None)
        if not math.isfinite(steepness):  # one NaN would stay in Adam's moments for ever
            return math.nan
        self._optimiser.learning_rate = learning_rate
        self._optimiser.step()
        with torch.no_grad():
            for following, weights in zip(self.target.weights, self.critic.weights, strict=True):
                following.lerp_(weights, polyak)
        return shown

    def loss(self, method: ValueMethod, batch: Columns, discount: float) -> float:
        """The loss of what is learned so far, with V in place of its target."""
        with torch.no_grad():
            return float(method.loss(self.critic, self.critic, batch, discount))

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Weights, target and Adam's state."""
        arrays: dict[str, NDArray[Any]] = {}
        for i, (weights, target) in enumerate(zip(self.critic.weights, self.target.weights, strict=True)):
            tensors = {"weights": weights, "target": target, **self._optimiser.state.get(weights, {})}
            arrays |= {f"{i}.{name}": tensor.detach().cpu().numpy().copy() for name, tensor in tensors.items()}
        return arrays

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Takes over what :meth:`to_arrays` gave.

        Raises:
            KeyError: If an array is missing.
            ValueError: If one is of another shape.
        """
        for i, (weights, target) in enumerate(zip(self.critic.weights, self.target.weights, strict=True)):
            with torch.no_grad():
                weights.copy_(same_shape(arrays[f"{i}.weights"], weights))
                target.copy_(same_shape(arrays[f"{i}.target"], target))
            if f"{i}.step" in arrays:
                step = torch.zeros((), device=weights.device)
                self._optimiser.state[weights] = {
                    name: same_shape(arrays[f"{i}.{name}"], step if name == "step" else weights) for name in STATE
                }


def whole_numbers(array: NDArray[Any], count: int) -> list[int]:
    """So many counters of a file, whatever their type.

    Raises:
        ValueError: If there are more or fewer, or one is no whole number.
    """
    found = np.array(array)
    whole = found.shape == (count,) and found.dtype.kind in "iuf" and bool(np.isfinite(found).all())
    if not whole or (found != np.floor(found)).any():
        raise ValueError(f"{found.tolist()!r:.80} instead of {count} whole numbers")
    return [int(number) for number in found.tolist()]


def same_shape(array: NDArray[Any], like: Tensor) -> Tensor:
    """An array of a file as a tensor of the shape, type and device of another; nothing is stretched over it.

    Raises:
        ValueError: If it has another shape or type.
    """
    found = torch.from_numpy(np.array(array))
    if found.shape != like.shape or found.dtype != like.dtype:
        raise ValueError(f"{found.dtype} {tuple(found.shape)} instead of {like.dtype} {tuple(like.shape)}")
    return found.to(like.device)
