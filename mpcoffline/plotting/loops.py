"""Closed loops over time: the states and inputs of several controllers from one start, with the bounds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from .panels import task_of
from .signals import draw_signal, signals_of
from .style import PAGE_WIDTH, legend_handles, new_figure, paper_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mpcoffline.control.evaluation import Evaluation

_PANEL_HEIGHT, _LEGEND_HEIGHT = 1.15, 0.55


def loop_figure(loops: Mapping[str, Evaluation], env: gym.Env[Any, Any] | str, episode: int = 0) -> Figure:
    """Draws one episode of several controllers: states with their targets, inputs with their bounds.

    Args:
        loops: What :func:`mpcoffline.evaluate` found, by controller, e.g. ``{"MPC_1": ..., "MPC_3": ...}``.
        env: The environment or its id.
        episode: Which of the episodes.

    Returns:
        The figure; :func:`save_figure` writes it.

    Raises:
        InvalidArgumentError: For an environment that is none of this package's tasks.
    """
    task, plant = task_of(env)
    states = {name: loop.states[episode] for name, loop in loops.items()}
    actions = {name: loop.actions[episode] for name, loop in loops.items()}
    signals = signals_of(plant, states, actions)
    with paper_style():
        figure = new_figure(0.75 * PAGE_WIDTH, _LEGEND_HEIGHT + _PANEL_HEIGHT * len(signals))
        panels = np.atleast_1d(figure.subplots(len(signals), 1, sharex=True))
        for axes, signal in zip(panels, signals, strict=True):
            draw_signal(axes, signal, task.dt)
        figure.align_ylabels()
        panels[-1].set_xlabel("time (s)")
        length = task.dt * max(len(s) - 1 for s in states.values())
        panels[-1].set_xlim(0.0, min(length, plant.seconds or length))
        handles, names = legend_handles(list(loops))
        figure.legend(handles, names, loc="outside upper center", ncols=len(names), handlelength=3.2)
    return figure
