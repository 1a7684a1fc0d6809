"""A CasADi SX function as a batched, differentiable torch function: models and costs are written once.

An SX function is a list of scalar instructions. Replaying that list on columns of a tensor, each holding one scalar
for the whole batch, gives the same function in torch, with autograd.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from mpcoffline.core.errors import InvalidArgumentError

from .expressions import expanded, instructions
from .layer_steps import Dense, Map
from .layers import Layered, layered

_Scalar = Tensor | float
_Mask = Tensor | bool

_UNARY: dict[int, Callable[[Tensor], Tensor]] = {
    ca.OP_NEG: torch.neg,
    ca.OP_SQ: torch.square,
    ca.OP_TWICE: lambda a: 2.0 * a,
    ca.OP_INV: torch.reciprocal,
    ca.OP_SQRT: torch.sqrt,
    ca.OP_EXP: torch.exp,
    ca.OP_LOG: torch.log,
    ca.OP_LOG1P: torch.log1p,
    ca.OP_EXPM1: torch.expm1,
    ca.OP_SIN: torch.sin,
    ca.OP_COS: torch.cos,
    ca.OP_TAN: torch.tan,
    ca.OP_ASIN: torch.asin,
    ca.OP_ACOS: torch.acos,
    ca.OP_ATAN: torch.atan,
    ca.OP_SINH: torch.sinh,
    ca.OP_COSH: torch.cosh,
    ca.OP_TANH: torch.tanh,
    ca.OP_ASINH: torch.asinh,
    ca.OP_ACOSH: torch.acosh,
    ca.OP_ATANH: torch.atanh,
    ca.OP_FABS: torch.abs,
    ca.OP_FLOOR: torch.floor,
    ca.OP_CEIL: torch.ceil,
    ca.OP_ERF: torch.erf,
    ca.OP_SIGN: torch.sign,
    ca.OP_NOT: lambda a: (a == 0).to(a.dtype),
}

# These take a Python float on either side.
_ARITHMETIC: dict[int, Callable[[Any, Any], Any]] = {
    ca.OP_ADD: operator.add,
    ca.OP_SUB: operator.sub,
    ca.OP_MUL: operator.mul,
    ca.OP_DIV: operator.truediv,
    ca.OP_POW: torch.pow,
    ca.OP_CONSTPOW: torch.pow,
}

_BINARY: dict[int, Callable[[Tensor, Tensor], Tensor]] = _ARITHMETIC | {
    ca.OP_FMIN: torch.fmin,
    ca.OP_FMAX: torch.fmax,
    ca.OP_ATAN2: torch.atan2,
    ca.OP_HYPOT: torch.hypot,
    ca.OP_FMOD: torch.fmod,
    ca.OP_COPYSIGN: torch.copysign,
    ca.OP_LT: lambda a, b: (a < b).to(a.dtype),
    ca.OP_LE: lambda a, b: (a <= b).to(a.dtype),
    ca.OP_EQ: lambda a, b: (a == b).to(a.dtype),
    ca.OP_NE: lambda a, b: (a != b).to(a.dtype),
    ca.OP_AND: lambda a, b: ((a != 0) & (b != 0)).to(a.dtype),
    ca.OP_OR: lambda a, b: ((a != 0) | (b != 0)).to(a.dtype),
    # casadi.if_else(c, a, b) is c*a + !c*b; the guard keeps the branch not taken from turning 0*inf into NaN.
    ca.OP_IF_ELSE_ZERO: lambda a, b: torch.where(a != 0, b, torch.zeros_like(b)),
}


LARGE = 2000  # instructions, from which on layers are looked for


class TorchTwin:
    """A CasADi function evaluated by torch, batched and differentiable in every input.

    Args:
        function: A CasADi function that can be expanded to SX, with column inputs and outputs; its first output counts.

    Raises:
        InvalidArgumentError: If the function cannot be expanded to SX or uses an operation without a torch counterpart.
    """

    def __init__(self, function: ca.Function) -> None:
        self.name: str = function.name()
        flat = expanded(function)
        self._n_in = [flat.numel_in(i) for i in range(flat.n_in())]
        self._n_out = flat.numel_out(0)
        # (operation, operands, constant); operands are places in this list, as every result is kept once.
        self._program: list[tuple[int, list[int], float]] = []
        self._outputs = [0] * self._n_out
        latest: dict[int, int] = {}  # place in CasADi's work vector -> place in the program
        for op, sources, targets, constant in instructions(flat):
            if op == ca.OP_OUTPUT:
                if targets[0] == 0:
                    self._outputs[targets[1]] = latest[sources[0]]
                continue
            if op not in _UNARY and op not in _BINARY and op not in (ca.OP_CONST, ca.OP_INPUT):
                raise InvalidArgumentError(
                    self.name, expected="operations that torch has", actual=f"CasADi operation {op}"
                )
            operands = sources[:1] if op in _UNARY else sources
            places = list(operands) if op == ca.OP_INPUT else [latest[source] for source in operands]
            latest[targets[0]] = len(self._program)
            self._program.append(self._folded(op, places, constant))
        self._constants = [constant if op == ca.OP_CONST else None for op, _, constant in self._program]
        self._calls = [call for k in range(len(self._program)) if (call := self._call(k)) is not None]
        self._reads = [(k, *places) for k, (op, places, _) in enumerate(self._program) if op == ca.OP_INPUT]
        self._branches = any(op == ca.OP_IF_ELSE_ZERO for op, *_ in self._program)
        self._layers: Layered | None = None
        if len(self._program) > LARGE and not self._branches:
            self._layers = layered(function)

    @property
    def in_layers(self) -> bool:
        """Whether it is evaluated by products of matrices."""
        return self._layers is not None

    def _folded(self, op: int, places: list[int], constant: float) -> tuple[int, list[int], float]:
        """The instruction; the number that it gives where all operands are numbers."""
        known = [self._program[place] for place in places] if op not in (ca.OP_CONST, ca.OP_INPUT) else []
        if not known or any(each[0] != ca.OP_CONST for each in known):
            return op, places, constant
        operands: list[_Scalar] = [torch.tensor(each[2], dtype=torch.float64) for each in known]
        return ca.OP_CONST, [], float(_applied(op, operands, torch.zeros((), dtype=torch.float64)))

    def _call(self, k: int) -> tuple[int, Callable[..., Any], int, int | None, bool] | None:
        """Place, function, places of one or two operands, and whether it takes numbers; None for no operation."""
        op, places, _ = self._program[k]
        if op in (ca.OP_CONST, ca.OP_INPUT):
            return None
        if op in _UNARY:
            return k, _UNARY[op], places[0], None, False
        return k, _BINARY[op], places[0], places[1], op in _ARITHMETIC

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Evaluates the function.

        Args:
            *inputs: One tensor an input, ``(..., n_i)``; leading dimensions broadcast, so that parameters ``(n,)``
                may go with states ``(B, nx)``.

        Returns:
            The first output, ``(..., m)``, of the broadcast leading shape and the inputs' dtype.

        Raises:
            InvalidArgumentError: If the number of inputs or an input's last dimension is not the function's.
        """
        if len(inputs) != len(self._n_in):
            raise InvalidArgumentError(self.name, expected=f"{len(self._n_in)} inputs", actual=str(len(inputs)))
        for i, (tensor, size) in enumerate(zip(inputs, self._n_in, strict=True)):
            if tensor.ndim == 0 or tensor.shape[-1] != size:
                raise InvalidArgumentError(
                    f"input {i} of {self.name}",
                    expected=f"shape (..., {size})",
                    actual=f"shape {tuple(tensor.shape)}",
                )
        columns = [tensor.unbind(-1) for tensor in inputs]
        if self._layers is not None:
            return _in_layers(self._layers, columns, inputs[0])
        needed: list[_Mask] | None = None
        if self._branches and torch.is_grad_enabled():
            with torch.no_grad():
                needed = self._needed(self._replayed(columns, inputs[0], None))
        work = self._replayed(columns, inputs[0], needed)
        shape = np.broadcast_shapes(*(tuple(tensor.shape[:-1]) for tensor in inputs))
        return torch.stack([_tensor(work[k], inputs[0]).expand(shape) for k in self._outputs], dim=-1)

    def _replayed(
        self, columns: Sequence[Sequence[Tensor]], like: Tensor, needed: Sequence[_Mask] | None
    ) -> list[_Scalar]:
        """The result of every instruction; with ``needed``, without gradients where they are not."""
        work: list[Any] = list(self._constants)
        for k, i, j in self._reads:
            work[k] = columns[i][j]
        for k, function, a, b, takes_numbers in self._calls:
            operands = [work[a]] if b is None else [work[a], work[b]]
            if needed is not None and isinstance(needed[k], Tensor):
                operands = [_cut(operand, needed[k]) for operand in operands]
            if b is not None and not takes_numbers:
                operands = [_tensor(operand, like) for operand in operands]
            work[k] = function(*operands)
        return work

    def _needed(self, work: Sequence[_Scalar]) -> list[_Mask]:
        """Where the outputs depend on each result: everywhere (True), or outside the branches not taken.

        In a branch that is not taken, derivatives may be infinite or NaN, and autograd would multiply them by zero.
        """
        needed: list[_Mask] = [False] * len(self._program)
        for place in self._outputs:
            needed[place] = True
        for k in reversed(range(len(self._program))):
            op, places, _ = self._program[k]
            if op in (ca.OP_CONST, ca.OP_INPUT):
                continue
            for i, place in enumerate(places):
                mask: Any = needed[k]
                if op == ca.OP_IF_ELSE_ZERO and i == 1:
                    mask = mask & (work[places[0]] != 0)
                needed[place] = True if needed[place] is True or mask is True else needed[place] | mask
        return needed


def _in_layers(structure: Layered, columns: Sequence[Sequence[Tensor]], like: Tensor) -> Tensor:
    """The outputs ``(..., m)`` of a function with layers: products of matrices, and maps of whole rows."""
    work: dict[int, _Scalar] = {}
    rows: dict[tuple[int, ...], Tensor] = {}  # by the numbers of their elements: results of layers

    def row(numbers: Sequence[int]) -> Tensor:
        known = rows.get(tuple(numbers))
        if known is None:
            elements = [_tensor(work[k], like) for k in numbers]
            shape = np.broadcast_shapes(*(tuple(element.shape) for element in elements))
            known = torch.stack([element.expand(shape) for element in elements], dim=-1)
        return known

    def keep(numbers: Sequence[int], result: Tensor) -> None:
        rows[tuple(numbers)] = result
        work.update(zip(numbers, result.unbind(-1), strict=True))

    for step in structure.steps:
        if isinstance(step, Dense):
            matrix, bias = (
                torch.as_tensor(part, dtype=like.dtype, device=like.device) for part in (step.matrix, step.bias)
            )
            keep(step.targets, row(step.sources) @ matrix.T + bias)
        elif isinstance(step, Map):
            source, results = row(step.sources), list[_Scalar]()
            constants = [torch.as_tensor(part, dtype=like.dtype, device=like.device) for part in step.constants]
            for op, operands in step.program:
                values = [source if o == -1 else constants[-2 - o] if o < 0 else results[o] for o in operands]
                results.append(_applied(op, values, like))
            for place, targets in zip(step.results, step.targets, strict=True):
                keep(targets, _tensor(results[place], like))
        else:
            for k in step.nodes:
                node = structure.nodes[k]
                if node.op == ca.OP_CONST:
                    work[k] = node.constant
                elif node.op == ca.OP_INPUT:
                    work[k] = columns[node.operands[0]][node.operands[1]]
                else:
                    work[k] = _applied(node.op, [work[o] for o in node.operands], like)
    shape = np.broadcast_shapes(*(tuple(given[0].shape) for given in columns if given))
    return torch.stack([_tensor(work[k], like).expand(shape) for k in structure.outputs], dim=-1)


def _cut(operand: _Scalar, needed: _Mask) -> _Scalar:
    """The operand with no gradient where it is not needed."""
    if isinstance(operand, Tensor) and operand.requires_grad:
        return torch.where(torch.as_tensor(needed), operand, operand.detach())
    return operand


def _applied(op: int, operands: Sequence[_Scalar], like: Tensor) -> _Scalar:
    """One operation on tensors and numbers; a number if all operands are numbers."""
    if not any(isinstance(operand, Tensor) for operand in operands):
        return float(_applied(op, [torch.tensor(operand, dtype=torch.float64) for operand in operands], like))
    if op in _UNARY:
        return _UNARY[op](_tensor(operands[0], like))
    if op in _ARITHMETIC:
        result: Tensor = _ARITHMETIC[op](*operands)
        return result
    left, right = (_tensor(operand, like) for operand in operands)
    return _BINARY[op](left, right)


def _tensor(value: _Scalar, like: Tensor) -> Tensor:
    return value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=like.dtype, device=like.device)
