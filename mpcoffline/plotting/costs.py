"""The stage cost before and after learning: its weights as numbers, its level sets as a landscape."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import gymnasium as gym
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.envs import Plant
from mpcoffline.mpc import MPC
from mpcoffline.mpc.rest import at_rest

from .panels import on_plane, plane_of, task_of
from .portrait import draw_levels, label_plane
from .style import PAGE_WIDTH, controller_label, new_figure, paper_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FEW = 4  # entries that leave room for larger numbers
_DARK = 0.6  # share of the largest weight from which on the numbers are set in white


def cost_figure(
    nominal: MPC,
    learned: MPC,
    env: gym.Env[Any, Any] | str,
    names: tuple[str, str] = ("MPC_1", "MPC_3"),
) -> Figure:
    """Draws the stage costs of two MPCs: weights [[W, S], [S', R]], and level sets of Lhat(y(s), 0) in a plane of s.

    The weights of a cost that is not quadratic are half its Hessian at the reference.

    Args:
        nominal: The MPC before learning.
        learned: The MPC after it.
        env: The environment or its id.
        names: How they are called.

    Returns:
        The figure; :func:`save_figure` writes it.

    Raises:
        InvalidArgumentError: For an environment that is none of this package's tasks, or MPCs of another one.
    """
    task, plant = task_of(env)
    plane = plane_of(plant)
    mpcs = (nominal, learned)
    for mpc in mpcs:
        if (mpc.ny, mpc.nu) != (len(plant.observations), len(plant.inputs)):
            raise InvalidArgumentError(
                "MPC",
                expected=f"{len(plant.observations)} states and {len(plant.inputs)} inputs, as in the environment",
                actual=f"{mpc.ny} and {mpc.nu}",
            )
    weights = [stage_weights(mpc) for mpc in mpcs]
    landscapes = [on_plane(task, plane, partial(_stage_cost, mpc)) for mpc in mpcs]
    everything = np.stack([values for _, _, values in landscapes])
    span = float(everything.min()), float(everything.max())  # one colour bar for both
    with paper_style():
        figure = new_figure(PAGE_WIDTH, 4.6)
        panels = np.asarray(figure.subplots(2, 2, width_ratios=(1.0, 1.25)))
        for (left, right), name, weight, landscape in zip(panels, names, weights, landscapes, strict=True):
            draw_weights(left, weight, _entries(plant))
            left.set_title(f"weights of {controller_label(name)}")
            shades = draw_levels(right, landscape, span)
            right.set_title(f"stage cost of {controller_label(name)}, no input")
            label_plane(right, plane)
        figure.colorbar(shades, ax=panels[:, 1], pad=0.02, aspect=40, label="$\\hat L$")
    return figure


def weights_figure(nominal: MPC, learned: MPC, names: tuple[str, str] = ("MPC_1", "MPC_3")) -> Figure:
    """Draws the weights of two MPCs' stage costs, of any plant, as :func:`cost_figure` does for the tasks.

    Args:
        nominal: The MPC before learning.
        learned: The MPC after it.
        names: How they are called.

    Returns:
        The figure; :func:`save_figure` writes it.
    """
    with paper_style():
        figure = new_figure(PAGE_WIDTH, 2.9)
        for axes, name, mpc in zip(np.asarray(figure.subplots(1, 2)), names, (nominal, learned), strict=True):
            entries = [each.name for each in (*mpc.layout.y_labels, *mpc.layout.u_labels)]
            draw_weights(axes, stage_weights(mpc), entries)
            axes.tick_params(axis="x", rotation=45)
            axes.set_title(f"weights of {controller_label(name)}")
    return figure


def stage_weights(mpc: MPC) -> Array:
    """Half the Hessian of the stage cost in observation and input at the reference, ``(ny + nu, ny + nu)``.

    Of a quadratic cost this is [[W, S], [S', R]] of (COST).
    """
    x, u = ca.SX.sym("x", mpc.ny), ca.SX.sym("u", mpc.nu)
    z = ca.vertcat(x, ca.DM(mpc.layout.filled(mpc.usual_input)))
    hessian, _ = ca.hessian(mpc.stage_function(z, u, mpc.theta), ca.vertcat(x, u))
    at = at_rest(mpc)[: mpc.ny], mpc.values.get("stage_cost.u_ref", np.zeros(mpc.nu))
    return np.asarray(0.5 * ca.Function("H", [x, u], [hessian])(*at).full())


def draw_weights(axes: Axes, weights: Array, entries: list[str]) -> None:
    """A matrix as shades of its entries' sizes, with the numbers.

    Args:
        axes: Where.
        weights: The matrix, ``(n, n)``.
        entries: Names of rows and columns.
    """
    size, fontsize = np.abs(weights), 7.0 if len(weights) <= _FEW else 5.5
    # By the root, so that small weights can be told from zeros.
    axes.imshow(np.sqrt(size), cmap="Blues", vmin=0.0, vmax=1.25 * np.sqrt(size.max()))
    for (i, j), number in np.ndenumerate(weights):
        color = "white" if np.sqrt(size[i, j]) > _DARK * np.sqrt(size.max()) else "black"
        text = _number(number, size.max(), exact=i == j)
        axes.text(j, i, text, ha="center", va="center", fontsize=fontsize, color=color)
    places = range(len(entries))
    axes.set_xticks(places, entries)
    axes.set_yticks(places, entries)
    axes.tick_params(length=0, labelsize=fontsize)
    axes.xaxis.tick_top()
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _number(value: float, largest: float, *, exact: bool) -> str:
    """Three digits of the largest entry; what they do not show of a small one is called zero unless it is exact."""
    decimals = max(0, 2 - int(np.floor(np.log10(largest)))) if largest > 0.0 else 0
    shown = f"{value:.{decimals}f}"
    if float(shown) == 0.0:
        shown = f"{value:.1g}" if exact else "0"
    return shown.replace("-", "−")


def _stage_cost(mpc: MPC, y: Array) -> Array:
    """Lhat(y, 0) of observations ``(m, ny)``, ``(m,)``."""
    return mpc.stage_costs(mpc.state(y), np.zeros((len(y), mpc.nu)))


def _entries(plant: Plant) -> list[str]:
    """Names of the observations and the inputs, without units."""
    return [*plant.observations, *(f"${c.symbol}$" for c in plant.inputs)]
