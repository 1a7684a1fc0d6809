"""What the coordinates of a task are called, and the plane in which functions of its state are drawn."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.envs import PLANTS, ControlTask, Plant, State, find_plant

#: Horizontal coordinate, vertical coordinate and values on a grid, each ``(n, n)``.
Landscape = tuple[Array, Array, Array]
#: The horizontal and the vertical one.
Plane = tuple[State, State]


def task_of(env: gym.Env[Any, Any] | str) -> tuple[ControlTask, Plant]:
    """A task and its plant, which has the labels.

    Args:
        env: An environment made by ``gym.make``, or its id.

    Raises:
        InvalidArgumentError: For an environment of no registered plant.
    """
    made: gym.Env[Any, Any] = gym.make(env) if isinstance(env, str) else env
    name = made.spec.id if made.spec is not None else ""
    task, plant = made.unwrapped, find_plant(name)
    if not isinstance(task, ControlTask) or plant is None:
        known = ", ".join(known.id for known in PLANTS.values())
        raise InvalidArgumentError("env", expected=f"one of {known}", actual=name or str(env))
    return task, plant


def plane_of(plant: Plant) -> Plane:
    """The two states of a plant's plane."""
    horizontal, vertical = (plant.state(name) for name in plant.plane)
    return horizontal, vertical


def on_plane(task: ControlTask, plane: Plane, function: Callable[[Array], Array], n: int = 161) -> Landscape:
    """A function of the observation on a grid of the task's plane; the other coordinates are zero, their target.

    Args:
        task: The task.
        plane: Two of its states.
        function: From observations ``(m, ny)`` to values ``(m,)``.
        n: Points along each axis.

    Returns:
        Horizontal coordinate, vertical coordinate and values, each ``(n, n)``.
    """
    horizontal, vertical = np.meshgrid(*(np.linspace(*coordinate.span, n) for coordinate in plane))
    states = np.zeros((n * n, *task.state_space.shape))
    for coordinate, values in zip(plane, (horizontal, vertical), strict=True):
        states[:, coordinate.index] = values.ravel()
    values = function(np.asarray(task.observe(states), dtype=np.float64))
    return horizontal, vertical, np.asarray(values, dtype=np.float64).reshape(n, n)


def unwrapped(angle: Array) -> Array:
    """The angle ``(T,)`` without jumps, starting in [0, 2 pi)."""
    curve = np.unwrap(angle)
    return np.asarray(curve - 2 * np.pi * np.floor(curve[0] / (2 * np.pi)))


def in_pi(k: int) -> str:
    """The label of the angle k pi."""
    if k == 0:
        return "0"
    return f"${'-' if k < 0 else ''}{'' if abs(k) == 1 else abs(k)}\\pi$"
