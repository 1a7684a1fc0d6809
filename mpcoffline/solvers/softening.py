"""Exact penalties in place of hard limits, with prices from the problem's own multipliers and sizes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC, Constraint, Penalty, StateBounds

from .ddp import DDPSolver
from .limits import changes

_DEARER = 10.0  # than the largest multiplier that was seen: other states may have larger ones


def softened(mpc: MPC, x: ArrayLike) -> MPC:
    """The MPC with exact penalties ``l1`` in place of those hard limits that depend on the state.

    An l1 above a limit's largest multiplier changes no solution of a problem that can keep it; where none can, as after
    a disturbance, the violation is as small as it must be, and the problem is solved. The price of each limit is ten
    times the largest multiplier of the problems from the states ``x``, and no less than a hundred spreads of the stage
    cost over that of the limit, among random input sequences: no unit matters. Limits of inputs alone and of their
    changes stay hard, as any plan can keep them; likewise what is soft already.

    Example:
        >>> mpc = softened(mpc, table.observations[::100])
        >>> [(c.name, c.soft) for c in mpc.constraints]

    Args:
        mpc: The problem; where it has no hard limit that depends on the state, it is returned.
        x: States to ask for multipliers, ``(B, nx)`` or ``(nx,)``, as of a log: where limits are reached, if possible.

    Returns:
        The problem; its ``constraints`` show the prices. :func:`mpcoffline.diagnose` counts their violations.

    Raises:
        InvalidArgumentError: For states of another size, or where costs and limits are not finite from any of them.
    """
    if not any(soften for *_, soften in _elements(mpc)):
        return mpc
    states = np.atleast_2d(np.asarray(x, dtype=np.float64))
    solver = DDPSolver(mpc)
    solution = solver.solve(states)
    least = solver.limit_prices(states)
    least = least[np.isfinite(least).all(axis=1) & (least > 0.0).all(axis=1)]
    if not len(least):
        raise InvalidArgumentError(
            "x", expected="states from which costs and limits are finite", actual=str(states[:1])
        )
    prices: Array = np.median(least, axis=0)
    if solution.success.any():
        assert solution.multipliers is not None  # noqa: S101 -- there are limits; narrows the type
        seen = solution.multipliers[solution.success, : mpc.horizon + 1]
        prices = np.maximum(prices, _DEARER * seen.max(axis=(0, 1)))
    changed = {
        constraint.name: replace(constraint, soft=Penalty(float(prices[part].max()))) if soften else constraint
        for constraint, part, soften in _elements(mpc)
    }
    return mpc.replace(constraints=[changed[constraint.name] for constraint in _given(mpc)])


def _elements(mpc: MPC) -> Iterator[tuple[Constraint | StateBounds, slice, bool]]:
    """Each constraint, its part of the elements in the order of multipliers, and whether it is to be softened."""
    given = _given(mpc)
    along = [c for c in given if isinstance(c, Constraint) and not c.terminal]
    end = [c for c in given if isinstance(c, Constraint) and c.terminal]
    x, u, theta = (ca.SX.sym(name, n) for name, n in (("x", mpc.nx), ("u", mpc.nu), ("theta", mpc.space.size)))
    first = 0
    bounds = sorted((c for c in given if isinstance(c, StateBounds)), key=lambda each: each.at_end)
    ordered: list[Constraint | StateBounds] = [*along, *bounds, *end]
    for constraint in ordered:
        if isinstance(constraint, StateBounds):
            h = constraint.padded(mpc.nx - np.size(constraint.low)).expression(x)
        else:
            h = mpc.constraint_expression(constraint)(*((x, theta) if constraint.terminal else (x, u, theta)))
        last = first + h.numel()
        soften = constraint.soft is None and bool(ca.depends_on(h, x)) and None in changes(mpc, h, (x, u, theta))
        yield constraint, slice(first, last), soften
        first = last


def _given(mpc: MPC) -> tuple[Constraint | StateBounds, ...]:
    given = mpc.constraints if isinstance(mpc.constraints, tuple) else ()
    return tuple(each for each in given if isinstance(each, Constraint | StateBounds))
