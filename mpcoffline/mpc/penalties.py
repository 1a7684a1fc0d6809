"""What the soft limits of a problem cost at a stage."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from .constraints import Constraint, Penalty, StateBounds
from .problem import MPC


def penalty_function(mpc: MPC) -> ca.Function | None:
    """The sum over all soft limits along the horizon of ``l1 s + l2 s^2``, s = max(h, 0), at a stage.

    Limits at the end of the horizon are no part of it, hard ones have no price.

    Args:
        mpc: The problem.

    Returns:
        A CasADi function ``(x, u, theta) -> price``; None where nothing along the horizon is soft.
    """
    x, u, theta = (ca.SX.sym(name, n) for name, n in (("x", mpc.nx), ("u", mpc.nu), ("theta", mpc.space.size)))
    total, found = ca.SX(0), False
    for _, soft, h in limit_expressions(mpc, x, u, theta):
        if soft is not None:
            over = ca.fmax(h, 0.0)
            total, found = total + soft.l1 * ca.sum1(over) + soft.l2 * ca.sumsqr(over), True
    return ca.Function("penalty", [x, u, theta], [ca.densify(total)]) if found else None


def limit_expressions(mpc: MPC, x: ca.SX, u: ca.SX, theta: ca.SX) -> list[tuple[str, Penalty | None, ca.SX]]:
    """All limits along the horizon, hard ones too: name, prices (None for a hard one), and h ``(n, 1)``, kept if <= 0.

    Args:
        mpc: The problem.
        x: State, ``(nx, 1)``.
        u: Inputs, ``(nu, 1)``.
        theta: Parameters, ``(size, 1)``.
    """
    along = mpc.constraints_at("stages")
    found = [(each.name, each.soft, ca.densify(mpc.constraint_expression(each)(x, u, theta))) for each in along]
    found += [(each.name, each.soft, ca.densify(each.expression(x))) for each in mpc.state_bounds]
    return [each for each in found if each[2].numel()]


def paid_in_value(mpc: MPC) -> MPC:
    """The problem without soft bounds at x_N, whose price there its terminal cost knows."""
    given = mpc.constraints if isinstance(mpc.constraints, tuple) else ()
    soft = [isinstance(each, StateBounds) and each.soft is not None and each.at_end for each in given]
    if not any(soft):
        return mpc
    changed = [replace(each, at_end=False) if chosen else each for each, chosen in zip(given, soft, strict=True)]
    return mpc.replace(constraints=changed)


def repriced(mpc: MPC, factor: float) -> MPC:
    """The problem with the prices of its soft limits multiplied, as where its costs are.

    Args:
        mpc: The problem.
        factor: Positive.
    """
    if factor == 1.0 or not isinstance(mpc.constraints, tuple):
        return mpc
    changed = [
        each
        if not isinstance(each, Constraint | StateBounds) or each.soft is None
        else replace(each, soft=Penalty(each.soft.l1 * factor, each.soft.l2 * factor))
        for each in mpc.constraints
    ]
    return mpc.replace(constraints=changed)
