"""What scripts that are written beside CasADi's files have in common: a template, and an MPC's numbers in it."""

from __future__ import annotations

import re
from importlib import resources
from importlib.metadata import version

import numpy as np

from mpcoffline.mpc import MPC
from mpcoffline.mpc.rest import at_rest


def script_of(mpc: MPC, template: str, **more: str) -> str:
    """A template of this package with each ``@NAME@`` replaced.

    Args:
        mpc: The problem, whose labels and numbers are put in.
        template: Name of the file.
        more: What else is replaced, and by what, as Python.
    """
    layout = mpc.layout
    states = [*map(str, layout.y_labels), *(f"{name}, an input of an earlier step" for name in layout.names)]
    replaced = {
        "CASADI": version("casadi"),
        "STATES": "\n".join(f"    x[{i}]  {name}" for i, name in enumerate(states)),
        "INPUTS": "\n".join(f"    u[{i}]  {label}" for i, label in enumerate(layout.u_labels)),
        "DT": repr(float(mpc.model.dt)),
        "HORIZON": str(mpc.horizon),
        "DISCOUNT": repr(float(mpc.discount)),
        "BOUNDS": ", ".join(map(array_text, (mpc.action_low, mpc.action_high, mpc.usual_input))),
        "USUAL": array_text(mpc.usual_input),
        "REST": array_text(at_rest(mpc)),
        **more,
    }
    text = resources.files(__package__).joinpath(template).read_text(encoding="utf-8")
    return re.sub(r"@([A-Z]+)@", lambda match: replaced[match[1]], text)


def array_text(values: object) -> str:
    """A vector as Python that makes it, where numpy is ``np``."""
    numbers = [repr(float(v)).replace("inf", "np.inf") for v in np.asarray(values, dtype=np.float64).ravel()]
    return f"np.array([{', '.join(numbers)}])"
