"""What people see of an MPC: a line, or what notebooks show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.notebook import html_of
from mpcoffline.core.tables import Table
from mpcoffline.core.text import listed

if TYPE_CHECKING:
    from .problem import MPC

_MOST_COLUMNS = 12  # in a line


def text_of_mpc(mpc: MPC) -> str:
    """A line: what it sees and sets, how far it looks, parameters with their values and units."""
    sees = listed([*map(str, mpc.layout.y_labels)], _MOST_COLUMNS)
    parts = [f"{sees} -> {listed(_inputs(mpc), _MOST_COLUMNS)}"]
    parts.append(f"horizon {mpc.horizon} of {mpc.model.dt:g} s, discount {mpc.discount:g}")
    parts += [repr(mpc.model), f"stage cost {mpc.stage_cost!r}", f"terminal cost {mpc.terminal_cost!r}"]
    parts += [f"limits {', '.join(limits)}"] if (limits := _limits(mpc)) else []
    return f"MPC({'; '.join(parts)})"


def _inputs(mpc: MPC) -> list[str]:
    """Names, units and bounds of the inputs."""
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    return [f"{u}, {a:g} to {b:g}" for u, a, b in zip(mpc.layout.u_labels, low, high, strict=True)]


def _limits(mpc: MPC) -> list[str]:
    """Names of the limits that have some."""
    every = mpc.constraints if isinstance(mpc.constraints, Sequence) else []
    return [name for each in every if (name := str(getattr(each, "name", "")))]


def html_of_mpc(mpc: MPC) -> str:
    """States, inputs, and parameters with their units."""
    limits = _limits(mpc)
    facts = [
        ("observation", ", ".join(map(str, mpc.layout.y_labels))),
        ("inputs", "; ".join(_inputs(mpc))),
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
