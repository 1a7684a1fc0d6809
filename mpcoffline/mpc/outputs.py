"""What sensors show: functions h of a plant's states, and of the inputs that acted just before.

A sensor is read before the next input is chosen. What it shows of inputs, as an accelerometer or an ammeter does, is of
those that acted in the step that ends there, dead time past: ``y_k = h(x_k, u_{k-1})``. So h of states alone, the usual
case, is a function of one argument, and costs nothing more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array

from .expressions import function_from_json, traced
from .signals import takes

#: Outputs, as users say them: which states sensors show, or h, x ``(n_states, 1)`` -> y, or x, u ``(nu, 1)`` -> y with
#: the inputs that acted in the step before; y is a CasADi column or a list.
Outputs = Sequence[int] | Callable[..., Any]


def outputs_of(given: Outputs, n_states: int, nu: int) -> ca.Function:
    """The h that a user has said.

    Raises:
        InvalidArgumentError: For outputs that are none of the states, or no expression.
    """
    x, u = ca.SX.sym("x", n_states), ca.SX.sym("u", nu)
    if callable(given):
        both = given.n_in() == 2 if isinstance(given, ca.Function) else takes(given, 2)
        found = given(x, u) if both else given(x)
        y = ca.SX(ca.vertcat(*found) if isinstance(found, (list, tuple)) else found)
        return traced("outputs", output_function(x, u, y))
    places = list(given)
    if not places or not all(isinstance(i, (int, np.integer)) and 0 <= i < n_states for i in places):
        raise InvalidArgumentError("outputs", expected=f"places of states, 0 to {n_states - 1}", actual=str(places))
    return ca.Function("outputs", [x], [x[[int(i) for i in places]]])


def output_function(x: ca.SX, u: ca.SX, y: ca.SX) -> ca.Function:
    """The h of expressions, ``(x, u) -> y``; ``x -> y`` where no output depends on inputs."""
    return ca.Function("outputs", [x, u] if ca.depends_on(y, u) else [x], [ca.densify(y)])


def feedthrough(h: ca.Function) -> NDArray[np.bool_]:
    """Which outputs depend on inputs, ``(n_outputs,)``."""
    found = np.zeros(h.numel_out(0), dtype=bool)
    if h.n_in() > 1:
        found[h.jac_sparsity(0, 1).row()] = True
    return found


def shown(h: ca.Function, x: Array, acted: Array) -> Array:
    """Outputs without noise, ``(..., n_outputs)``.

    Args:
        h: Of :func:`output_function`.
        x: States, ``(..., n_states)``.
        acted: The inputs that acted in the step before, and whatever else, ``(..., nu + n)``.
    """
    arguments = [x] if h.n_in() == 1 else [x, acted[..., : h.numel_in(1)]]
    flat = h(*(each.reshape(-1, each.shape[-1]).T for each in arguments)).full().T
    return np.asarray(flat.reshape(*x.shape[:-1], -1))


def outputs_from_json(data: Any, n_states: int, nu: int, n_outputs: int | None = None) -> ca.Function:
    """The h of a file, as :func:`~mpcoffline.mpc.expressions.function_to_json` wrote it.

    Raises:
        FileFormatError: If it is damaged, or of other sizes.
    """
    sizes = data.get("inputs") if isinstance(data, Mapping) else None
    inputs = (n_states, nu) if isinstance(sizes, list) and len(sizes) == 2 else (n_states,)
    return function_from_json(data, "outputs", inputs=inputs, output=n_outputs)
