"""Adam without what torch's optimisers import first: 800 modules, which take seconds of every process that learns."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.optim.adam import adam

_BETAS = 0.9, 0.999
_EPS = 1e-8
STATE = ("step", "exp_avg", "exp_avg_sq")


class Adam:
    """``torch.optim.Adam``, bit for bit, by the function of torch that it calls, too.

    The optimiser itself imports ``torch._dynamo`` when the first one is made, which nothing here compiles with.

    References: Kingma, Ba, "Adam: A Method for Stochastic Optimization", arXiv:1412.6980.

    Args:
        tensors: What is moved, in place; each requires a gradient.
        learning_rate: The length of a step; may be set before each.
        fused: Whether each step is one call, instead of one an operation: another rounding.

    Attributes:
        state: By tensor the number of its steps ``()`` and both moments, of its shape, under the names in ``STATE``;
            none before the first step.
    """

    tensors: list[Tensor]
    learning_rate: float

    def __init__(self, tensors: Sequence[Tensor], learning_rate: float = 1e-3, *, fused: bool = False) -> None:
        self.tensors, self.learning_rate, self._fused = list(tensors), learning_rate, fused
        self.state: dict[Tensor, dict[str, Tensor]] = {}

    def zero_grad(self) -> None:
        """Forgets the gradients."""
        for tensor in self.tensors:
            tensor.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """One step along the gradients that there are."""
        moved = [tensor for tensor in self.tensors if tensor.grad is not None]
        for tensor in moved:
            if tensor not in self.state:
                zeros = torch.zeros((), device=tensor.device), torch.zeros_like(tensor), torch.zeros_like(tensor)
                self.state[tensor] = dict(zip(STATE, zeros, strict=True))
        steps, means, squares = ([self.state[tensor][name] for tensor in moved] for name in STATE)
        adam(
            moved,
            [tensor.grad for tensor in moved if tensor.grad is not None],
            means,
            squares,
            [],
            steps,
            foreach=False,
            fused=self._fused,
            amsgrad=False,
            beta1=_BETAS[0],
            beta2=_BETAS[1],
            lr=self.learning_rate,
            weight_decay=0.0,
            eps=_EPS,
            maximize=False,
        )
