"""V_phi: a network, or the mean of several, on normalised observations."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, MPCOfflineError
from mpcoffline.datasets.table.math import split
from mpcoffline.datasets.table.shards import ShardedTable
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc.layout import Layout

#: Variation below this share of a column's largest magnitude is rounding of float32 numbers.
_ROUNDING = 1e-6


class ValueFunction(nn.Module):
    """V_phi: a fully connected network on normalised observations, or the mean of several such networks.

    ::

        V_phi(s) = offset + scale * net((s - mean) / std)

    The network is the paper's 2 x 256 by default, with tanh: (FIT) differentiates V at predicted states,
    and tanh keeps the slope continuous there. The normalisation is in float64, so that differences of values far from
    zero are exact.

    Args:
        ny: Number of observation coordinates.
        hidden: Widths of the hidden layers.
        n_members: Number of networks; their mean is the function.
    """

    ny: int
    hidden: tuple[int, ...]
    n_members: int

    mean: Tensor
    std: Tensor
    offset: Tensor
    scale: Tensor
    gamma: Tensor

    def __init__(self, ny: int, hidden: Sequence[int] = (256, 256), n_members: int = 1) -> None:
        super().__init__()
        self.ny, self.hidden, self.n_members = ny, tuple(hidden), n_members
        members = [tanh_network(ny, self.hidden) for _ in range(n_members)]
        self.net: nn.Module = members[0] if n_members == 1 else Mean(members)
        for name, size in (("mean", (ny,)), ("std", (ny,)), ("offset", ()), ("scale", ()), ("gamma", ())):
            fill = 1.0 if name in ("std", "scale") else 0.0
            self.register_buffer(name, torch.full(size, fill, dtype=torch.float64))

    @property
    def discount(self) -> float | None:
        """The gamma that V was learned with; None where it was not learned, or is of a file that does not say."""
        return float(self.gamma) or None

    @property
    def members(self) -> list[nn.Sequential]:
        """The networks, ``n_members`` of them."""
        return list(self.net.members) if isinstance(self.net, Mean) else [self.net]  # type: ignore[list-item, arg-type]

    def normalise(self, table: TransitionTable | ShardedTable, discount: float) -> None:
        """Sets the normalisation from data: V lies around mean(L) / (1 - gamma), and varies as L / (1 - gamma) does.

        Where episodes terminate, gamma is multiplied by the share of transitions that go on.
        """
        mean, std, low, high = table.statistics()
        centre = split(table.centring.centre[None], table.ny, table.nu)  # of which float32 does not have to hold digits
        largest = np.maximum(*(np.abs(end.observations - centre.observations[0]) for end in (low, high)))
        self.gamma.fill_(discount)
        self.mean.copy_(torch.from_numpy(mean.observations))
        unit = np.where(largest > 0.0, largest, 1.0)
        self.std.copy_(torch.from_numpy(np.where(std.observations > _ROUNDING * largest, std.observations, unit)))
        goes_on = 1.0 - float(mean.terminations)
        horizon = 1.0 / max(1.0 - discount * goes_on, 1e-3)
        offset = horizon * float(mean.costs)
        # An end is worth as much as a cost of -gamma * offset.
        spread = float(np.hypot(std.costs, discount * offset * std.terminations))
        size = max(abs(float(low.costs)), abs(float(high.costs)))
        rounding = _ROUNDING * max(abs(float(end.costs - centre.costs[0])) for end in (low, high))
        self.offset.fill_(offset)
        self.scale.fill_(horizon * (spread if spread > rounding else size or 1.0))

    def forward(self, observations: Tensor) -> Tensor:
        """V_phi of observations ``(..., ny)``, shape ``(...)`` in float64."""
        normalised = ((observations - self.mean) / self.std).to(next(self.parameters()).dtype)
        shape: Tensor = self.net(normalised).squeeze(-1)
        return self.offset + self.scale * shape.double()

    def predict(self, observations: ArrayLike) -> NDArray[np.float64]:
        """V_phi of numpy observations ``(..., ny)``, shape ``(...)`` in float64.

        Raises:
            InvalidArgumentError: For another last dimension or NaN.
        """
        array = np.array(observations, dtype=np.float64)
        if array.shape[-1:] != (self.ny,) or not np.isfinite(array).all():
            raise InvalidArgumentError(
                "observations", expected=f"finite numbers of shape (..., {self.ny})", actual=f"shape {array.shape}"
            )
        with torch.no_grad():
            values: Tensor = self(torch.from_numpy(array).to(self.mean.device))
        return np.asarray(values.cpu().numpy(), dtype=np.float64)

    def of_layout(self, own: Layout, other: Layout) -> ValueFunction:
        """The same function of a state that holds more past inputs, of which it asks none: V(z[places]).

        Args:
            own: What its state ``(own.nx,)`` is made of.
            other: What z ``(other.nx,)`` is made of, with as much memory, or more.

        Returns:
            Itself, where it is a function of as many coordinates.

        Raises:
            InvalidArgumentError: For one with less memory, or of another plant.
        """
        if self.ny == other.nx:
            return self
        places, arrays = other.places(own), self.to_arrays()
        for name, array in arrays.items():
            if name in ("mean", "std") or name.endswith(".0.weight"):  # of the coordinates, or of a first layer
                arrays[name] = np.full((*array.shape[:-1], other.nx), float(name == "std"), dtype=array.dtype)
                arrays[name][..., places] = array
        return ValueFunction.from_arrays(arrays).eval().requires_grad_(False)

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
            n_members = len({name.split(".")[2] for name in arrays if name.startswith("net.members.")})
            first = "net.members.0." if n_members else "net."
            n_linear = sum(name.startswith(first) and name.endswith(".weight") for name in arrays)
            hidden = [len(arrays[f"{first}{2 * i}.weight"]) for i in range(n_linear - 1)]
            widths = (len(arrays["mean"]), *hidden, 1)
            for member in range(max(1, n_members)):  # before networks of these sizes are made
                prefix = f"net.members.{member}." if n_members else "net."
                for layer, (width_in, width_out) in enumerate(pairwise(widths)):
                    if arrays[f"{prefix}{2 * layer}.weight"].shape != (width_out, width_in):
                        raise KeyError(f"{prefix}{2 * layer}.weight of shape {(width_out, width_in)}")
            value = cls(widths[0], hidden, max(1, n_members))
            known = {"gamma": np.zeros(())} | dict(arrays)  # older files do not tell it
            value.load_state_dict({name: torch.from_numpy(np.array(array)) for name, array in known.items()})
        except (IndexError, KeyError, RuntimeError, TypeError, MPCOfflineError) as error:
            raise FileFormatError("value function", expected="weights of a network", actual=str(error)) from error
        if not all(np.isfinite(array).all() for array in arrays.values()):
            raise FileFormatError("value function", expected="finite weights", actual="NaN or inf")
        return value


class Mean(nn.Module):
    """The mean of the outputs of several networks.

    Args:
        members: The networks.
    """

    def __init__(self, members: Sequence[nn.Module]) -> None:
        super().__init__()
        self.members: nn.ModuleList = nn.ModuleList(members)

    def forward(self, x: Tensor) -> Tensor:
        """The mean of ``member(x)``."""
        return torch.stack([member(x) for member in self.members]).mean(dim=0)


def tanh_network(n_in: int, hidden: Sequence[int]) -> nn.Sequential:
    """Linear layers with tanh between them, from ``(..., n_in)`` to ``(..., 1)``."""
    layers: list[nn.Module] = []
    for width_in, width_out in pairwise((n_in, *hidden)):
        layers += [nn.Linear(width_in, width_out), nn.Tanh()]
    return nn.Sequential(*layers, nn.Linear((n_in, *hidden)[-1], 1))
