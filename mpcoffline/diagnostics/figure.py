"""The figure of a report."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.text import figure as written
from mpcoffline.core.types import Array
from mpcoffline.plotting import PAGE_WIDTH, STYLES, controller_label, new_figure, paper_style
from mpcoffline.simulation.trials import Trials

from .differences import SURE, TODAY, Difference, candidates, outvoted, whole_episodes
from .measures import RegionError, ValueCheck
from .verdict import Judgement, costs_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
_HEIGHT = 6.9
_POINTS = 1_500
_GREY = "#767676"


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
    judgement: Judgement,
    trials: Trials,
    choice: Trials,
    value: ValueCheck,
    fit: tuple[RegionError, ...],
    traces: Traces,
) -> Figure:
    """Draws candidates, costs, models against the log, closed loops, V against returns, and the error of (FIT).

    Args:
        judgement: What the report says.
        trials: What was judged and what it was compared with.
        choice: All candidates.
        value: V_phi against measured returns.
        fit: The error of (FIT) by region.
        traces: What is not in the report's text.
    """
    with paper_style():
        figure = new_figure(PAGE_WIDTH, _HEIGHT)
        axes = figure.subplots(3, 2)
        figure.suptitle(f"Verdict: {judgement.verdict}", fontsize=10, fontweight="bold", x=0.01, ha="left")
        draw_candidates(axes[0, 0], judgement, choice)
        draw_costs(axes[0, 1], judgement, trials)
        draw_agreement(axes[1, 0], judgement, trials)
        draw_distances(axes[1, 1], traces)
        draw_value(axes[2, 0], value, traces)
        draw_fit(axes[2, 1], fit)
    return figure


def draw_candidates(axes: Axes, judgement: Judgement, trials: Trials) -> None:
    """A row a candidate: cost minus that of MPC_1, a dot for each model with a vote, a bar of two standard errors."""
    axes.set_title("Candidates, cost minus that of MPC$_{1}$", loc="left")
    rows = candidates(trials)
    if not rows:
        _say(axes, "no model of the log\npredicts well enough")
        return
    inner: list[float] = []
    for place, each in enumerate(rows):
        d = Difference.of(trials, each.name, trials.names[0])
        color = STYLES["MPC_3"].color if each.name == judgement.proposal else _GREY
        axes.plot(d.mean, np.full(len(d), place), "o", color=color, markersize=3.0, alpha=0.5, zorder=3)
        error = SURE * each.error if np.isfinite(each.error) else 0.0
        axes.errorbar(each.difference, place, xerr=error, fmt="D", color=color, markersize=4.5, capsize=3, zorder=4)
        inner += [
            each.difference - error,
            each.difference + error,
            *np.sort(d.mean)[outvoted(len(d)) : len(d) - outvoted(len(d))],
        ]
    axes.axvline(0.0, color=STYLES["MPC_1"].color, linewidth=1.0, zorder=2)
    finite = [0.0, *(v for v in inner if np.isfinite(v))]
    margin = 0.08 * (max(finite) - min(finite)) or 1.0
    axes.set_xlim(min(finite) - margin, max(finite) + margin)  # one wild model does not hide the others
    axes.set_yticks(range(len(rows)), [_name(each.name) for each in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("dots: models; bar: the median one's")


def draw_costs(axes: Axes, judgement: Judgement, trials: Trials) -> None:
    """Today, MPC_1 and the proposal: what an episode costs."""
    axes.set_title(f"Cost of an episode of {trials.n_steps} steps", loc="left")
    rows = [(name, cost) for name, cost in costs_of(judgement, trials) if np.isfinite(cost).all()]
    if not rows:
        _say(axes, "not known")
        return
    colors = {"today": "#000000", trials.names[0]: STYLES["MPC_1"].color}
    for place, (name, (low, middle, high)) in enumerate(rows):
        color = colors.get(name, STYLES["MPC_3"].color)
        axes.errorbar(
            middle, place, xerr=[[middle - low], [high - middle]], fmt="s", color=color, markersize=5, capsize=3
        )
        axes.annotate(written(middle, 4), (middle, place), (0, 6), textcoords="offset points", ha="center", fontsize=7)
    axes.set_yticks(range(len(rows)), [name if name == TODAY else _name(name) for name, _ in rows])
    axes.set_ylim(len(rows) - 0.4, -0.7)
    axes.margins(x=0.1)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("as models and log let expect")


def draw_agreement(axes: Axes, judgement: Judgement, trials: Trials) -> None:
    """Each start: what the log cost from there, and its controller's clone on the models."""
    axes.set_title("Models against the log", loc="left")
    known = np.isfinite(trials.returns) & whole_episodes(trials)
    if TODAY not in trials.names or not known.any() or not trials.votes.any():
        _say(axes, "no logged episode is as long" if not known.any() else "the logged controller\nwas not simulated")
        return
    clone = trials.of(TODAY)[trials.votes][:, known]
    logged, middle = trials.returns[known], np.median(clone, axis=0)
    both = np.concatenate([logged, middle])
    line = [both.min(), both.max()]
    axes.plot(line, line, color=_GREY, linewidth=0.8, zorder=2, label="equal")
    away = np.abs(np.quantile(clone, [0.1, 0.9], axis=0) - middle)
    axes.errorbar(
        logged, middle, yerr=away, fmt="o", color=STYLES["MPC_3"].color, markersize=3, elinewidth=0.6, zorder=3
    )
    axes.legend(loc="upper left", fontsize=7)
    axes.set_xlabel("cost of an episode in the log")
    axes.set_ylabel("of its clone on the models")


def _say(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)
    axes.set_axis_off()


def _name(name: str) -> str:
    """A controller's name that fits beside an axis."""
    return "today (clone)" if name == TODAY else controller_label(textwrap.shorten(name, 26, placeholder="..."))


def draw_distances(axes: Axes, traces: Traces) -> None:
    """How far both controllers are from where they end, over the steps: median and quartiles over the starts."""
    axes.set_title("Closed loops on the identified model", loc="left")
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
    axes.legend(loc="upper right", ncols=2, fontsize=7)


def draw_value(axes: Axes, value: ValueCheck, traces: Traces) -> None:
    """V against measured returns."""
    axes.set_title("V of the last episodes", loc="left")
    predicted, measured = traces.value
    if not value.n:
        _say(axes, "no episode is long enough\nfor a measured return")
        return
    step = max(1, len(measured) // _POINTS)
    both = np.concatenate([predicted, measured])
    line = [both.min(), both.max()]
    axes.plot(line, line, color=_GREY, linewidth=0.8, zorder=2, label="V = return")
    axes.plot(
        measured[::step], predicted[::step], ".", color=STYLES["MPC_3"].color, markersize=2.5, alpha=0.5, zorder=3
    )
    axes.legend(loc="upper left", fontsize=7)
    axes.set_xlabel("measured discounted return (cost)")
    axes.set_ylabel("V")


def draw_fit(axes: Axes, fit: tuple[RegionError, ...]) -> None:
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
    axes.set_ylabel("share of the cost's variance")
    axes.set_title("Error of (FIT)", loc="left")
    axes.legend(loc="upper left", ncols=2, fontsize=7)
    axes.set_ylim(top=10.0 * max(max(part.before, part.after) for part in fit))
