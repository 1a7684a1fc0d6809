"""Closed loops over time: the states and inputs of several controllers from one start, with the bounds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from mpcoffline.plants import PlantEnv

from .described import quantities_of
from .panels import task_of
from .signals import draw_signal, signals_of
from .style import PAGE_WIDTH, legend_handles, new_figure, paper_style, time_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mpcoffline.control.evaluation import Evaluation

_PANEL_HEIGHT, _LEGEND_HEIGHT = 1.15, 0.55


def loop_figure(loops: Mapping[str, Evaluation], env: gym.Env[Any, Any] | str, episode: int = 0) -> Figure:
    """Draws one episode of several controllers: states with their targets, inputs with their bounds.

    Of a described plant also set-points, limits and disturbances, by their names and units.

    Args:
        loops: What :func:`mpcoffline.evaluate` found, by controller, e.g. ``{"MPC_1": ..., "MPC_3": ...}``.
        env: The environment or its id: one of this package's tasks, or ``plant.env()`` of a described plant.
        episode: Which of the episodes.

    Returns:
        The figure; :func:`save_figure` writes it.

    Raises:
        InvalidArgumentError: For any other environment, or an episode that there is none of.
    """
    made: gym.Env[Any, Any] = gym.make(env) if isinstance(env, str) else env
    states = {name: loop.states[episode] for name, loop in loops.items()}
    if isinstance(made.unwrapped, PlantEnv):
        own = made.unwrapped.plant
        signals, dt, seconds = quantities_of(own, loops, episode), own.dt, None
    else:
        task, plant = task_of(made)
        actions = {name: loop.actions[episode] for name, loop in loops.items()}
        signals, dt, seconds = signals_of(plant, states, actions), task.dt, plant.seconds
    known = [*(["set-point, disturbance"] if any(s.course is not None for s in signals) else [])]
    known += ["limit"] if any(s.limits for s in signals) else []
    length = dt * max(len(s) - 1 for s in states.values())
    unit, name = time_unit(length)
    with paper_style():
        figure = new_figure(0.75 * PAGE_WIDTH, _LEGEND_HEIGHT + _PANEL_HEIGHT * len(signals))
        panels = np.atleast_1d(figure.subplots(len(signals), 1, sharex=True))
        for axes, signal in zip(panels, signals, strict=True):
            draw_signal(axes, signal, dt / unit)
        figure.align_ylabels()
        panels[-1].set_xlabel(f"time ({name})")
        panels[-1].set_xlim(0.0, min(length, seconds or length) / unit)
        handles, names = legend_handles([*loops, *known])
        figure.legend(handles, names, loc="outside upper center", ncols=len(names), handlelength=3.2)
    return figure
