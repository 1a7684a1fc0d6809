"""(VALUE): a value function V_phi of the logged data, by regression (arXiv:2301.01667)."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from mpcoffline.datasets.transitions import Columns, TransitionTable
from mpcoffline.errors import FileFormatError, InvalidArgumentError, MPCOfflineError, UnknownIdError

from .checks import check_integers, check_number
from .progress import Report, silent


class ValueFunction(nn.Module):
    """V_phi: a fully connected network on normalised observations.

    ::

        V_phi(s) = offset + scale * net((s - mean) / std)

    The network is the paper's 2 x 256 by default, with tanh: (FIT) differentiates V at predicted states,
    and tanh keeps the slope continuous there.

    Args:
        ny: Number of observation coordinates.
        hidden: Widths of the hidden layers.
    """

    mean: Tensor
    std: Tensor
    offset: Tensor
    scale: Tensor

    def __init__(self, ny: int, hidden: Sequence[int] = (256, 256)) -> None:
        super().__init__()
        self.ny, self.hidden = ny, tuple(hidden)
        layers: list[nn.Module] = []
        for n_in, n_out in zip((ny, *self.hidden), self.hidden, strict=False):
            layers += [nn.Linear(n_in, n_out), nn.Tanh()]
        self.net = nn.Sequential(*layers, nn.Linear((ny, *self.hidden)[-1], 1))
        for name, size in (("mean", (ny,)), ("std", (ny,)), ("offset", ()), ("scale", ())):
            self.register_buffer(name, torch.zeros(size) if name in ("mean", "offset") else torch.ones(size))

    def normalise(self, table: TransitionTable, discount: float) -> None:
        """Sets the normalisation from data: V lies around mean(L) / (1 - gamma) and varies on that scale."""
        horizon = 1.0 / max(1.0 - discount, 1e-3)
        std = table.observations.std(axis=0)
        self.mean.copy_(torch.from_numpy(table.observations.mean(axis=0)))
        self.std.copy_(torch.from_numpy(np.where(std > 1e-6, std, 1.0).astype(np.float32)))
        self.offset.fill_(float(table.costs.mean(dtype=np.float64)) * horizon)
        spread = float(table.costs.std(dtype=np.float64))
        self.scale.fill_((spread if spread > 0.0 else 1.0) * horizon)

    def forward(self, observations: Tensor) -> Tensor:
        """V_phi of observations ``(..., ny)``, shape ``(...)``."""
        normalised = (observations - self.mean) / self.std
        shape: Tensor = self.net(normalised).squeeze(-1)
        return self.offset + self.scale * shape

    def predict(self, observations: ArrayLike) -> NDArray[np.float64]:
        """V_phi of numpy observations ``(..., ny)``, shape ``(...)`` in float64.

        Raises:
            InvalidArgumentError: For another last dimension or NaN.
        """
        array = np.asarray(observations, dtype=np.float32)
        if array.shape[-1:] != (self.ny,) or not np.isfinite(array).all():
            raise InvalidArgumentError(
                "observations", expected=f"finite numbers of shape (..., {self.ny})", actual=f"shape {array.shape}"
            )
        with torch.no_grad():
            values: Tensor = self(torch.from_numpy(array).to(self.mean.device))
        return np.asarray(values.cpu().numpy(), dtype=np.float64)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """All weights and normalisation constants as numpy arrays, by name."""
        return {name: tensor.detach().cpu().numpy() for name, tensor in self.state_dict().items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> ValueFunction:
        """The inverse of :meth:`to_arrays`.

        Raises:
            FileFormatError: If arrays are missing, of the wrong shape, or not finite.
        """
        try:
            n_linear = sum(name.startswith("net.") and name.endswith(".weight") for name in arrays)
            hidden = [len(arrays[f"net.{2 * i}.weight"]) for i in range(n_linear - 1)]
            value = cls(len(arrays["mean"]), hidden)
            value.load_state_dict({name: torch.from_numpy(np.array(array)) for name, array in arrays.items()})
        except (KeyError, RuntimeError, TypeError, MPCOfflineError) as error:
            raise FileFormatError("value function", expected="weights of a network", actual=str(error)) from error
        if not all(np.isfinite(array).all() for array in arrays.values()):
            raise FileFormatError("value function", expected="finite weights", actual="NaN or inf")
        return value


class ValueMethod(ABC):
    """A loss whose minimum is a value function."""

    @abstractmethod
    def loss(self, V: ValueFunction, V_target: ValueFunction, batch: Columns, discount: float) -> Tensor:
        """The mean loss over a minibatch, in units of V squared.

        Args:
            V: The function that learns.
            V_target: Its slowly following copy; constant.
            batch: Transitions; see :class:`~mpcoffline.datasets.transitions.Columns`.
            discount: gamma.
        """


@dataclass(frozen=True)
class Residual(ValueMethod):
    """(VALUE) as published: the squared Bellman residual, differentiated on both sides.

    ::

        E_D[ (L(s,a) + gamma V_phi(s+) - V_phi(s))^2 ]

    Estimates the value of the policy that logged the data; unbiased for deterministic plants only.
    """

    def loss(self, V: ValueFunction, V_target: ValueFunction, batch: Columns, discount: float) -> Tensor:
        """See :class:`ValueMethod`."""
        bootstrap = discount * (1.0 - batch.terminations) * V(batch.next_observations)
        residual: Tensor = batch.costs + bootstrap - V(batch.observations)
        return residual.square().mean()


@dataclass(frozen=True)
class TemporalDifference(ValueMethod):
    """Semi-gradient TD(0) with a target network: the target is held constant.

    ::

        E_D[ (L(s,a) + gamma V_target(s+) - V_phi(s))^2 ]

    Estimates the value of the policy that logged the data, for noisy plants too (Sutton & Barto, ch. 9).
    """

    def loss(self, V: ValueFunction, V_target: ValueFunction, batch: Columns, discount: float) -> Tensor:
        """See :class:`ValueMethod`."""
        return self.errors(V, V_target, batch, discount).square().mean()

    @staticmethod
    def errors(V: ValueFunction, V_target: ValueFunction, batch: Columns, discount: float) -> Tensor:
        """Target minus prediction, ``(B,)``."""
        with torch.no_grad():
            target = batch.costs + discount * (1.0 - batch.terminations) * V_target(batch.next_observations)
        delta: Tensor = target - V(batch.observations)
        return delta


@dataclass(frozen=True)
class Expectile(ValueMethod):
    """A low expectile of the sampled target: towards the best action in the data instead of the average one.

    ::

        E_D[ |tau - 1(delta < 0)| delta^2 ],      delta = L(s,a) + gamma V_target(s+) - V_phi(s),   tau < 1/2

    After implicit Q-learning (Kostrikov et al., arXiv:2110.06169) with the sign of costs. Optimistic where the plant is
    noisy.

    Args:
        tau: The expectile: the weight of targets above V; those below weigh 1 - tau.
    """

    tau: float = 0.3

    def loss(self, V: ValueFunction, V_target: ValueFunction, batch: Columns, discount: float) -> Tensor:
        """See :class:`ValueMethod`."""
        delta = TemporalDifference.errors(V, V_target, batch, discount)
        weight = torch.where(delta > 0.0, self.tau, 1.0 - self.tau)
        return (weight * delta.square()).mean()


VALUE_METHODS = ("residual", "td", "expectile")


@dataclass(frozen=True)
class ValueConfig:
    """How V_phi is learned.

    Attributes:
        method: ``"residual"`` (the paper's (VALUE)), ``"td"`` or ``"expectile"``.
        tau: The expectile, for ``method="expectile"``.
        n_steps: Gradient steps.
        batch_size: Transitions a step.
        learning_rate: Adam's at the start; falls to zero on a cosine.
        polyak: Rate at which the target network follows.
        hidden: Widths of the hidden layers.
    """

    method: str = "residual"
    tau: float = 0.3
    n_steps: int = 8_000
    batch_size: int = 256
    learning_rate: float = 1e-3
    polyak: float = 0.01
    hidden: tuple[int, ...] = (256, 256)

    def __post_init__(self) -> None:
        if self.method not in VALUE_METHODS:
            raise UnknownIdError.of("value method", self.method, VALUE_METHODS)
        if not 0.0 < self.tau < 1.0:
            raise InvalidArgumentError("tau", expected="a number in (0, 1)", actual=str(self.tau))
        check_integers(1, n_steps=self.n_steps, batch_size=self.batch_size)
        check_integers(1, **{f"hidden[{i}]": width for i, width in enumerate(self.hidden)})
        check_number("learning_rate", self.learning_rate, 0.0)
        check_number("polyak", self.polyak, 0.0, 1.0)

    def build(self) -> ValueMethod:
        """The loss."""
        methods: dict[str, ValueMethod] = {
            "residual": Residual(),
            "td": TemporalDifference(),
            "expectile": Expectile(self.tau),
        }
        return methods[self.method]


def fit_value(
    table: TransitionTable,
    discount: float,
    config: ValueConfig,
    *,
    seed: int,
    device: str = "cpu",
    epoch: int = 500,
    report: Report = silent,
) -> ValueFunction:
    """Learns V_phi by stochastic gradient descent on one of the losses (VALUE).

    Args:
        table: The transitions.
        discount: gamma.
        config: Loss and schedule.
        seed: Seeds weights and minibatches; the same seed gives the same weights on the same machine.
        device: Torch device.
        epoch: Steps between reports.
        report: Called at the end of each epoch with ``{"value_loss": ...}``, in units of the mean loss of V = offset.

    Returns:
        The value function, in evaluation mode and without gradients.
    """
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        V = ValueFunction(table.ny, config.hidden)
    V.normalise(table, discount)
    V.to(device)
    V_target = copy.deepcopy(V).requires_grad_(False)
    method = config.build()
    optimiser = torch.optim.Adam(V.net.parameters(), lr=config.learning_rate)
    unit = float(V.scale) ** 2
    losses: list[Tensor] = []
    batches = table.batches(config.batch_size, np.random.default_rng(seed))
    for step in range(1, config.n_steps + 1):
        batch = table.columns(next(batches).to(device))
        optimiser.param_groups[0]["lr"] = config.learning_rate * cosine(step, config.n_steps)
        loss = method.loss(V, V_target, batch, discount) / unit
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(list(V_target.net.parameters()), list(V.net.parameters()), config.polyak)
        losses.append(loss.detach())
        if step % epoch == 0 or step == config.n_steps:
            report(step, config.n_steps, {"value_loss": float(torch.stack(losses).mean())})
            losses.clear()
    return V.eval().requires_grad_(False)


def cosine(step: int, n_steps: int) -> float:
    """The cosine schedule from 1 at the first step to 0 at the last."""
    return 0.5 * (1.0 + math.cos(math.pi * (step - 1) / n_steps))
