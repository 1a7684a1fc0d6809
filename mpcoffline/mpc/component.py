"""What model, stage cost and terminal cost share: parameter blocks, a CasADi function, and a JSON form."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, Protocol, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.registry import Registry
from mpcoffline.core.text import figure, listed
from mpcoffline.core.types import Array

from .parameters import Block, Parameter, ParameterSpace

_MOST_TOLD = 12  # parameters


class Component:
    """A part of an MPC with parameters.

    Attributes:
        space: Its parameters. Values are changed by making a new component (:meth:`with_theta`).
    """

    space: ParameterSpace

    def __repr__(self) -> str:
        """Its class and parameters: numbers with their units, of arrays the shapes."""
        return f"{type(self).__name__}({listed([_told(block) for block in self.space], _MOST_TOLD)})"

    def with_theta(self, theta: Array) -> Self:
        """A copy with other parameter values, from this component's part of theta ``(size,)``."""
        other = copy.copy(self)
        other.space = self.space.with_theta(theta)
        return other

    @property
    def values(self) -> dict[str, Array]:
        """The parameters by name in their natural shapes."""
        return {block.name: block.value for block in self.space}

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description from which :func:`from_json` of the subclass rebuilds the component."""
        return {"kind": type(self).__name__, "blocks": [block.to_json() for block in self.space]}


#: Costs whose kind files name. A cost that is not here is saved by its expression (:class:`ExpressionCost`).
COSTS: Registry[type[Any]] = Registry("cost", Component, ("from_json", "expression|terminal_expression"))


def cost_from_json(data: Mapping[str, Any]) -> Any:
    """A stage or terminal cost from its JSON form.

    Raises:
        FileFormatError: For a kind of cost that nobody has registered.
    """
    return COSTS.of_file(data.get("kind"), "cost").from_json(data)


class StageCost(Protocol):
    """The stage cost Lhat_theta(x, u) of (MPC).

    A class may say ``convex = True``: the Hessian in (x, u) is positive semidefinite everywhere, for every theta within
    its bounds. A class that says nothing counts as not convex; solvers that need a convex model make one of it.

    A class that says ``uses_previous = True`` has a price on changes of inputs: its expression is called with the
    inputs of the step before ``(nu, 1)`` as fourth argument, which the MPC's model then carries along.

    A class that says ``uses_signals = True`` is given the present signals by name as keyword argument ``d``
    (``d.price``), ``terminal_expression`` too.

    The state x is the observation ``(ny, 1)``; where the cost has an attribute ``nx`` that is the number of the plant's
    states, it is these, and where that is the size of the whole state of the MPC, past inputs included, it is that.
    """

    space: ParameterSpace

    def expression(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """The scalar cost for x ``(nx, 1)``, u ``(nu, 1)`` and the symbols of the own parameters."""

    def with_theta(self, theta: Array) -> Self:
        """A copy with other parameter values."""


class TerminalCost(Protocol):
    """The terminal cost T_theta(x) of (MPC); ``convex = True`` means the same as in :class:`StageCost`."""

    space: ParameterSpace

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """The scalar cost for x ``(nx, 1)`` and the symbols of the own parameters."""

    def with_theta(self, theta: Array) -> Self:
        """A copy with other parameter values."""


def _told(block: Block) -> str:
    """A parameter in a word or two."""
    if block.shape:
        return f"{block.name} {block.shape}"
    return f"{block.name} = {figure(float(block.value), 4)} {block.unit}".rstrip()


def blocks_from_json(data: Mapping[str, Any]) -> ParameterSpace:
    """The parameter blocks of a component's JSON form."""
    return ParameterSpace([Block.from_json(block) for block in data["blocks"]])


def difference(name: str, variable: ca.SX, reference: ca.SX) -> ca.SX:
    """Variable - reference of equal sizes; CasADi alone would stretch a scalar over a vector.

    Raises:
        InvalidArgumentError: If the sizes differ.
    """
    if variable.shape != reference.shape:
        raise InvalidArgumentError(
            f"{name}_ref", expected=f"{variable.shape[0]} numbers, as {name}", actual=str(reference.shape[0])
        )
    return variable - reference


def numbers(name: str, given: object) -> Array:
    """The numbers given, as float64.

    Raises:
        InvalidArgumentError: For anything else, as a :class:`Parameter`, which only a model takes.
    """
    try:
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        hint = "Only a Model's parameters have bounds and units." if isinstance(given, Parameter) else ""
        raise InvalidArgumentError(name, expected="a number or numbers", actual=repr(given), hint=hint) from error


def vector(name: str, given: ArrayLike | None, size: int, default: float = 0.0) -> Array:
    """The numbers given ``(size,)``, or all ``default``.

    Raises:
        InvalidArgumentError: For another shape, or what is no number.
    """
    found = np.full(size, default) if given is None else np.atleast_1d(numbers(name, given))
    if found.shape != (size,):
        raise InvalidArgumentError(name, expected=f"shape ({size},)", actual=f"shape {found.shape}")
    return found
