"""What costs see of an MPC's state: the observation, the plant's states alone, or all of it; and what they ask for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from .layout import Layout
from .signals import Named


def stage_expression(layout: Layout, cost: Any, z: ca.SX, u: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
    """A stage cost in the state z ``(nx, 1)`` of the problem, with past inputs and signals where it asks for them."""
    before = [z[layout.previous.tolist()]] if getattr(cost, "uses_previous", False) else []
    return ca.SX(cost.expression(_seen_by(layout, cost, z), u, p, *before, **_outside(layout, cost, z)))


def terminal_expression(layout: Layout, cost: Any, z: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
    """A terminal cost in the state z ``(nx, 1)`` of the problem."""
    return ca.SX(cost.terminal_expression(_seen_by(layout, cost, z), p, **_outside(layout, cost, z)))


def sees_memory(layout: Layout, cost: Any) -> bool:
    """Whether a stage cost depends on past inputs."""
    return bool(getattr(cost, "uses_previous", False)) or layout.ny < layout.nx == getattr(cost, "nx", None)


def _seen_by(layout: Layout, cost: Any, z: ca.SX) -> ca.SX:
    """The observation in z, or as much of z as the cost's ``nx`` says."""
    size = getattr(cost, "nx", None)
    return z[:size] if size in (layout.nx, layout.n_states) else z[: layout.ny]


def _outside(layout: Layout, cost: Any, z: ca.SX) -> dict[str, Named]:
    """The present signals, for a cost that asks for them."""
    return {"d": layout.named(z[layout.present.tolist()])} if getattr(cost, "uses_signals", False) else {}
