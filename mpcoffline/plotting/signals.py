"""Quantities of closed loops over time, and bars of what they cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.envs import Plant

from .panels import in_pi, unwrapped
from .style import BOUND, COURSE, OTHER, STYLES, controller_label, line_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Signal:
    """One quantity of a closed loop over time.

    Attributes:
        label: Name and unit for the axis.
        values: One curve a controller, each ``(T,)``.
        bounds: Lower and upper limit that the quantity must keep; drawn as shaded edges.
        target: Value that it should reach; drawn as a thin line.
        held: Whether it is constant between samples (an input).
        angle: Whether it is an angle in rad; it is drawn without jumps, with the target at every full turn.
        band: Half-width around the target that counts as success; shaded.
        course: What the quantity should follow, step by step, or itself where no controller moves it; a thin line.
        limits: Values that it should not pass; dashed lines.
    """

    label: str
    values: Mapping[str, Array]
    bounds: tuple[float, float] | None = None
    target: float | None = None
    held: bool = False
    angle: bool = False
    band: float | None = None
    course: Array | None = None
    limits: tuple[float, ...] = ()


def signals_of(plant: Plant, states: Mapping[str, Array], actions: Mapping[str, Array]) -> list[Signal]:
    """What figures show of closed loops: states with their targets, inputs with their bounds.

    Args:
        plant: The plant.
        states: One trajectory a controller, each ``(T + 1, nx)``.
        actions: Likewise, each ``(T, nu)``.
    """
    shown = [
        Signal(c.label, {name: s[:, c.index] for name, s in states.items()}, target=0.0, angle=c.angle, band=c.band)
        for c in map(plant.state, plant.shown)
    ]
    inputs = [
        Signal(c.label, {name: a[:, c.index] for name, a in actions.items()}, bounds=(c.low, c.high), held=True)
        for c in plant.inputs
    ]
    return shown + inputs


def draw_signal(axes: Axes, signal: Signal, dt: float) -> None:
    """Draws one quantity over time.

    Args:
        axes: Where.
        signal: What.
        dt: Sampling time in s.
    """
    if signal.target is not None and not signal.angle:
        _draw_target(axes, signal.target, signal.band)
    for limit in signal.limits:
        axes.axhline(limit, color=BOUND, linewidth=0.9, linestyle=(0, (2, 1.5)), zorder=2)
    if signal.course is not None:
        times = dt * np.arange(len(signal.course), dtype=np.float64)
        axes.plot(times, signal.course, drawstyle="steps-post", color=COURSE, linewidth=0.9, zorder=2)
    for name, values in signal.values.items():
        style = STYLES.get(name, OTHER)
        times = dt * np.arange(len(values), dtype=np.float64)
        if signal.held:
            axes.stairs(values, dt * np.arange(len(values) + 1), baseline=None, **line_of(style), zorder=3)
        else:
            axes.plot(times, unwrapped(values) if signal.angle else values, **line_of(style), zorder=3)
    if signal.bounds is not None:
        _draw_bounds(axes, *signal.bounds)
    if signal.angle:
        _draw_turns(axes, signal)
    axes.set_ylabel(signal.label)


def draw_bars(axes: Axes, groups: Mapping[str, Mapping[str, float]], unit: float | None = 1.0) -> None:
    """Draws groups of bars with their values written above: one group a controller, one bar a measure.

    Args:
        axes: Where.
        groups: ``{controller: {measure: value}}``; the same measures for all.
        unit: Where to draw the line of the reference.
    """
    names, measures = list(groups), list(next(iter(groups.values())))
    width = 0.8 / len(measures)
    top = max(value for group in groups.values() for value in group.values())
    for j, measure in enumerate(measures):
        for i, name in enumerate(names):
            value = groups[name][measure]
            style = STYLES.get(name, OTHER)
            position = i + (j - 0.5 * (len(measures) - 1)) * width
            face = style.color if j == 0 else "white"
            axes.bar(
                position, value, 0.92 * width, facecolor=face, edgecolor=style.color, hatch="" if j == 0 else "////"
            )
            axes.annotate(
                f"{value:.2f}",
                (position, value),
                (0, 1.5),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=6.5,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.4},
                zorder=5,
            )
    if unit is not None:
        axes.axhline(unit, color="black", linewidth=0.8, linestyle=(0, (1, 1.2)), zorder=4)
    axes.set_xticks(range(len(names)), [controller_label(name) for name in names])
    axes.tick_params(axis="x", length=0)
    axes.grid(visible=False, axis="x")
    axes.set_ylim(0.0, 1.14 * max(top, unit or 0.0))


def _draw_turns(axes: Axes, signal: Signal) -> None:
    """Ticks at half turns, and target and band at every full turn that is in sight."""
    low, high = axes.get_ylim()
    ticks = range(int(np.ceil(low / np.pi)), int(np.floor(high / np.pi)) + 1)
    axes.set_yticks([np.pi * k for k in ticks], [in_pi(k) for k in ticks])
    if signal.target is None:
        return
    margin = signal.band or 0.0
    for k in range(round((low - signal.target) / (2 * np.pi)), round((high - signal.target) / (2 * np.pi)) + 1):
        target = signal.target + 2 * np.pi * k
        if low - margin < target < high + margin:
            _draw_target(axes, target, signal.band)
    axes.set_ylim(low, high)


def _draw_target(axes: Axes, target: float, band: float | None) -> None:
    axes.axhline(target, color=BOUND, linewidth=0.6, zorder=1)
    if band is not None:
        axes.axhspan(target - band, target + band, color="#EAEAEA", linewidth=0, zorder=0)


def _draw_bounds(axes: Axes, low: float, high: float) -> None:
    values = np.array(axes.dataLim.intervaly)
    if (values > 0.5 * low).all() and (values < 0.5 * high).all():  # far from both: they would flatten the curves
        text = f"bounds $\\pm${high:g}" if low == -high else f"bounds {low:g}, {high:g}"
        axes.annotate(text, (1.0, 0.96), xycoords="axes fraction", ha="right", va="top", fontsize=7, color="#595959")
        return
    margin = 0.12 * (high - low)
    for bound, side in ((low, -1.0), (high, 1.0)):
        axes.axhline(bound, color=BOUND, linewidth=0.8, zorder=2)
        axes.axhspan(
            bound, bound + side * margin, facecolor="#EDEDED", hatch="////", edgecolor="#C4C4C4", linewidth=0, zorder=1
        )
    axes.set_ylim(low - margin, high + margin)
