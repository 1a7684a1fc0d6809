"""Phase portraits: V as shades of a plane of the state, and the closed loops on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.envs import State

from .panels import Landscape, Plane, in_pi, on_plane, plane_of, task_of, unwrapped
from .style import OTHER, PAGE_WIDTH, STYLES, legend_handles, line_of, new_figure, paper_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mpcoffline.control.evaluation import Evaluation

_LEVELS = 14  # about
_EXTREME = 99.5  # percentile of V at which its shades end
_START: dict[str, Any] = {
    "marker": "o", "color": "white", "markeredgecolor": "black", "markersize": 4.5, "markeredgewidth": 0.8,
}  # fmt: skip
_TARGET = _START | {"marker": "*", "markersize": 10, "markeredgewidth": 0.7}
_MARGIN = 0.04  # around trajectories that leave the plane, as a share of it


def phase_portrait(
    value: Callable[[Array], Array],
    loops: Mapping[str, Evaluation],
    env: gym.Env[Any, Any] | str,
    label: str = "$V$",
) -> Figure:
    """Draws V on a plane of the state, and the trajectories of closed loops.

    The plane is that of position and speed, or angle and angular speed; V is taken with all other coordinates zero. Of
    an angle more than a whole turn is shown, so that trajectories do not jump.

    Args:
        value: From observations ``(m, ny)`` to V ``(m,)``: a ``ValueFunction.predict`` or an MPC's ``solver.value``.
        loops: What :func:`mpcoffline.evaluate` found, by controller; all episodes are drawn.
        env: The environment or its id.
        label: Name of the function at the colour bar.

    Returns:
        The figure; :func:`save_figure` writes it.

    Raises:
        InvalidArgumentError: For an environment that is none of this package's tasks.
    """
    from matplotlib.lines import Line2D

    task, plant = task_of(env)
    plane = _around(plane_of(plant), loops)
    landscape = on_plane(task, plane, value)
    with paper_style():
        figure = new_figure(0.75 * PAGE_WIDTH, 3.3)
        axes = figure.subplots()
        shades = draw_levels(axes, landscape)
        figure.colorbar(shades, ax=axes, label=label, pad=0.02, aspect=30).outline.set_linewidth(0.6)
        for name, loop in loops.items():
            for states in loop.states:
                _draw_trajectory(axes, states, plane, name)
        _mark_target(axes, plane)
        label_plane(axes, plane)
        handles, names = legend_handles(list(loops))
        marks = [Line2D([], [], linestyle="", **_START), Line2D([], [], linestyle="", **_TARGET)]
        handles, names = [*handles, *marks], [*names, "start", "target"]
        figure.legend(handles, names, loc="outside upper center", ncols=len(names), handlelength=3.2)
    return figure


def draw_levels(axes: Axes, landscape: Landscape, span: tuple[float, float] | None = None) -> Any:
    """Shades and lines of equal values; dark is small, so that it reads the same in grey.

    Args:
        axes: Where.
        landscape: What.
        span: Where the shades begin and end; from the smallest to near the largest value by default.

    Returns:
        The shades, for a colour bar.
    """
    from matplotlib.ticker import MaxNLocator

    horizontal, vertical, values = landscape
    low, high = (float(values.min()), float(np.percentile(values, _EXTREME))) if span is None else span
    levels = MaxNLocator(_LEVELS).tick_values(low, max(high, low + 1e-9))
    extend = "max" if values.max() > levels[-1] else "neither"
    shades = axes.contourf(horizontal, vertical, values, levels, cmap="cividis", extend=extend)
    shades.set_rasterized(True)
    axes.contour(horizontal, vertical, values, levels[1::2], colors="white", linewidths=0.35, alpha=0.7)
    axes.grid(visible=False)
    return shades


def label_plane(axes: Axes, plane: Plane) -> None:
    """Names the axes of a task's plane and sets their limits; angles in half turns."""
    horizontal, vertical = plane
    axes.set(xlabel=horizontal.label, ylabel=vertical.label, xlim=horizontal.span, ylim=vertical.span)
    if horizontal.angle:
        turns = half_turns(horizontal)
        axes.set_xticks([np.pi * k for k in turns], [in_pi(k) for k in turns])


def half_turns(coordinate: State) -> range:
    """The k for which k pi is in an angle's span."""
    low, high = coordinate.span
    return range(int(np.ceil(low / np.pi)), int(np.floor(high / np.pi)) + 1)


def _around(plane: Plane, loops: Mapping[str, Evaluation]) -> Plane:
    """The plane, widened where trajectories leave it."""
    trajectories = [_projected(states, plane) for loop in loops.values() for states in loop.states]
    wide = []
    for i, coordinate in enumerate(plane):
        low, high = coordinate.span
        margin = _MARGIN * (high - low)
        visited = np.concatenate([trajectory[i] for trajectory in trajectories])
        low, high = min(low, float(visited.min()) - margin), max(high, float(visited.max()) + margin)
        wide.append(replace(coordinate, span=(low, high)))
    return wide[0], wide[1]


def _projected(states: Array, plane: Plane) -> tuple[Array, Array]:
    """A trajectory ``(T, nx)`` in the plane, angles without jumps."""
    x, y = (unwrapped(states[:, c.index]) if c.angle else states[:, c.index] for c in plane)
    return x, y


def _draw_trajectory(axes: Axes, states: Array, plane: Plane, name: str) -> None:
    from matplotlib.patheffects import Normal, Stroke

    x, y = _projected(states, plane)
    style = STYLES.get(name, OTHER)
    halo = [Stroke(linewidth=style.width + 2.2, foreground="white"), Normal()]
    axes.plot(x, y, **line_of(style), path_effects=halo, zorder=3)
    axes.plot(x[0], y[0], **_START, zorder=4)


def _mark_target(axes: Axes, plane: Plane) -> None:
    horizontal = plane[0]
    places = [np.pi * k for k in half_turns(horizontal) if k % 2 == 0] if horizontal.angle else [0.0]
    for place in places:
        axes.plot(place, 0.0, **_TARGET, zorder=5)
