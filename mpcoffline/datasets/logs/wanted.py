"""What a log should hold: quantities, the control interval, and what a step costs; as a file has it, too."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np

from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.limits import HEADER, check_limit
from mpcoffline.core.text import check_name, check_unit
from mpcoffline.core.types import Array
from mpcoffline.mpc.expressions import function_from_json, function_to_json

from .columns import Quantity

#: The cost of steps ``(n,)`` from states, inputs, present signals and the inputs of the step before, ``(n, ...)`` each.
Cost = Callable[[Array, Array, Array, Array], Array]
_KINDS = ("states", "inputs", "signals")


@dataclass(frozen=True)
class Wanted:
    """What a log should hold.

    Attributes:
        dt: Control interval in s.
        states: What is measured.
        inputs: What was applied.
        signals: What came from outside.
        previews: How many steps ahead the observation holds each signal, beside the present one.
        periods: Of signals that are clocks, the control intervals of a turn; None of others.
        cost: What a step costs.
    """

    dt: float
    states: Sequence[Quantity]
    inputs: Sequence[Quantity]
    signals: Sequence[Quantity]
    previews: Sequence[int]
    periods: Sequence[float | None]
    cost: Cost

    @property
    def logged(self) -> list[Quantity]:
        """What has a column; clocks are computed."""
        outside = [s for s, period in zip(self.signals, self.periods, strict=True) if period is None]
        return [*self.states, *self.inputs, *outside]

    def to_json(self, cost: ca.Function) -> dict[str, Any]:
        """A JSON-able description, which :meth:`from_json` reads without running anybody's code.

        Args:
            cost: The cost of a step as CasADi function of states, inputs, present signals and the inputs before.

        Raises:
            InvalidArgumentError: For a cost that is no plain arithmetic.
        """
        quantities = {kind: [_quantity_to_json(each) for each in getattr(self, kind)] for kind in _KINDS}
        periods = [None if period is None else float(period) for period in self.periods]
        known = {"dt": float(self.dt), "previews": [int(each) for each in self.previews], "periods": periods}
        return quantities | known | {"cost": function_to_json(cost)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`.

        Raises:
            FileFormatError: For sizes that do not fit together, or a cost that is none.
            KeyError: For a part that is missing.
            TypeError: For a part of another kind.
        """
        quantities = {kind: [_quantity_from_json(each) for each in data[kind]] for kind in _KINDS}
        sizes = tuple(len(quantities[kind]) for kind in (*_KINDS, "inputs"))
        function = function_from_json(data["cost"], "cost", inputs=sizes, output=1)
        previews, periods = list(data["previews"]), list(data["periods"])
        if not len(previews) == len(periods) == sizes[2]:
            raise FileFormatError("signals", expected=f"{sizes[2]} previews", actual=f"{len(previews)}")
        check_integers(0, **{f"previews[{i}]": each for i, each in enumerate(previews)})
        for period in periods:
            if period is not None:
                check_number("period", period, 2.0)
        check_number("dt", data["dt"], 0.0)

        def cost(x: Array, u: Array, d: Array, before: Array) -> Array:
            return np.asarray(function(x.T, u.T, d.T, before.T).full().ravel())

        return cls(data["dt"], **quantities, previews=previews, periods=periods, cost=cost)


def _quantity_to_json(each: Quantity) -> dict[str, Any]:
    ends = {end: float(getattr(each, end)) for end in ("low", "high") if np.isfinite(getattr(each, end))}
    return {"name": each.name, "unit": each.unit} | ends | ({"header": each.header} if each.header else {})


def _quantity_from_json(data: Mapping[str, Any]) -> Quantity:
    name = check_name("name of a quantity", data["name"], error=FileFormatError)
    unit = check_unit(f"unit of {name}", data["unit"], error=FileFormatError)
    header = data.get("header", "")
    if not isinstance(header, str):
        raise FileFormatError(f"header of {name}", expected="a text", actual=repr(header)[:100])
    check_limit(f"header of {name}", "characters", len(header), HEADER)
    return Quantity(name, unit, float(data.get("low", -np.inf)), float(data.get("high", np.inf)), header)
