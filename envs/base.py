"""What the tasks share: float64 physics behind a float32 observation, cost in ``info``, checked input."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

Array = NDArray[np.float64]
Observation = NDArray[np.float32]


def rk4(derivative: Callable[[Array, Array], Array], state: Array, action: Array, dt: float) -> Array:
    """One classical Runge-Kutta step with the action held (zero-order hold).

    Args:
        derivative: Right-hand side ``(state, action) -> d state / dt``, on arrays ``(..., nx)``, ``(..., nu)``.
        state: Start of the step, ``(..., nx)``.
        action: Held input, ``(..., nu)``.
        dt: Length of the step in s.

    Returns:
        The state one step later, ``(..., nx)``.
    """
    k1 = derivative(state, action)
    k2 = derivative(state + 0.5 * dt * k1, action)
    k3 = derivative(state + 0.5 * dt * k2, action)
    k4 = derivative(state + dt * k3, action)
    return state + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def wrap_angle(angle: Array) -> Array:
    """The angle in rad, wrapped to (-pi, pi]."""
    wrapped = np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    # Rounding in mod can return exactly 2 pi for a tiny negative argument.
    return np.where(wrapped <= -np.pi, np.pi, wrapped)


class ControlTask(gym.Env[NDArray[Any], NDArray[Any]]):
    """A deterministic control task with state s, observation y(s) and stage cost L(s, a); reward = -L.

    A task states its plant and its cost as four functions of arrays with any leading dimensions
    (:meth:`next_state`, :meth:`cost`, :meth:`observe`, :meth:`is_success`) and how an episode starts
    (:meth:`sample_state`); this class turns them into a Gymnasium environment.

    The simulation runs in float64. Every ``info`` carries ``"cost"`` (the cost L(s_k, a_k) of the step just taken as
    float64; 0 at reset), ``"state"`` (the state s reached, float64) and ``"is_success"``. A task never
    terminates: the time limit truncates it, so that a learner bootstraps from the last observation.

    ``reset(options=...)`` knows ``{"state": s}`` (start there) and ``{"start": name}`` with a name out of
    :attr:`starts`.

    Attributes:
        dt: Sampling time in s.
        state_space: States that ``reset`` accepts.
        starts: Names of the initial-state distributions, the default first.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 -- declared so by gymnasium.Env
    dt: ClassVar[float]
    starts: ClassVar[tuple[str, ...]] = ("broad",)

    action_space: spaces.Box
    observation_space: spaces.Box
    state_space: spaces.Box
    _state: Array | None = None

    @abstractmethod
    def next_state(self, state: Array, action: Array) -> Array:
        """The plant: s+ for s ``(..., nx)`` and a ``(..., nu)`` within bounds."""

    @abstractmethod
    def cost(self, state: Array, action: Array) -> Array:
        """The stage cost L(s, a) >= 0, ``(...)``."""

    @abstractmethod
    def observe(self, state: Array) -> Observation:
        """The observation y(s), ``(..., ny)`` float32; smooth where s wraps."""

    @abstractmethod
    def is_success(self, state: Array) -> NDArray[np.bool_]:
        """Whether the state counts as success at the end of an episode, ``(...)``."""

    @abstractmethod
    def sample_state(self, start: str) -> Array:
        """Draws an initial state ``(nx,)`` of the named distribution from ``self.np_random``."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seeds the environment's random numbers.
            options: ``{"state": s}`` or ``{"start": name}``; see the class.

        Returns:
            The first observation and its info.

        Raises:
            ValueError: For an unknown option, or a state of the wrong shape, not finite or out of range.
        """
        super().reset(seed=seed)
        self._state = self.initial_state(options or {})
        return self.observe(self._state), self._info(self._state, 0.0)

    def step(self, action: NDArray[Any]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Applies an action for one sampling time; an action beyond the bounds is clipped to them.

        Raises:
            ValueError: For an action of the wrong shape or not finite.
            gymnasium.error.ResetNeeded: Before the first ``reset``.
        """
        if self._state is None:
            raise gym.error.ResetNeeded("step: expected a reset environment, call reset() first.")
        applied = self.checked_action(action, self.action_space.shape)
        cost = float(self.cost(self._state, applied))
        self._state = self.next_state(self._state, applied)
        return self.observe(self._state), -cost, False, False, self._info(self._state, cost)

    def _info(self, state: Array, cost: float) -> dict[str, Any]:
        return {"cost": cost, "state": state.copy(), "is_success": bool(self.is_success(state))}

    def checked_action(self, action: NDArray[Any], shape: tuple[int, ...]) -> Array:
        """The action in float64, clipped to the bounds; refused when of another shape or not finite."""
        array = np.asarray(action, dtype=np.float64)
        if array.shape != shape:
            raise ValueError(f"action: expected shape {shape}, got {array.shape}.")
        if not np.isfinite(array).all():
            raise ValueError(f"action: expected finite numbers, got {array}.")
        space = self.action_space
        return np.clip(array, space.low.astype(np.float64), space.high.astype(np.float64))

    def initial_state(self, options: dict[str, Any]) -> Array:
        """The state ``(nx,)`` that ``reset(options=...)`` starts from."""
        unknown = set(options) - {"state", "start"}
        if unknown or len(options) > 1:
            raise ValueError(
                f"reset options: expected at most one of 'state' and 'start', got {sorted(map(str, options))}."
            )
        if "state" in options:
            return self._checked_state(options["state"])
        start = options.get("start", self.starts[0])
        if start not in self.starts:
            raise ValueError(f"reset option 'start': expected one of {self.starts}, got {start!r}.")
        return self.sample_state(start)

    def _checked_state(self, state: object) -> Array:
        space = self.state_space
        array = np.array(state, dtype=np.float64)
        if array.shape != space.shape:
            raise ValueError(f"reset option 'state': expected shape {space.shape}, got {array.shape}.")
        if not (np.isfinite(array).all() and (array >= space.low).all() and (array <= space.high).all()):
            raise ValueError(
                f"reset option 'state': expected finite values from {space.low} to {space.high}, got {array}."
            )
        return array


def float32_box(low: list[float] | Array, high: list[float] | Array) -> spaces.Box:
    """A float32 Box with per-coordinate bounds."""
    lower, upper = np.asarray(low, dtype=np.float32), np.asarray(high, dtype=np.float32)
    return spaces.Box(lower, upper, dtype=np.float32)


def float64_box(high: list[float] | Array) -> spaces.Box:
    """A symmetric float64 Box."""
    upper = np.asarray(high, dtype=np.float64)
    return spaces.Box(-upper, upper, dtype=np.float64)
