"""A cost known by its expression alone: how costs of anybody's own classes are saved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from mpcoffline.core import limits
from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.limits import check_limit

from .component import COSTS, Component, StageCost, TerminalCost, blocks_from_json
from .expressions import function_from_json, function_to_json, traced
from .layout import Layout
from .parameters import ParameterSpace
from .seen import stage_expression, terminal_expression


@COSTS.register("ExpressionCost")
class ExpressionCost(Component):
    """A stage cost (x, u, theta) -> L, or a terminal one (x, theta) -> T, as a CasADi function.

    Args:
        function: Of x ``(nx, 1)``, for a stage cost u ``(nu, 1)`` and, with a price on their changes, those of the step
            before ``(nu, 1)``, and the flat parameters ``(size, 1)``; a scalar.
        space: The parameters.
        convex: What the class of the cost promised, see :class:`StageCost`.

    Raises:
        InvalidArgumentError: For a function that tracing has lost, see ``expressions.traced``.
    """

    def __init__(self, function: ca.Function, space: ParameterSpace, *, convex: bool = False) -> None:
        self.function, self.space, self.convex = traced("cost", function), space, convex
        self.nx, self.uses_previous = self.function.numel_in(0), self.function.n_in() == 4

    def expression(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX], *previous: ca.SX) -> ca.SX:
        """The stage cost as a CasADi scalar.

        Raises:
            InvalidArgumentError: For other sizes than the function's, which CasADi would stretch.
        """
        return self._called([x, u, *previous], p)

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """The terminal cost as a CasADi scalar; raises as :meth:`expression`."""
        return self._called([x], p)

    def _called(self, variables: list[ca.SX], p: Mapping[str, ca.SX]) -> ca.SX:
        arguments = [*variables, ca.vertcat(ca.SX(0, 1), *(block.flat(p[block.name]) for block in self.space))]
        given, own = [argument.numel() for argument in arguments], _sizes(self.function)
        if given != own:
            raise InvalidArgumentError("cost", expected=f"inputs of sizes {own}", actual=f"inputs of sizes {given}")
        return self.function(*arguments)

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description; the function as a list of instructions."""
        return super().to_json() | {"convex": self.convex, "function": function_to_json(self.function)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> ExpressionCost:
        """The inverse of ``to_json``."""
        space, sizes = blocks_from_json(data), data["function"]["inputs"]
        most = (limits.STATES, limits.INPUTS, limits.INPUTS)[: len(sizes) - 1]
        for size, limit in zip(sizes, (*most, space.size), strict=True):
            check_integers(0, size=size)
            check_limit("cost", "inputs", size, limit)
        inputs = (*sizes[:-1], space.size)
        return cls(
            function_from_json(data["function"], "cost", inputs=inputs, output=1), space, convex=data["convex"] is True
        )


def cost_to_json(
    cost: StageCost | TerminalCost, layout: Layout, *, stage: bool, portable: bool = False
) -> dict[str, Any]:
    """A cost as its class writes it, or, where no file can name that class, by its expression.

    Args:
        cost: The cost.
        layout: What the state of its problem is made of.
        stage: Whether it is a stage cost.
        portable: Whether classes from outside this package are written by their expression, too.

    Raises:
        InvalidArgumentError: For an expression that is no plain arithmetic.
    """
    own: Any = cost
    if name := COSTS.name_of(type(cost), shared=portable):
        return dict(own.to_json()) | {"kind": name}
    u, before, theta = ca.SX.sym("u", layout.nu), ca.SX.sym("before", layout.nu), ca.SX.sym("theta", cost.space.size)
    # Of the observation alone where the cost is, so that it fits another dead time, too.
    x = ca.SX.sym("x", layout.nx if getattr(cost, "nx", None) == layout.nx else layout.ny)
    past = [before[int(i)] if age == 1 else ca.SX(0) for i, age in zip(*layout.ages, strict=True)]
    z, p = ca.vertcat(x, *past)[: layout.nx], cost.space.symbols(theta)
    value = stage_expression(layout, own, z, u, p) if stage else terminal_expression(layout, own, z, p)
    inputs = [x, u, *([before] if getattr(cost, "uses_previous", False) else [])] if stage else [x]
    function = ca.Function("cost", [*inputs, theta], [ca.densify(value)])
    return ExpressionCost(function, cost.space, convex=bool(getattr(cost, "convex", False))).to_json()


def _sizes(function: ca.Function) -> list[int]:
    return [function.numel_in(i) for i in range(function.n_in())]
