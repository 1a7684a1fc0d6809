"""Signals: what comes from outside and is known when an MPC is solved, as set-points, prices, measured disturbances."""

from __future__ import annotations

import inspect
import keyword
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np

from mpcoffline.core import limits
from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.limits import check_limit
from mpcoffline.core.text import check_name, check_unit


@dataclass(frozen=True)
class Signal:
    """A number from outside, in the observation: its value now and, with a preview, those of the steps to come.

    The columns stand after the plant's states. Along the horizon the MPC takes what was previewed, step by step, and
    holds the last value that it knows; without a preview it holds the present one.

    Example:
        >>> Model(ode, nx=1, nu=1, dt=3600.0, signals=[Signal("price", "EUR/kWh", preview=24), Signal("outside", "K")])

    Args:
        name: As dynamics and costs call it, ``d.price``: a Python identifier.
        unit: Its unit.
        preview: How many values of the steps to come the observation holds after the present one.
        usual: A value that it may have, for where none is known yet, as in the choice of integration steps.

    Raises:
        InvalidArgumentError: For a name that is no identifier, a preview that is negative or longer than a horizon may
            be, or a usual value that is not finite.
    """

    name: str
    unit: str = ""
    preview: int = 0
    usual: float = 0.0

    def __post_init__(self) -> None:
        check_name("name of a signal", self.name)
        if not self.name.isidentifier() or keyword.iskeyword(self.name) or self.name.startswith("_"):
            raise InvalidArgumentError("name of a signal", expected="a Python identifier", actual=repr(self.name))
        check_unit("unit of a signal", self.unit)
        check_integers(0, preview=self.preview)
        check_limit("preview", "steps", int(self.preview), limits.HORIZON, error=InvalidArgumentError)
        check_number("usual", self.usual, -np.inf, open_low=False)

    @property
    def size(self) -> int:
        """Number of its columns in an observation."""
        return 1 + self.preview

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of its columns: ``price, price[k+1], ...``."""
        return (self.name, *(f"{self.name}[k+{j}]" for j in range(1, self.size)))

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description."""
        return {"name": self.name, "unit": self.unit, "preview": int(self.preview), "usual": float(self.usual)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`."""
        return cls(**data)


class Named:
    """Values of signals by name, as dynamics and costs get them: ``d.price`` or ``d["price"]``.

    Args:
        names: The names.
        values: CasADi column of as many.
    """

    def __init__(self, names: Sequence[str], values: ca.SX) -> None:
        self._values = dict(zip(names, ca.vertsplit(values) if len(names) else [], strict=True))

    def __getitem__(self, name: str) -> ca.SX:
        try:
            return self._values[name]
        except KeyError:
            raise InvalidArgumentError(
                f"signal {name!r}",
                expected=f"one of {', '.join(self._values) or '(none)'}",
                actual=f"d.{name}",
                hint="Give the model its signals: Model(..., signals=[Signal(...)]).",
            ) from None

    def __getattr__(self, name: str) -> ca.SX:
        if name.startswith("_"):
            raise AttributeError(name)
        return self[name]


def takes_signals(function: Callable[..., Any], count: int = 4) -> bool:
    """Whether a function of the user takes signals as its last of so many arguments, ``(x, u, p, d)``."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of what is built in
        return False
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(parameter.kind in kinds and parameter.default is parameter.empty for parameter in parameters) >= count
