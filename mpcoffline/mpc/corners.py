"""Corners of functions: where slopes jump or are infinite, and the same functions with their corners rounded.

What engineers write has them: ``fmax``, ``fabs``, ``if_else``, saturations, dead zones, ``sqrt`` and ``v**0.8`` at 0. A
method that follows slopes creeps or stalls at them. Rounded over a small part of the range that the quantity has, they
have slopes everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array

from .expressions import expanded, instructions
from .problem import MPC
from .rest import at_rest, extreme_inputs

_COMPARED = {ca.OP_FMAX: "fmax", ca.OP_FMIN: "fmin", ca.OP_LT: "if_else", ca.OP_LE: "if_else"}
_OF_ONE = {ca.OP_FABS: "fabs", ca.OP_SIGN: "sign", ca.OP_SQRT: "sqrt", ca.OP_POW: "pow", ca.OP_CONSTPOW: "pow"}
_LOGIC: dict[int, Callable[..., ca.SX]] = {
    ca.OP_NOT: lambda a: 1 - a,
    ca.OP_AND: lambda a, b: a * b,
    ca.OP_OR: lambda a, b: a + b - a * b,
    ca.OP_IF_ELSE_ZERO: lambda a, b: a * b,
}


@dataclass(frozen=True)
class Corner:
    """One operation with a corner, where a quantity is zero.

    Attributes:
        name: What it is called in CasADi, e.g. ``"fmax"``.
        at: Its place among the function's instructions.
        width: The half width of what is rounded, in the quantity's unit.
    """

    name: str
    at: int
    width: float


def rounded_mpc(mpc: MPC, share: float) -> tuple[MPC, list[Corner]]:
    """A problem whose functions have their corners rounded, its parts as they were, and which corners these are.

    Widths are a share of the range that each quantity has over rollouts from the reference state, or from 0, with the
    inputs in turn at their bounds and between: they follow any unit, and depend on the problem alone.

    Args:
        mpc: The problem.
        share: Of the range.
    """
    states, inputs = _visited(mpc)
    corners: list[Corner] = []
    changed = mpc.replace()
    for name, variables in (
        ("dynamics_function", [states, inputs]),
        ("stage_function", [states, inputs]),
        ("terminal_function", [states]),
    ):
        function, found = rounded(getattr(mpc, name), [*variables, mpc.theta], share)
        if found:
            corners += found
            changed.__dict__[name] = function  # where the problem keeps what it has derived of its parts
    return changed, corners


def _visited(mpc: MPC) -> tuple[Array, Array]:
    """States ``(nx, n)`` and inputs ``(nu, n)`` of the rollouts; those that are finite."""
    rng = np.random.default_rng(0)
    extremes = extreme_inputs(mpc)
    low, high = extremes.min(axis=0), extremes.max(axis=0)
    share = np.clip(rng.uniform(-0.5, 1.5, (mpc.nu, 64)), 0.0, 1.0)
    x = np.repeat(at_rest(mpc)[:, None], share.shape[1], axis=1)
    states, inputs = [], []
    for k in range(min(mpc.horizon, 50)):
        if k % 5 == 4:
            share = np.clip(rng.uniform(-0.5, 1.5, share.shape), 0.0, 1.0)
        u = low[:, None] + (high - low)[:, None] * share
        states.append(x)
        inputs.append(u)
        x = mpc.dynamics_function(x, u, mpc.theta).full()
    visited, applied = np.hstack(states), np.hstack(inputs)
    finite = np.isfinite(visited).all(axis=0)
    return visited[:, finite], applied[:, finite]


def rounded(function: ca.Function, samples: list[Array], share: float) -> tuple[ca.Function, list[Corner]]:
    """A function with its corners rounded, and which these are; the function itself where it has none.

    Args:
        function: Of one output.
        samples: An array an input, ``(size, n)``, or ``(size,)`` for one that is the same in all: the points at which
            the ranges of quantities are taken.
        share: Of the range of the quantity that is rounded over.
    """
    flat = expanded(function)
    if not any(op in _COMPARED or op in _OF_ONE for op, *_ in instructions(flat)):
        return function, []
    symbols = [ca.SX.sym(f"i{i}", flat.numel_in(i)) for i in range(flat.n_in())]
    quantities: dict[int, ca.SX] = {}
    _replayed(flat, symbols, quantities, {})
    fixed, positive = symbols[-1], _positive(flat, samples[-1])
    varying = ca.vertcat(*symbols[:-1])
    quantities = {k: q for k, q in quantities.items() if k not in positive and ca.depends_on(q, varying)}
    if not quantities:
        return function, []
    evaluated = ca.Function("q", [*symbols[:-1], fixed], [ca.vertcat(*quantities.values())])(*samples).full()
    ranges = np.nan_to_num(np.ptp(evaluated, axis=1), posinf=0.0)
    sizes = np.where(ranges > 0, ranges, np.nan_to_num(np.abs(evaluated).max(axis=1), posinf=0.0))
    widths = dict(zip(quantities, share * np.where(sizes > 0, sizes, 1.0), strict=True))
    program = list(instructions(flat))
    corners = [Corner((_COMPARED | _OF_ONE)[program[k].op], k, float(width)) for k, width in widths.items()]
    result = _replayed(flat, symbols, {}, widths)
    shaped = ca.reshape(result, *function.size_out(0))
    names = function.name_in(), function.name_out()
    return ca.Function(function.name(), symbols, [shaped], *names, {"cse": True}), corners


def _positive(flat: ca.Function, theta: Array) -> set[int]:
    """The places of operations on a first operand that is above zero in any case, e.g. ``1 + x**2``: no corner of it.

    Only where that shows in the operations themselves, with the parameters as they are.
    """
    lowest: dict[int, float] = {}  # by place in the work vector
    known: dict[int, ca.DM] = {}  # likewise: what depends on the parameters alone
    found: set[int] = set()
    for k, (op, sources, targets, constant) in enumerate(instructions(flat)):
        if op == ca.OP_OUTPUT:
            continue
        value: ca.DM | None = None
        least = -np.inf
        if op == ca.OP_CONST:
            value = ca.DM(constant)
        elif op == ca.OP_INPUT:
            value = ca.DM(theta[sources[1]]) if sources[0] == flat.n_in() - 1 else None
        else:
            if op in _OF_ONE and lowest[sources[0]] > 0.0:
                found.add(k)
            operands = [known[source] for source in sources if source in known]
            if len(operands) == len(sources):
                value = ca.DM.binary(op, *operands) if len(operands) > 1 else ca.DM.unary(op, *operands)
            else:
                least = _least(op, sources, [lowest[source] for source in sources])
        lowest[targets[0]] = least if value is None else float(value)
        if value is None:
            known.pop(targets[0], None)
        else:
            known[targets[0]] = value
    return found


def _least(op: int, sources: list[int], below: list[float]) -> float:
    """A bound from below of an operation's result, of those of its operands."""
    if op == ca.OP_EXP:
        return float(np.finfo(np.float64).tiny)
    if op in (ca.OP_SQ, ca.OP_FABS) or (op == ca.OP_MUL and sources[0] == sources[1]):
        return 0.0
    if op == ca.OP_ADD:
        return below[0] + below[1]
    if op == ca.OP_FMAX:
        return max(below)
    if op == ca.OP_SQRT:
        return float(np.sqrt(max(below[0], 0.0)))
    if op in (ca.OP_MUL, ca.OP_DIV):
        return 0.0 if min(below) >= 0.0 else -np.inf
    return 2.0 * below[0] if op == ca.OP_TWICE else -np.inf


def _replayed(
    flat: ca.Function, symbols: list[ca.SX], quantities: dict[int, ca.SX], widths: Mapping[int, float]
) -> ca.SX:
    """The function's output from its instructions, corners rounded where they have a width.

    What has its corner where a quantity is 0 enters that quantity by its place.
    """
    work: dict[int, ca.SX] = {}
    outputs: dict[int, ca.SX] = {}
    smooth: set[int] = set()  # places of what comparisons have become: numbers between 0 and 1
    for k, (op, sources, targets, constant) in enumerate(instructions(flat)):
        if op == ca.OP_OUTPUT:
            outputs[targets[1]] = work[sources[0]]
            continue
        if op == ca.OP_CONST:
            result = ca.SX(constant)
        elif op == ca.OP_INPUT:
            result = symbols[sources[0]][sources[1]]
        else:
            a, *rest = (work[source] for source in sources)
            if op in (ca.OP_NOT, *_LOGIC) and sources[0] in smooth:
                result = _LOGIC[op](a, *rest)
            else:
                b = rest[0] if rest else a
                quantity = _quantity(op, a, b)
                if quantity is not None:
                    quantities[k] = quantity
                result = _rounded(op, a, b, widths[k]) if k in widths else _plain(op, a, rest)
            is_smooth = (op in (ca.OP_LT, ca.OP_LE) and k in widths) or (
                op in (ca.OP_NOT, ca.OP_AND, ca.OP_OR) and sources[0] in smooth
            )
            (smooth.add if is_smooth else smooth.discard)(targets[0])
            work[targets[0]] = result
            continue
        smooth.discard(targets[0])
        work[targets[0]] = result
    return ca.vertcat(*(outputs[i] for i in range(len(outputs))))


def _plain(op: int, a: ca.SX, rest: list[ca.SX]) -> ca.SX:
    return ca.SX.binary(op, a, rest[0]) if rest else ca.SX.unary(op, a)


def _quantity(op: int, a: ca.SX, b: ca.SX) -> ca.SX | None:
    """What is zero at an operation's corner, or None where it has none."""
    if op in _COMPARED:
        return a - b
    if op in (ca.OP_POW, ca.OP_CONSTPOW):
        return a if b.is_constant() and float(b) < 2.0 and not float(b).is_integer() else None
    return a if op in _OF_ONE else None


def _rounded(op: int, a: ca.SX, b: ca.SX, width: float) -> ca.SX:
    """An operation whose slope changes over a width instead of at once, or is finite there."""
    d = a - b if op in _COMPARED else a
    size = ca.sqrt(d * d + width * width)  # |d|, rounded
    if op == ca.OP_FMAX:
        return 0.5 * (a + b + size)
    if op == ca.OP_FMIN:
        return 0.5 * (a + b - size)
    if op in (ca.OP_LT, ca.OP_LE):
        return 0.5 * (1 - d / size)
    if op == ca.OP_FABS:
        return size
    if op == ca.OP_SIGN:
        return d / size
    power = 0.5 if op == ca.OP_SQRT else float(b)
    return d * size ** (power - 1)
