"""The limits of an MPC besides input bounds, element by element: hard and soft, along the horizon and at its end."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC, Penalty, StateBounds


class Rates(NamedTuple):
    """Hard limits ``-down <= u_i - (the input of the step before) <= up``: bounds that move with what x carries.

    Attributes:
        elements: Which elements of the limits they are, ``(n,)``.
        places: Where in x the input of the step before stands, ``(nu,)``; -1 for an input without such a limit.
        up: Largest rise in a step, ``(nu,)``; inf where there is no limit.
        down: Largest fall.
    """

    elements: NDArray[np.bool_]
    places: NDArray[np.intp]
    up: Array
    down: Array


class Limits(NamedTuple):
    """All elements h_j <= 0, in three blocks: of constraints along the horizon, of state bounds, of those at the end.

    Bounds without ``at_end`` are the last of the first block.

    Attributes:
        stage: What holds at the stages 0 ... N - 1: the first two blocks, bounds from stage 1 on.
        end: What holds at N: the last two blocks.
        labels: The name of each element.
        l1: Price of a violation, ``(n,)``; inf where the limit is hard.
        l2: Price of its square.
        n_stage: Elements of the first block.
        n_bounds: Of the second.
        by_input: Which elements depend on the input, ``(n,)``: no other one can be changed at stage 0.
        rates: Those that only say by how much an input may change.
    """

    stage: ca.SX
    end: ca.SX
    labels: tuple[str, ...]
    l1: Array
    l2: Array
    n_stage: int
    n_bounds: int
    by_input: NDArray[np.bool_]
    rates: Rates


def limits_of(mpc: MPC, x: ca.SX, u: ca.SX, theta: ca.SX) -> Limits | None:
    """The limits in these symbols; None where there are none."""
    labels: list[str] = []
    penalties: list[Penalty | None] = []

    def add(names: list[str], penalty: Penalty | None) -> None:
        labels.extend(names)
        penalties.extend([penalty] * len(names))

    along, bounds, end = ca.SX(0, 1), ca.SX(0, 1), ca.SX(0, 1)
    for constraint in mpc.constraints_at("stages"):
        h = mpc.constraint_expression(constraint)(x, u, theta)
        along = ca.vertcat(along, ca.densify(h))
        add(element_names(constraint.name, h.numel()), constraint.soft)
    for bound in sorted(mpc.state_bounds, key=lambda each: each.at_end):
        if bound.at_end:
            bounds = ca.vertcat(bounds, bound.expression(x))
        else:
            along = ca.vertcat(along, bound.expression(x))
        add(_bound_names(bound), bound.soft)
    for constraint in mpc.constraints_at("end"):
        h = mpc.constraint_expression(constraint)(x, theta)
        end = ca.vertcat(end, ca.densify(h))
        add(element_names(constraint.name, h.numel()), constraint.soft)
    if not labels:
        return None
    by_input = np.zeros(len(labels), dtype=bool)
    by_input[: along.numel()] = depends_on_input(along, u)
    l1 = np.array([np.inf if p is None else p.l1 for p in penalties])
    return Limits(
        ca.vertcat(along, bounds),
        ca.vertcat(bounds, end),
        tuple(labels),
        l1,
        np.array([0.0 if p is None else p.l2 for p in penalties]),
        along.numel(),
        bounds.numel(),
        by_input,
        _rates(mpc, along, l1, (x, u, theta)),
    )


def changes(mpc: MPC, h: ca.SX, symbols: tuple[ca.SX, ca.SX, ca.SX]) -> list[tuple[int, float, float] | None]:
    """Which elements of h say that ``s (u_i - (u_i of the step before)) <= most``: i, s = 1 or -1, most in u's unit.

    Args:
        mpc: The problem.
        h: Of a constraint along the horizon, ``(n, 1)``.
        symbols: x, u and theta.
    """
    nx, nu = mpc.nx, mpc.nu
    if min(mpc.layout.carried) < 1:
        return [None] * h.numel()
    z = ca.vertcat(*symbols)
    jacobian = ca.jacobian(h, z)
    is_constant = [jacobian[j, :].is_constant() for j in range(h.numel())]
    value = ca.Function("h", [z], [jacobian, h])
    slopes, at_zero = (part.full() for part in value(0.0))
    found: list[tuple[int, float, float] | None] = []
    for j, row in enumerate(slopes):
        places = np.flatnonzero(row).tolist()
        i = places[1] - nx if len(places) == 2 else -1  # of two, the input comes after the state
        is_change = (
            is_constant[j] and 0 <= i < nu and places[0] == mpc.layout.previous[i] and row[nx + i] == -row[places[0]]
        )
        found.append((i, np.sign(row[nx + i]), -at_zero[j, 0] / abs(row[nx + i])) if is_change else None)
    return found


def _rates(mpc: MPC, along: ca.SX, l1: Array, symbols: tuple[ca.SX, ca.SX, ca.SX]) -> Rates:
    """Of the hard ones, those that any input can keep: the input before among them."""
    places, up, down = np.full(mpc.nu, -1), np.full(mpc.nu, np.inf), np.full(mpc.nu, np.inf)
    elements = np.zeros(len(l1), dtype=bool)
    for j, change in enumerate(changes(mpc, along, symbols)):
        if change is None or np.isfinite(l1[j]) or not change[2] >= 0.0:
            continue
        i, sign, most = change
        side = up if sign > 0.0 else down
        elements[j], places[i], side[i] = True, mpc.layout.previous[i], min(side[i], most)
    return Rates(elements, places, up, down)


def depends_on_input(h: ca.SX, u: ca.SX) -> NDArray[np.bool_]:
    """Which elements of a column depend on the input."""
    return np.array([bool(ca.depends_on(h[j], u)) for j in range(h.numel())], dtype=bool)


def element_names(name: str, n: int) -> list[str]:
    """What the n elements of a constraint are called."""
    return [name] if n == 1 else [f"{name}[{i}]" for i in range(n)]


def _bound_names(bounds: StateBounds) -> list[str]:
    """By the states that they are of, in the order of ``StateBounds.expression``."""
    high, low = np.isfinite(np.asarray(bounds.high)), np.isfinite(np.asarray(bounds.low))
    return [f"{bounds.name}[{i}]" for i in [*np.flatnonzero(high), *np.flatnonzero(low)]]
