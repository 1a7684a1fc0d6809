"""What the tasks share: float64 physics behind a float32 observation, noise, cost in ``info``, checked input."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from .arguments import (
    Array,
    Start,
    checked_deviations,
    checked_matrix,
    checked_number,
    checked_render_mode,
    checked_start,
    checked_state,
)
from .plant import Plant
from .rendering import Canvas, Frame, Moment, Viewer

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
    r"""A control task with state s, observation y(s) and stage cost L(s, a); reward = -L.

    A task states its plant, a :class:`Plant`, and what it looks like (:meth:`draw`); this class turns them into a
    Gymnasium environment, whose arguments are the plant's parameters and those below. Its functions take arrays with
    any leading dimensions. :func:`register` makes it known.

    The simulation runs in float64. Every ``info`` carries ``"cost"`` (the cost L(s_k, a_k) of the step just taken as
    float64; 0 at reset), ``"state"`` (the state s reached, float64) and ``"is_success"``. A task never
    terminates: the time limit truncates it, so that a learner bootstraps from the last observation. A state that would
    leave ``state_limit`` (no episode of 100 steps of the default plant does) stays at the limit, so that
    observations keep their bounds in episodes of any length.

    **Noise**, both Gaussian, independent between steps and coordinates, off by default::

        s+ = f(s, a) + w     w ~ N(0, diag(process_noise^2))         one draw a step, in the units of s
        y  = h(s + v)        v ~ N(0, diag(measurement_noise^2))     also at reset; s itself stays as it is

    Process noise moves the plant: ``info["state"]`` and later costs contain it. Measurement noise is in the observation
    only: ``info["state"]`` and ``info["cost"]`` stay true. It is added to the state's coordinates and not to those of
    y: what a sensor reads is the angle, in rad, and (cos phi, sin phi) of a noisy angle is still a point on the unit
    circle, where models of y hold and within the observation bounds. Noise has a stream of random numbers of its own,
    spawned from ``np_random`` by ``reset(seed=...)``: the same seed gives the same starts with and without noise.

    ``reset(options=...)`` knows ``{"state": s}`` (start there), ``{"start": name}`` with a name out of
    ``starts``, and ``{"low": l, "high": h}`` (uniform between them; scalars or ``(nx,)``; an angle's bounds may
    reach to 2 pi, the draw is wrapped).

    Args:
        start: Distribution of initial states when ``reset`` is not told otherwise: a name out of ``starts``
            (the first by default) or bounds ``(low, high)`` as above.
        process_noise: Standard deviation of w, a scalar or one a coordinate of s.
        measurement_noise: Standard deviation of v, a scalar or one a coordinate of s.
        render_mode: None, ``"human"`` (a window, redrawn in each step) or ``"rgb_array"`` (``render`` returns a
            picture).
        **parameters: Parameters of the plant, which are attributes afterwards.

    Raises:
        ValueError: For an argument out of its range, of a wrong shape or not finite.
        TypeError: For a parameter that the plant does not have.

    Attributes:
        plant: What the task is about.
        dt: Sampling time in s.
        state_space: States that ``reset`` accepts.
        state_limit: Largest absolute values of the state in the simulation, ``(nx,)``; infinite for an angle.
        starts: Names of the initial-state distributions, the default first.
        angle: The coordinate of s that wraps, None without one.
        picture_size: Width and height of a picture in pixels.
        trail_steps: Steps that the trail in a picture goes back.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012 -- gymnasium's
    plant: ClassVar[Plant]
    dt: ClassVar[float]
    starts: ClassVar[tuple[str, ...]]
    angle: ClassVar[int | None]
    picture_size: ClassVar[tuple[int, int]] = (600, 600)
    trail_steps: ClassVar[int] = 30
    __signature__: ClassVar[inspect.Signature]

    action_space: spaces.Box
    observation_space: spaces.Box
    state_space: spaces.Box
    state_limit: Array
    _state: Array | None = None
    _noise_generator: np.random.Generator | None = None

    def __init_subclass__(cls) -> None:
        plant: Plant | None = getattr(cls, "plant", None)
        if plant is None:
            return
        cls.dt, cls.starts, cls.angle = plant.dt, tuple(plant.starts), plant.angle
        cls.metadata = cls.metadata | {"render_fps": round(1.0 / plant.dt)}
        # What help() and documentation show: the parameters by name, then what every task takes.
        common = list(inspect.signature(ControlTask.__init__).parameters.values())[1:-1]
        own = list(inspect.signature(cls.__init__).parameters.values())[1:-1]
        if cls.__init__ is ControlTask.__init__:
            kind = inspect.Parameter.KEYWORD_ONLY
            own = [inspect.Parameter(p.name, kind, default=p.value) for p in plant.parameters]
        cls.__signature__ = inspect.Signature([*own, *common])

    def __init__(
        self,
        *,
        start: Start | None = None,
        process_noise: ArrayLike = 0.0,
        measurement_noise: ArrayLike = 0.0,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        self._set_parameters(parameters)
        plant, nx = self.plant, len(self.plant.states)
        self.state_limit = np.array([np.inf if c.angle else c.limit for c in plant.states])
        pairs = ([1.0, 1.0] if c.angle else [c.limit] for c in plant.states)
        bound = np.array([limit for pair in pairs for limit in pair])
        self.action_space = float32_box([c.low for c in plant.inputs], [c.high for c in plant.inputs])
        self.observation_space = float32_box(-bound, bound)
        self.state_space = float64_box(self.start_bound())
        self.start: str | tuple[Array, Array] = self._checked_start("start", self.starts[0] if start is None else start)
        self.process_noise: Array = checked_deviations("process_noise", process_noise, nx)
        self.measurement_noise: Array = checked_deviations("measurement_noise", measurement_noise, nx)
        self.render_mode: str | None = checked_render_mode(render_mode, self.metadata["render_modes"])
        self._viewer = None if render_mode is None else self.new_viewer(render_mode)

    def _set_parameters(self, given: dict[str, Any]) -> None:
        known = {p.name: p for p in self.plant.parameters}
        for name in given:
            if name not in known:
                raise TypeError(f"{type(self).__name__}.__init__() got an unexpected keyword argument {name!r}")
        # Those whose limit depends on the others come last.
        for name, p in sorted(known.items(), key=lambda item: callable(item[1].high)):
            value, shape = given.get(name, p.value), np.shape(p.value)
            if shape:
                setattr(self, name, checked_matrix(name, value, shape))
            else:
                high = p.high(vars(self)) if callable(p.high) else p.high
                setattr(self, name, checked_number(name, value, p.low, high, p.unit))

    @property
    def parameters(self) -> dict[str, Any]:
        """The plant's parameters by name."""
        return {p.name: getattr(self, p.name) for p in self.plant.parameters}

    def start_bound(self) -> Array:
        """The largest absolute values of a state that ``reset`` accepts, ``(nx,)``."""
        return np.array([c.largest_start for c in self.plant.states])

    def derivative(self, state: Array, action: Array) -> Array:
        """The equations of motion: ds/dt, ``(..., nx)``; the next state itself where the plant is discrete."""
        return self._rates(state, _entries(action), self.parameters)

    def _rates(self, state: Array, inputs: list[Any], parameters: dict[str, Any]) -> Array:
        y = _entries(state)
        if self.angle is not None:
            y = self.plant.lift(y, *((_cos, _sin) if state.ndim == 1 else (np.cos, np.sin)))
        return _joined(self.plant.dynamics(y, inputs, parameters))

    def next_state(self, state: Array, action: Array) -> Array:
        """The plant without noise: f(s, a) for s ``(..., nx)`` and a ``(..., nu)`` within bounds."""
        inputs, parameters = _entries(action), self.parameters
        if self.plant.discrete:
            return self.confined(self._rates(state, inputs, parameters))
        return self.confined(rk4(lambda s, _: self._rates(s, inputs, parameters), state, action, self.dt))

    def cost(self, state: Array, action: Array) -> Array:
        """The stage cost L(s, a) >= 0, ``(...)``."""
        cost = np.asarray(self.plant.cost(_entries(state), _entries(action)))
        return cost if state.ndim == 1 else cost[..., 0]

    def observe(self, state: Array) -> Observation:
        """The observation h(s) without noise, ``(..., ny)`` float32; smooth where s wraps."""
        y = state if self.angle is None else _joined(self.plant.lift(_entries(state), np.cos, np.sin))
        return y.astype(np.float32)

    def is_success(self, state: Array) -> NDArray[np.bool_]:
        """Whether the state counts as success at the end of an episode, ``(...)``."""
        if self.plant.success is not None:
            return np.asarray(self.plant.success(state))
        within = [np.abs(state[..., c.index]) < c.band for c in self.plant.states if c.band is not None]
        return np.asarray(np.logical_and.reduce(within))

    def sample_state(self, start: str) -> Array:
        """Draws an initial state ``(nx,)`` of the named distribution from ``self.np_random``."""
        state = self.plant.starts[start](self.np_random)
        if self.angle is not None and not -np.pi < state[self.angle] <= np.pi:
            state[self.angle] = wrap_angle(state[self.angle])
        return state

    @abstractmethod
    def draw(self, canvas: Canvas, moment: Moment) -> None:
        """Draws the plant, its reference, the action and the trail."""

    @property
    def noisy(self) -> bool:
        """Whether there is process or measurement noise."""
        return bool(self.process_noise.any() or self.measurement_noise.any())

    def confined(self, state: Array) -> Array:
        """The state ``(..., nx)`` within ``state_limit``, its angle wrapped to (-pi, pi]."""
        inside = np.minimum(np.maximum(state, -self.state_limit), self.state_limit)
        if self.angle is not None:
            inside[..., self.angle] = wrap_angle(inside[..., self.angle])
        return inside

    def disturbed(self, state: Array, normal: Array) -> Array:
        """The state with process noise from standard normal numbers, both ``(..., nx)``."""
        return self.confined(state + self.process_noise * normal)

    def measured(self, state: Array, normal: Array) -> Observation:
        """The observation with measurement noise from standard normal numbers ``(..., nx)``."""
        return self.observe(self.confined(state + self.measurement_noise * normal))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Seeds the environment's random numbers.
            options: ``{"state": s}``, ``{"start": name}`` or ``{"low": l, "high": h}``; see the class.

        Returns:
            The first observation and its info.

        Raises:
            ValueError: For an unknown option, or a state or bound of the wrong shape, not finite or out of range.
        """
        super().reset(seed=seed)
        if seed is not None:
            self._noise_generator = None
        self._state = self.initial_state(options or {})
        observation = self.measured(self._state, self._normals()[1]) if self.noisy else self.observe(self._state)
        if self._viewer is not None:
            self._viewer.begin(self._state)
        self._show()
        return observation, self._info(self._state, 0.0)

    def step(self, action: NDArray[Any]) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
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
        if self.noisy:
            process, measurement = self._normals()
            self._state = self.disturbed(self._state, process)
            observation = self.measured(self._state, measurement)
        else:
            observation = self.observe(self._state)
        if self._viewer is not None:
            self._viewer.add(self._state, applied, cost)
        self._show()
        return observation, -cost, False, False, self._info(self._state, cost)

    def render(self) -> Frame | None:
        """The picture ``(height, width, 3)`` uint8 with ``render_mode="rgb_array"``; None otherwise.

        Raises:
            gymnasium.error.ResetNeeded: Before the first ``reset``.
            gymnasium.error.DependencyNotInstalled: Without pygame.
        """
        if self._viewer is None:
            gym.logger.warn(
                "render: expected an environment made with a render_mode, which this one was not: nothing is drawn. "
                f"Make it with one of {self.metadata['render_modes']}, e.g. gym.make(..., render_mode='rgb_array')."
            )
            return None
        if self._state is None:
            raise gym.error.ResetNeeded("render: expected a reset environment, call reset() first.")
        return self._viewer.render()

    def close(self) -> None:
        """Closes the window, if there is one; can be repeated."""
        if self._viewer is not None:
            self._viewer.close()

    def new_viewer(self, render_mode: str) -> Viewer:
        """What draws this task's episodes."""
        return Viewer(self.draw, self.picture_size, self.trail_steps, self.dt, render_mode)

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
        given = set(options)
        if given == {"state"}:
            return checked_state("reset option 'state'", options["state"], self.state_space)
        if given == {"low", "high"}:
            start = self._checked_start("reset options 'low', 'high'", (options["low"], options["high"]))
        elif given == {"start"}:
            start = self._checked_start("reset option 'start'", options["start"])
        elif not given:
            start = self.start
        else:
            raise ValueError(
                "reset options: expected at most one of 'low' with 'high', 'state' and 'start', "
                f"got {sorted(map(str, options))}."
            )
        if isinstance(start, str):
            return self.sample_state(start)
        return self.confined(self.np_random.uniform(*start))

    def _checked_start(self, name: str, start: Start) -> str | tuple[Array, Array]:
        return checked_start(name, start, self.starts, self.state_space, self.angle)

    def _normals(self) -> Array:
        """Standard normal numbers of one observation: those of w and of v, ``(2, nx)``."""
        if self._noise_generator is None:
            self._noise_generator = self.np_random.spawn(1)[0]
        return self._noise_generator.standard_normal((2, len(self.process_noise)))

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def _info(self, state: Array, cost: float) -> dict[str, Any]:
        return {"cost": cost, "state": state.copy(), "is_success": bool(self.is_success(state))}


def _entries(array: Array) -> list[Any]:
    """The columns of ``array (..., n)``, each ``(..., 1)``; of one state floats, whose arithmetic is faster."""
    return array.tolist() if array.ndim == 1 else [array[..., i : i + 1] for i in range(array.shape[-1])]


def _joined(entries: Sequence[Any]) -> Array:
    """The inverse of :func:`_entries`; a plant may have joined some itself."""
    if isinstance(entries[0], float):
        return np.array(entries)
    return entries[0] if len(entries) == 1 else np.concatenate(entries, axis=-1)


def _cos(angle: float) -> float:
    return float(np.cos(angle))  # the C library's may round in another way


def _sin(angle: float) -> float:
    return float(np.sin(angle))


def float32_box(low: list[float] | Array, high: list[float] | Array) -> spaces.Box:
    """A float32 Box with per-coordinate bounds."""
    lower, upper = np.asarray(low, dtype=np.float32), np.asarray(high, dtype=np.float32)
    return spaces.Box(lower, upper, dtype=np.float32)


def float64_box(high: list[float] | Array) -> spaces.Box:
    """A symmetric float64 Box."""
    upper = np.asarray(high, dtype=np.float64)
    return spaces.Box(-upper, upper, dtype=np.float64)
