"""What notebooks show of an MPC."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.notebook import html_of
from mpcoffline.core.tables import Table

if TYPE_CHECKING:
    from .problem import MPC


def html_of_mpc(mpc: MPC) -> str:
    """States, inputs, and parameters with their units."""
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    inputs = [f"{u}, {a:g} to {b:g}" for u, a, b in zip(mpc.layout.u_labels, low, high, strict=True)]
    limits = (
        [str(getattr(each, "name", "")) for each in mpc.constraints] if isinstance(mpc.constraints, Sequence) else []
    )
    facts = [
        ("observation", ", ".join(map(str, mpc.layout.y_labels))),
        ("inputs", "; ".join(inputs)),
        ("sampling time", f"{mpc.model.dt:g}"),
        ("horizon", f"{mpc.horizon} steps, discount {mpc.discount:g}"),
        ("stage cost", type(mpc.stage_cost).__name__),
        ("terminal cost", type(mpc.terminal_cost).__name__),
        ("limits", ", ".join(limits) or ("some" if mpc.constraints else "of the inputs alone")),
    ]
    return html_of("MPC", facts, [parameter_table(mpc)])


def parameter_table(mpc: MPC, given: MPC | None = None) -> Table:
    """The parameters with units and bounds.

    Args:
        mpc: The MPC.
        given: Another one with the same parameters, whose values stand first in place of bounds.
    """
    space = mpc.space
    units = [block.unit for block in space for _ in range(block.size)]
    header, parts = ["parameter", "unit", "value", "low", "high"], [space.theta, space.low, space.high]
    if given is not None and given.space.names == space.names:
        header, parts = ["parameter", "unit", "given", "learned"], [given.theta, space.theta]
    columns = zip(space.names, units, *parts, strict=True)
    rows = [(name, unit, *(f"{v:.4g}" for v in values)) for name, unit, *values in columns]
    return Table(header, rows, title="Parameters", align="llr")
