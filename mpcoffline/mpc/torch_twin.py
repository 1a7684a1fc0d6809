"""A CasADi SX function as a batched, differentiable torch function: models and costs are written once.

An SX function is a list of scalar instructions. Replaying that list on columns of a tensor, each holding one scalar
for the whole batch, gives the same function in torch, with autograd.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import casadi as ca
import torch
from torch import Tensor

from mpcoffline.errors import InvalidArgumentError

_Scalar = Tensor | float

_UNARY: dict[int, tuple[Callable[[Tensor], Tensor], Callable[[float], float]]] = {
    ca.OP_NEG: (torch.neg, lambda a: -a),
    ca.OP_SQ: (torch.square, lambda a: a * a),
    ca.OP_TWICE: (lambda a: 2.0 * a, lambda a: 2.0 * a),
    ca.OP_INV: (torch.reciprocal, lambda a: 1.0 / a),
    ca.OP_SQRT: (torch.sqrt, math.sqrt),
    ca.OP_EXP: (torch.exp, math.exp),
    ca.OP_LOG: (torch.log, math.log),
    ca.OP_LOG1P: (torch.log1p, math.log1p),
    ca.OP_EXPM1: (torch.expm1, math.expm1),
    ca.OP_SIN: (torch.sin, math.sin),
    ca.OP_COS: (torch.cos, math.cos),
    ca.OP_TAN: (torch.tan, math.tan),
    ca.OP_ASIN: (torch.asin, math.asin),
    ca.OP_ACOS: (torch.acos, math.acos),
    ca.OP_ATAN: (torch.atan, math.atan),
    ca.OP_SINH: (torch.sinh, math.sinh),
    ca.OP_COSH: (torch.cosh, math.cosh),
    ca.OP_TANH: (torch.tanh, math.tanh),
    ca.OP_ASINH: (torch.asinh, math.asinh),
    ca.OP_ACOSH: (torch.acosh, math.acosh),
    ca.OP_ATANH: (torch.atanh, math.atanh),
    ca.OP_FABS: (torch.abs, abs),
    ca.OP_FLOOR: (torch.floor, math.floor),
    ca.OP_CEIL: (torch.ceil, math.ceil),
    ca.OP_ERF: (torch.erf, math.erf),
    ca.OP_SIGN: (torch.sign, lambda a: float((a > 0) - (a < 0))),
    ca.OP_NOT: (lambda a: (a == 0).to(a.dtype), lambda a: float(a == 0)),
}

_BINARY: dict[int, Callable[[Tensor, Tensor], Tensor]] = {
    ca.OP_ADD: torch.add,
    ca.OP_SUB: torch.sub,
    ca.OP_MUL: torch.mul,
    ca.OP_DIV: torch.div,
    ca.OP_POW: torch.pow,
    ca.OP_CONSTPOW: torch.pow,
    ca.OP_FMIN: torch.minimum,
    ca.OP_FMAX: torch.maximum,
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

_ARITHMETIC = {ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV}  # torch takes a Python float on either side


class TorchTwin:
    """A CasADi function evaluated by torch, batched and differentiable in every input.

    Args:
        function: A CasADi function that can be expanded to SX, with column inputs and outputs.

    Raises:
        InvalidArgumentError: If the function cannot be expanded to SX or uses an operation without a torch counterpart.
    """

    def __init__(self, function: ca.Function) -> None:
        self.name = function.name()
        expanded = _expanded(function)
        self._n_in = [expanded.numel_in(i) for i in range(expanded.n_in())]
        self._n_out = [expanded.numel_out(i) for i in range(expanded.n_out())]
        self._work_size = expanded.sz_w()
        self._program = [
            (
                expanded.instruction_id(k),
                expanded.instruction_input(k),
                expanded.instruction_output(k),
                expanded.instruction_constant(k) if expanded.instruction_id(k) == ca.OP_CONST else 0.0,
            )
            for k in range(expanded.n_instructions())
        ]
        for op, *_ in self._program:
            if op not in _UNARY and op not in _BINARY and op not in (ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT):
                raise InvalidArgumentError(
                    self.name, expected="operations that torch has", actual=f"CasADi operation {op}"
                )

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Evaluates the function.

        Args:
            *inputs: One tensor an input, ``(..., n_i)``; leading dimensions broadcast, so that parameters ``(n,)``
                may go with states ``(B, nx)``.

        Returns:
            The first output, ``(..., m)``, of the broadcast leading shape and the inputs' dtype.

        Raises:
            InvalidArgumentError: If an input's last dimension is not the function's.
        """
        for i, (tensor, size) in enumerate(zip(inputs, self._n_in, strict=True)):
            if tensor.shape[-1] != size:
                raise InvalidArgumentError(
                    f"input {i} of {self.name}",
                    expected=f"shape (..., {size})",
                    actual=f"shape {tuple(tensor.shape)}",
                )
        columns = [tensor.unbind(-1) for tensor in inputs]
        work: list[_Scalar] = [0.0] * self._work_size
        result: list[_Scalar] = [0.0] * self._n_out[0]
        for op, sources, targets, constant in self._program:
            if op == ca.OP_CONST:
                work[targets[0]] = constant
            elif op == ca.OP_INPUT:
                work[targets[0]] = columns[sources[0]][sources[1]]
            elif op == ca.OP_OUTPUT:
                if targets[0] == 0:
                    result[targets[1]] = work[sources[0]]
            elif op in _UNARY:
                work[targets[0]] = _unary(op, work[sources[0]])
            else:
                work[targets[0]] = _binary(op, work[sources[0]], work[sources[1]], inputs[0])
        shape = torch.broadcast_shapes(*(tensor.shape[:-1] for tensor in inputs))
        full = [
            torch.as_tensor(value, dtype=inputs[0].dtype, device=inputs[0].device).expand(shape) for value in result
        ]
        return torch.stack(full, dim=-1)


def _expanded(function: ca.Function) -> ca.Function:
    """The function as one SX function with dense outputs and common subexpressions shared."""
    try:
        symbols = [ca.SX.sym(f"i{i}", function.numel_in(i)) for i in range(function.n_in())]
        shaped = [ca.reshape(s, *function.size_in(i)) for i, s in enumerate(symbols)]
        outputs = function.expand().call(shaped) if not function.is_a("SXFunction") else function.call(shaped)
        return ca.Function(function.name(), symbols, [ca.densify(ca.cse(ca.vec(y))) for y in outputs])
    except RuntimeError as error:
        raise InvalidArgumentError(
            function.name(), expected="a function that CasADi can expand to SX", actual=str(error)[:200]
        ) from error


def _unary(op: int, a: _Scalar) -> _Scalar:
    on_tensor, on_float = _UNARY[op]
    return on_tensor(a) if isinstance(a, Tensor) else on_float(a)


def _binary(op: int, a: _Scalar, b: _Scalar, like: Tensor) -> _Scalar:
    if op in _ARITHMETIC and (isinstance(a, Tensor) or isinstance(b, Tensor)):
        return _BINARY[op](a, b) if isinstance(a, Tensor) else _reflected(op, a, b)
    if op in (ca.OP_POW, ca.OP_CONSTPOW) and isinstance(a, Tensor) and not isinstance(b, Tensor):
        return torch.pow(a, b)
    left, right = (torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in (a, b))
    return _BINARY[op](left, right)


def _reflected(op: int, a: float, b: _Scalar) -> _Scalar:
    if op == ca.OP_ADD:
        return b + a
    if op == ca.OP_MUL:
        return b * a
    return a - b if op == ca.OP_SUB else a / b
