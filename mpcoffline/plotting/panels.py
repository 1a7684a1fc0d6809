"""What the coordinates of a task are called, and the plane in which functions of its state are drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.envs import ControlTask

#: Horizontal coordinate, vertical coordinate and values on a grid, each ``(n, n)``.
Landscape = tuple[Array, Array, Array]


@dataclass(frozen=True)
class Coordinate:
    """One entry of a task's state.

    Attributes:
        label: Name and unit.
        index: Its place in the state.
        angle: Whether it is an angle in rad that wraps.
        band: Half-width around zero that counts as success; None where it does not matter.
        span: What is drawn of it in a plane.
    """

    label: str
    index: int
    angle: bool = False
    band: float | None = None
    span: tuple[float, float] = (-1.0, 1.0)


@dataclass(frozen=True)
class TaskLabels:
    """How a task's quantities are called in figures.

    Attributes:
        states: The coordinates that are drawn over time.
        actions: Names and units of the inputs.
        observations: Names of the observation's entries.
        plane: The two coordinates of phase portraits and level sets.
        seconds: What is shown of an episode whose end is dull; None for all.
    """

    states: tuple[Coordinate, ...]
    actions: tuple[str, ...]
    observations: tuple[str, ...]
    plane: tuple[Coordinate, Coordinate]
    seconds: float | None = None


# Hanging is in the middle, so that a swing-up starts there and no curve leaves on one side to come back on the other.
_TURN = (-0.9, 2.0 * np.pi + 0.9)
_ANGLE, _SPEED = "angle $\\varphi$ (rad)", "speed $\\dot\\varphi$ (rad/s)"

TASKS: dict[str, TaskLabels] = {
    "mpcoffline/LinearTracking-v0": TaskLabels(
        states=(Coordinate("$x$ (m)", 0, band=0.05), Coordinate("$y$ (m)", 1, band=0.05)),
        actions=("force $F_x$ (N)", "force $F_y$ (N)"),
        observations=("$x$", "$y$", "$\\dot x$", "$\\dot y$"),
        plane=(Coordinate("$x$ (m)", 0, span=(-1.3, 1.3)), Coordinate("$\\dot x$ (m/s)", 2, span=(-3.0, 3.0))),
        seconds=5.0,
    ),
    "mpcoffline/PendulumSwingUp-v0": TaskLabels(
        states=(Coordinate(_ANGLE, 0, angle=True, band=0.3), Coordinate(_SPEED, 1)),
        actions=("torque $u$ (N m)",),
        observations=("$\\cos\\varphi$", "$\\sin\\varphi$", "$\\dot\\varphi$"),
        plane=(Coordinate(_ANGLE, 0, angle=True, span=_TURN), Coordinate(_SPEED, 1, span=(-9.0, 9.0))),
    ),
    "mpcoffline/CartPoleSwingUp-v0": TaskLabels(
        states=(Coordinate(_ANGLE, 2, angle=True, band=0.3), Coordinate("position $x$ (m)", 0)),
        actions=("force $u$ (N)",),
        observations=("$x$", "$\\dot x$", "$\\cos\\varphi$", "$\\sin\\varphi$", "$\\dot\\varphi$"),
        plane=(Coordinate(_ANGLE, 2, angle=True, span=_TURN), Coordinate(_SPEED, 3, span=(-12.0, 12.0))),
    ),
}


def task_of(env: gym.Env[Any, Any] | str) -> tuple[ControlTask, TaskLabels]:
    """A task and how it is labelled.

    Args:
        env: An environment made by ``gym.make``, or its id.

    Raises:
        InvalidArgumentError: For an environment that is none of this package's tasks.
    """
    made: gym.Env[Any, Any] = gym.make(env) if isinstance(env, str) else env
    name = made.spec.id if made.spec is not None else ""
    task = made.unwrapped
    if not isinstance(task, ControlTask) or name not in TASKS:
        raise InvalidArgumentError("env", expected=f"one of {', '.join(TASKS)}", actual=name or str(env))
    return task, TASKS[name]


def on_plane(task: ControlTask, labels: TaskLabels, function: Callable[[Array], Array], n: int = 161) -> Landscape:
    """A function of the observation on a grid of the task's plane; the other coordinates are zero, their target.

    Args:
        task: The task.
        labels: Its labels.
        function: From observations ``(m, ny)`` to values ``(m,)``.
        n: Points along each axis.

    Returns:
        Horizontal coordinate, vertical coordinate and values, each ``(n, n)``.
    """
    horizontal, vertical = np.meshgrid(*(np.linspace(*coordinate.span, n) for coordinate in labels.plane))
    states = np.zeros((n * n, *task.state_space.shape))
    for coordinate, values in zip(labels.plane, (horizontal, vertical), strict=True):
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
