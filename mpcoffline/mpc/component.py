"""What model, stage cost and terminal cost share: parameter blocks, a CasADi function, and a JSON form."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, Protocol, Self

import casadi as ca

from mpcoffline.errors import FileFormatError

from .parameters import Array, Block, ParameterSpace


class Component:
    """A part of an MPC with parameters.

    Attributes:
        space: Its parameters. Values are changed by making a new component (:meth:`with_theta`).
    """

    space: ParameterSpace

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


class StageCost(Protocol):
    """The stage cost Lhat_theta(x, u) of (MPC)."""

    space: ParameterSpace

    def expression(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """The scalar cost for x ``(nx, 1)``, u ``(nu, 1)`` and the symbols of the own parameters."""

    def with_theta(self, theta: Array) -> Self:
        """A copy with other parameter values."""

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description."""


class TerminalCost(Protocol):
    """The terminal cost T_theta(x) of (MPC)."""

    space: ParameterSpace

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        """The scalar cost for x ``(nx, 1)`` and the symbols of the own parameters."""

    def with_theta(self, theta: Array) -> Self:
        """A copy with other parameter values."""

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description."""


def blocks_from_json(data: Mapping[str, Any]) -> ParameterSpace:
    """The parameter blocks of a component's JSON form."""
    return ParameterSpace([Block.from_json(block) for block in data["blocks"]])


def function_from_text(text: str, name: str, *, inputs: tuple[int, ...], output: int | None = None) -> ca.Function:
    """A CasADi SX function from CasADi's own serialisation.

    Args:
        text: What ``Function.serialize()`` returned.
        name: What the function is, for messages.
        inputs: Expected sizes of its inputs.
        output: Expected size of its one output; any when None.

    Raises:
        FileFormatError: If the text is damaged or holds anything but a plain expression graph. Function classes that
            load compiled libraries could run foreign code, so nothing but SX functions is accepted.
    """
    try:
        function = ca.Function.deserialize(text)
    except Exception as error:  # CasADi raises bare RuntimeError, IndexError or MemoryError on damaged text
        raise FileFormatError(name, expected="a serialised CasADi function", actual=str(error)[:200]) from error
    if not function.is_a("SXFunction"):
        raise FileFormatError(name, expected="an SX function", actual=function.class_name())
    sizes = tuple(function.numel_in(i) for i in range(function.n_in()))
    if sizes != inputs or function.n_out() != 1 or output not in (None, function.numel_out(0)):
        raise FileFormatError(
            name, expected=f"inputs of sizes {inputs}, {output or 'any'} outputs", actual=str(function)
        )
    return function
