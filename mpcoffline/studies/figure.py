"""The figure of the main job: closed loops from one start, and the cost of each controller."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.envs import PLANTS
from mpcoffline.plotting import (
    PAGE_WIDTH,
    draw_bars,
    draw_signal,
    legend_handles,
    new_figure,
    paper_style,
)
from mpcoffline.plotting.signals import signals_of

from .results import REFERENCE, TaskResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = ("MPC_1", "MPC_2", "MPC_3")


def main_job_figure(result: TaskResult) -> Figure:
    """Closed loops of MPC_1, MPC_2, MPC_3 from one start with the input bounds, and their costs as bars.

    Args:
        result: What :func:`run_task` found.

    Returns:
        The figure; :func:`mpcoffline.plotting.save_figure` writes it.
    """
    plant = PLANTS[result.task]
    states, actions = ({name: _example(result, name)[i] for name in SHOWN} for i in (0, 1))
    signals = signals_of(plant, states, actions)
    with paper_style():
        figure = new_figure(PAGE_WIDTH, 0.6 + 2.85 * max(1.0, 0.3 * len(signals)))
        left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(2.1, 1.0)))
        panels = np.atleast_1d(left.subplots(len(signals), 1, sharex=True))
        for axes, signal in zip(panels, signals, strict=True):
            draw_signal(axes, signal, result.dt)
        left.align_ylabels()
        panels[-1].set_xlabel("time (s)")
        length = result.dt * (len(signals[0].values[SHOWN[0]]) - 1)
        panels[-1].set_xlim(0.0, min(length, plant.seconds or length))
        handles, labels = legend_handles(SHOWN)
        left.legend(handles, labels, loc="outside upper center", ncols=3, handlelength=3.2)
        bars = right.subplots()
        draw_bars(bars, _relative_costs(result))
        bars.set_ylabel("cost relative to the reference")
        _explain_bars(right)
    return figure


def _example(result: TaskResult, name: str) -> tuple[Array, Array]:
    controller = result.controller(name)
    return np.array(controller.states, dtype=np.float64), np.array(controller.actions, dtype=np.float64)


def _relative_costs(result: TaskResult) -> dict[str, dict[str, float]]:
    reference = result.controller(REFERENCE)
    return {
        name: {
            "J": result.controller(name).cost / reference.cost,
            "Jd": result.controller(name).discounted_cost / reference.discounted_cost,
        }
        for name in SHOWN
    }


def _explain_bars(figure: Figure) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Patch(facecolor="#606060", edgecolor="#606060"),
        Patch(facecolor="white", edgecolor="#606060", hatch="////"),
        Line2D([], [], color="black", linewidth=0.8, linestyle=(0, (1, 1.2))),
    ]
    labels = ["$J$", "$J_d$", "reference"]
    figure.legend(handles, labels, loc="outside upper center", ncols=3, handlelength=1.6, columnspacing=1.0)
