"""The units that solvers compute in, so that nobody's units, offsets and signs matter."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

_DEEPEST = 200  # sums within sums that are looked through for constants
_WIDE = 1e19  # a bound beyond is none, as for ipopt


def split_constant(expression: ca.SX, variables: ca.SX) -> tuple[ca.SX, ca.SX]:
    """``rest, constant`` with expression = rest + constant, the constant free of the variables.

    A constant of a cost changes no plan, but costs digits wherever two costs are compared. Sums, differences, and their
    products with factors free of the variables are looked through; what stands elsewhere stays in the rest.

    Args:
        expression: A scalar.
        variables: A column.
    """

    def depends(part: ca.SX) -> bool:
        return bool(ca.depends_on(part, variables))

    def split(part: ca.SX, depth: int) -> tuple[ca.SX | None, ca.SX | None]:
        """The two summands; None for one that is not there. A part without a constant is left as it is, to the bit."""
        if not depends(part):
            return None, part
        op = ca.OP_INPUT if part.is_symbolic() or depth == _DEEPEST else part.op()
        if op in (ca.OP_ADD, ca.OP_SUB):
            if any(part.dep(i).is_symbolic() and depends(part.dep(i)) for i in (0, 1)):
                return part, None  # as x - x_ref: apart, both could be large
            sign = 1 if op == ca.OP_ADD else -1
            (a, c), (b, d) = (split(part.dep(i), depth + 1) for i in (0, 1))
            return (part, None) if c is None and d is None else (_sum(a, b, sign), _sum(c, d, sign))
        for i, form in _FACTORS.get(op, {}).items():
            other = part.dep(1 - i) if part.n_dep() == 2 else None
            if other is None or not depends(other):
                inner, constant = split(part.dep(i), depth + 1)
                if constant is None:
                    return part, None
                return (None if inner is None else form(inner, other)), form(constant, other)
        return part, None

    rest, constant = split(ca.densify(ca.SX(expression)), 0)
    return (ca.SX(0) if rest is None else rest), (ca.SX(0) if constant is None else constant)


# What is linear in one of its operands: which, and what it is of that one and the other.
_FACTORS: dict[int, dict[int, Callable[[ca.SX, Any], ca.SX]]] = {
    ca.OP_NEG: {0: lambda a, _: -a},
    ca.OP_TWICE: {0: lambda a, _: 2 * a},
    ca.OP_MUL: {0: lambda a, b: a * b, 1: lambda a, b: b * a},
    ca.OP_DIV: {0: lambda a, b: a / b},
}


def _sum(a: ca.SX | None, b: ca.SX | None, sign: int) -> ca.SX | None:
    """The sum a + sign b, either of which may not be there."""
    if b is None:
        return a
    return sign * b if a is None else a + b if sign > 0 else a - b


class Costs(NamedTuple):
    """The costs of an MPC without their constants, see :func:`split_constant`, and these.

    Attributes:
        stage: The stage cost.
        terminal: The terminal cost.
        offset: The constant of the stage cost; it may depend on theta.
        last: That of the terminal cost.
    """

    stage: ca.SX
    terminal: ca.SX
    offset: ca.SX
    last: ca.SX


def costs_of(mpc: MPC, x: ca.SX, u: ca.SX, theta: ca.SX) -> Costs:
    """The costs at symbols x ``(nx, 1)``, u ``(nu, 1)``, and theta."""
    stage, offset = split_constant(mpc.stage_function(x, u, theta), ca.vertcat(x, u))
    terminal, last = split_constant(mpc.terminal_function(x, theta), x)
    return Costs(stage, terminal, offset, last)


def cost_constant(mpc: MPC) -> ca.Function:
    """What the constants l, t of the costs add to V_theta, ``sum_k gamma^k l + gamma^N t``, as ``theta -> number``."""
    theta = ca.SX.sym("theta", mpc.space.size)
    costs = costs_of(mpc, ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), theta)
    weights = mpc.discount ** np.arange(mpc.horizon + 1)
    total = float(weights[:-1].sum()) * costs.offset + float(weights[-1]) * costs.last
    return ca.Function("constant", [theta], [ca.densify(total)])


def input_units(mpc: MPC) -> Array:
    """How large the inputs are against each other, ``(nu,)``: their ranges.

    Where one has no range, all are measured by what the stage cost says of them at its reference: 1 / sqrt(L_uu); by 1
    where it says nothing.
    """
    width = np.asarray(mpc.action_high) - np.asarray(mpc.action_low)
    if np.isfinite(width).all() and (width < _WIDE).all():
        return np.ascontiguousarray(width)
    x, u, theta = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX.sym("theta", mpc.space.size)
    hessian, _ = ca.hessian(mpc.stage_function(x, u, theta), u)
    at = mpc.state(np.zeros(mpc.layout.n_states) if mpc.reference is None else mpc.reference)
    level = np.clip(0.0, mpc.action_low, mpc.action_high)
    curvature = ca.Function("curvature", [x, u, theta], [ca.densify(ca.diag(hessian))])(at, level, mpc.theta)
    diagonal = np.abs(curvature.full().ravel())
    usable = bool(np.isfinite(diagonal).all() and (diagonal > 0.0).all())
    return 1.0 / np.sqrt(diagonal) if usable else np.ones(mpc.nu)
