"""The figure of a report."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.plotting import PAGE_WIDTH, STYLES, controller_label, new_figure, paper_style

from .measures import RegionError, ValueCheck
from .verdict import Comparison, Verdict

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
_HEIGHT = 4.6
_POINTS = 1_500


@dataclass(frozen=True)
class Traces:
    """What the figure shows besides.

    Attributes:
        nominal_states: MPC_1 on the identified model, ``(starts, T + 1, nx)``.
        learned_states: The learned MPC, likewise.
        value: V of some logged states and the return measured from each, ``(2, n)``.
        goal: The reference, ``(nx,)``, where there is one.
    """

    nominal_states: Array = field(repr=False)
    learned_states: Array = field(repr=False)
    value: Array = field(repr=False)
    goal: Array | None = field(repr=False)


def draw(
    verdict: Verdict, comparison: Comparison, value: ValueCheck, fit: tuple[RegionError, ...], traces: Traces
) -> Figure:
    """Draws relative costs on the models, closed loops, V against returns, and the error of (FIT).

    Args:
        verdict: What the report says.
        comparison: Both controllers on the ensemble.
        value: V_phi against measured returns.
        fit: The error of (FIT) by region.
        traces: What is not in the report's text.
    """
    with paper_style():
        figure = new_figure(PAGE_WIDTH, _HEIGHT)
        axes = figure.subplots(2, 2)
        figure.suptitle(f"Verdict: {verdict}", fontsize=10, fontweight="bold", x=0.01, ha="left")
        _draw_ratios(axes[0, 0], comparison)
        _draw_distances(axes[0, 1], traces)
        _draw_value(axes[1, 0], value, traces)
        _draw_fit(axes[1, 1], fit)
    return figure


def _draw_ratios(axes: Axes, c: Comparison) -> None:
    """One dot a model: the learned controller's cost over that of MPC_1."""
    n_residual = (len(c.ratios) - 1) // 2
    kinds = ["identified"] + ["parameters varied"] * (len(c.ratios) - 1 - n_residual) + ["with residual"] * n_residual
    colors = {"identified": "#000000", "parameters varied": STYLES["MPC_3"].color, "with residual": "#009E73"}
    for kind, color in colors.items():
        places = [i for i, k in enumerate(kinds) if k == kind]
        axes.plot(places, [c.ratios[i] for i in places], "o", color=color, markersize=4.5, label=kind, zorder=3)
    axes.axhline(1.0, color=STYLES["MPC_1"].color, linewidth=1.0, zorder=2)
    axes.annotate(
        "as MPC$_{1}$", (0.0, 1.0), (2, 2), xycoords=("axes fraction", "data"), textcoords="offset points", fontsize=7
    )
    axes.axhline(c.limit, color="#767676", linewidth=0.8, linestyle=(0, (4, 2)), zorder=2)
    axes.annotate(
        "limit of the verdict",
        (1.0, c.limit),
        (-2, -8),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        ha="right",
        fontsize=7,
        color="#595959",
    )
    axes.set_ylim(0.0, max(1.15, 1.1 * max(c.ratios)))
    axes.set_xticks([])
    axes.set_xlabel("model of the log")
    axes.set_ylabel("cost relative to MPC$_{1}$")
    axes.set_title("Simulated cost", loc="left")
    axes.legend(loc="lower left", ncols=3, fontsize=7, handletextpad=0.2, columnspacing=0.8)


def _draw_distances(axes: Axes, traces: Traces) -> None:
    """How far both controllers are from where they end, over the steps: median and quartiles over the starts."""
    everything = np.concatenate([traces.nominal_states, traces.learned_states]).reshape(
        -1, traces.learned_states.shape[2]
    )
    spread = np.where(everything.std(axis=0) > 0.0, everything.std(axis=0), 1.0)
    goal = np.median(traces.learned_states[:, -1], axis=0) if traces.goal is None else traces.goal
    for name, states, style in (
        ("MPC_1", traces.nominal_states, STYLES["MPC_1"]),
        ("learned", traces.learned_states, STYLES["MPC_3"]),
    ):
        distance = np.linalg.norm((states - goal) / spread, axis=2)
        low, middle, high = np.quantile(distance, [0.25, 0.5, 0.75], axis=0)
        steps = np.arange(len(middle))
        axes.fill_between(steps, low, high, color=style.color, alpha=0.18, linewidth=0)
        axes.plot(
            steps,
            middle,
            color=style.color,
            linestyle=style.dashes,
            linewidth=style.width,
            label=controller_label(name),
        )
    axes.set_ylim(0.0, 1.2 * axes.get_ylim()[1])
    axes.set_xlabel("step (median and quartiles over the starts)")
    axes.set_ylabel("distance to the goal [spreads]" if traces.goal is not None else "distance to the end [spreads]")
    axes.set_title("Closed loops on the identified model", loc="left")
    axes.legend(loc="upper right", ncols=2, fontsize=7)


def _draw_value(axes: Axes, value: ValueCheck, traces: Traces) -> None:
    """V against measured returns."""
    axes.set_title("V of the last episodes", loc="left")
    predicted, measured = traces.value
    if not value.n:
        axes.text(0.5, 0.5, "no episode is long enough\nfor a measured return", ha="center", va="center")
        axes.set_axis_off()
        return
    step = max(1, len(measured) // _POINTS)
    both = np.concatenate([predicted, measured])
    line = [both.min(), both.max()]
    axes.plot(line, line, color="#767676", linewidth=0.8, zorder=2)
    axes.plot(
        measured[::step], predicted[::step], ".", color=STYLES["MPC_3"].color, markersize=2.5, alpha=0.5, zorder=3
    )
    axes.annotate(
        "V = return", (line[1], line[1]), (-4, -2), textcoords="offset points", ha="right", va="top", fontsize=7
    )
    axes.set_xlabel("measured discounted return (cost)")
    axes.set_ylabel("V")


def _draw_fit(axes: Axes, fit: tuple[RegionError, ...]) -> None:
    """The error of (FIT) before and after, by region."""
    names = [part.name.replace("V ", "").replace(" quarter", "") for part in fit]
    places, width = np.arange(len(names)), 0.38
    for offset, label, values, color in (
        (-0.5, "MPC$_{1}$", [part.before for part in fit], STYLES["MPC_1"].color),
        (0.5, "learned", [part.after for part in fit], STYLES["MPC_3"].color),
    ):
        axes.bar(places + offset * width, np.maximum(values, 1e-12), 0.92 * width, color=color, label=label)
    axes.set_yscale("log")
    axes.set_xticks(places, names)
    axes.tick_params(axis="x", length=0)
    axes.grid(visible=False, axis="x")
    axes.set_xlabel("all data, and by quarters of V")
    axes.set_ylabel("mean square / variance of the cost")
    axes.set_title("Error of (FIT)", loc="left")
    axes.legend(loc="upper left", ncols=2, fontsize=7)
    axes.set_ylim(top=10.0 * max(max(part.before, part.after) for part in fit))
