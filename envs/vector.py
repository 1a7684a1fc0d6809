"""The tasks' vector twin: many copies of one task, stepped as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from .arguments import Array, checked_render_mode, floats_of
from .base import ControlTask, Observation
from .episode import EPISODE_STEPS
from .rendering import Frame

Options = dict[str, Any] | Sequence[dict[str, Any]]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]


class ControlTaskVectorEnv(VectorEnv[NDArray[np.float32], NDArray[Any], NDArray[Any]]):
    """``num_envs`` copies of a :class:`ControlTask`, each equal to the scalar environment bit for bit.

    Made by ``gym.make_vec(id, num_envs, vectorization_mode="vector_entry_point")``; takes the arguments of the scalar
    environment. Copy i has random numbers of its own, for starts and for noise, seeded with ``seed + i`` as in
    Gymnasium's own vector environments.

    ``metadata["autoreset_mode"]`` says what follows the last step of an episode, as in Gymnasium's ``SyncVectorEnv``:

    * ``NEXT_STEP`` (default): the next step ignores the action of that copy and returns the first observation of its
      next episode with reward 0.
    * ``SAME_STEP``: the last step itself returns that first observation; the episode's last observation and info are in
      ``info["final_obs"]`` and ``info["final_info"]``.
    * ``DISABLED``: the caller resets the ended copies by ``reset(options={"reset_mask": ended})``.

    Unlike there, a distribution of starts that was given to ``reset`` holds for the automatic resets too.

    Args:
        num_envs: Number of copies.
        max_episode_steps: Steps after which an episode is truncated; None or -1 for never.
        autoreset_mode: The mode or its value: ``"NextStep"``, ``"SameStep"``, ``"Disabled"``.
        render_mode: None, or ``"rgb_array"``: ``render`` returns a picture of every copy.
        **task_kwargs: Arguments of the scalar environment.

    Raises:
        ValueError: For an argument out of its range.
    """

    num_envs: int

    metadata: dict[str, Any] = {  # noqa: RUF012 -- declared so by gymnasium
        "render_modes": ["rgb_array"],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }
    task_class: ClassVar[type[ControlTask]]

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = EPISODE_STEPS,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **task_kwargs: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs: expected a positive integer, got {num_envs}.")
        self.render_mode: str | None = checked_render_mode(render_mode, self.metadata["render_modes"])
        self.task: ControlTask = self.task_class(**task_kwargs)
        self.num_envs, nx = num_envs, self.task.state_space.shape[0]
        self.max_episode_steps: float | int = np.inf if max_episode_steps in (None, -1) else max_episode_steps
        self.metadata = self.metadata | {
            "render_fps": self.task.metadata["render_fps"],
            "autoreset_mode": _checked_autoreset_mode(autoreset_mode),
        }
        self.single_observation_space: spaces.Box = self.task.observation_space
        self.single_action_space: spaces.Box = self.task.action_space
        self.observation_space: spaces.Space[Any] = batch_space(self.single_observation_space, num_envs)
        self.action_space: spaces.Space[Any] = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._noise = _NormalRows(num_envs, nx) if self.task.noisy else None
        self._starts: list[dict[str, Any]] = [{}] * num_envs
        self._state = np.zeros((num_envs, nx))
        self._observation: Observation = self.task.observe(self._state)
        self._started = False
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=bool)
        self._viewers = [self.task.new_viewer(render_mode) for _ in range(num_envs)] if render_mode else []

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Options | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode in every copy.

        Args:
            seed: Seed of the first copy, the others following, or one a copy (None: its random numbers go on).
            options: As in the scalar environment, for all copies, or a list of them, one a copy. ``{"state": s}`` takes
                ``(num_envs, nx)`` too. ``{"reset_mask": mask}``, ``(num_envs,)`` bool, resets only some copies.

        Returns:
            Observations ``(num_envs, ny)`` and infos of arrays ``(num_envs, ...)``.

        Raises:
            ValueError: For options that the scalar environment refuses, or another number of seeds, options or states.
            gymnasium.error.ResetNeeded: For a ``"reset_mask"`` before the first reset of all copies.
        """
        each, mask = self._each_options(options)
        copies = np.flatnonzero(mask)
        self._seed(seed, copies)
        self._restart(copies, each)
        for i in copies:
            self._starts[i] = {name: value for name, value in each[i].items() if name != "state"}
        self._started = True
        return self._observation.copy(), self._infos(np.zeros(self.num_envs), mask)

    def step(self, actions: NDArray[Any]) -> tuple[Observation, Array, Mask, Mask, dict[str, Any]]:
        """Applies an action ``(num_envs, nu)`` in every copy; actions beyond the bounds are clipped to them.

        Raises:
            ValueError: For actions of the wrong shape or not finite.
            gymnasium.error.ResetNeeded: Before the first ``reset``; with ``AutoresetMode.DISABLED``, while an ended
                copy has not been reset.
        """
        if not self._started:
            raise gym.error.ResetNeeded("step: expected a reset environment, call reset() first.")
        applied = self.task.checked_action(actions, (self.num_envs, *self.task.action_space.shape))
        mode, everywhere = self.metadata["autoreset_mode"], np.ones(self.num_envs, dtype=bool)
        ended = np.flatnonzero(self._ended)
        if mode == AutoresetMode.DISABLED and ended.size:
            raise gym.error.ResetNeeded(
                f"step: expected no ended episodes, got those of copies {ended}: reset them by 'reset_mask'."
            )
        cost = self._advance(applied)
        if ended.size:
            self._restart(ended, self._starts)
        self._ended = self._steps >= self.max_episode_steps
        truncated, infos = self._ended.copy(), self._infos(cost, everywhere)
        if mode == AutoresetMode.SAME_STEP and truncated.any():
            final = self._final(cost, truncated)
            self._restart(np.flatnonzero(truncated), self._starts)
            infos = self._infos(np.where(truncated, 0.0, cost), everywhere) | final
        return self._observation.copy(), -cost, np.zeros(self.num_envs, dtype=bool), truncated, infos

    def render(self) -> tuple[Frame, ...] | None:
        """Pictures ``(height, width, 3)`` uint8 of all copies; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: Before the first ``reset``.
            gymnasium.error.DependencyNotInstalled: Without pygame.
        """
        if self.render_mode is None:
            gym.logger.warn("render: expected an environment made with render_mode='rgb_array': nothing is drawn.")
            return None
        if not self._started:
            raise gym.error.ResetNeeded("render: expected a reset environment, call reset() first.")
        frames = (viewer.render() for viewer in self._viewers)
        return tuple(frame for frame in frames if frame is not None)

    def close_extras(self, **kwargs: Any) -> None:
        """Forgets the pictures."""
        for viewer in self._viewers:
            viewer.close()

    def _advance(self, action: Array) -> Array:
        """Steps all copies but those that have ended, and returns the cost, 0 for these."""
        cost = np.where(self._ended, 0.0, self.task.cost(self._state, action))
        state = self.task.next_state(self._state, action)
        if self._noise is None:
            self._state, self._observation = state, self.task.observe(state)
        else:
            process, measurement = self._noise.next(np.flatnonzero(~self._ended))
            self._state = self.task.disturbed(state, process)
            self._observation = self.task.measured(self._state, measurement)
        self._steps += 1
        for i, viewer in enumerate(self._viewers):
            viewer.add(self._state[i], action[i], float(cost[i]))
        return cost

    def _restart(self, copies: Indices, each: Sequence[dict[str, Any]]) -> None:
        """Starts an episode in some copies, as their scalar twins would with options ``each[i]``."""
        starts = []
        for i in copies:
            self.task.np_random = self._generators[i]
            starts.append(self.task.initial_state(each[i]))
        state = np.stack(starts)
        self._state[copies] = state
        if self._noise is None:
            self._observation[copies] = self.task.observe(state)
        else:
            self._observation[copies] = self.task.measured(state, self._noise.next(copies)[1][copies])
        self._steps[copies] = 0
        self._ended[copies] = False
        for i in copies if self._viewers else ():
            self._viewers[i].begin(self._state[i])

    def _seed(self, seed: int | Sequence[int | None] | None, copies: Indices) -> None:
        """New random numbers for those of the copies that have a seed, or have none yet."""
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + i for i in range(self.num_envs)]
        seeds = [None] * self.num_envs if seed is None else seed
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: expected one, or {self.num_envs}, got {len(seeds)}.")
        first = not self._generators
        if first:
            self._generators = [seeding.np_random(one)[0] for one in seeds]
        for i in copies:
            if seeds[i] is not None and not first:
                self._generators[i] = seeding.np_random(seeds[i])[0]
            if self._noise is not None and (seeds[i] is not None or first):
                self._noise.restart(i, self._generators[i].spawn(1)[0])

    def _each_options(self, options: Options | None) -> tuple[list[dict[str, Any]], Mask]:
        """The options of each copy, and which copies are reset."""
        mask = np.ones(self.num_envs, dtype=bool)
        if not isinstance(options, dict | None):
            if len(options) != self.num_envs:
                raise ValueError(f"reset options: expected one, or {self.num_envs}, got {len(options)}.")
            return [dict(one or {}) for one in options], mask
        common = dict(options or {})
        if "reset_mask" in common:
            mask = np.asarray(common.pop("reset_mask"))
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise ValueError(
                    f"reset option 'reset_mask': expected {self.num_envs} booleans, one of them true, got {mask!r}."
                )
            if not self._started:
                raise gym.error.ResetNeeded("reset option 'reset_mask': expected all copies to be reset before.")
        states = floats_of(common["state"]) if "state" in common else None
        if states is None or states.ndim != 2:
            return [common] * self.num_envs, mask
        if len(states) != self.num_envs:
            raise ValueError(f"reset option 'state': expected {self.num_envs} rows, got {len(states)}.")
        return [common | {"state": state} for state in states], mask

    def _infos(self, cost: Array, mask: Mask) -> dict[str, Any]:
        """Gymnasium's form: an array an entry, zero where not in ``mask``, which stands under ``_name``."""
        state = np.where(mask[:, None], self._state, 0.0)
        infos = {"cost": cost.copy(), "state": state, "is_success": mask & self.task.is_success(self._state)}
        return infos | {f"_{name}": mask.copy() for name in infos}

    def _final(self, cost: Array, ended: Mask) -> dict[str, Any]:
        """Last observation and info of the episodes that have ended."""
        observations = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended):
            observations[i] = self._observation[i].copy()
        infos = self._infos(np.where(ended, cost, 0.0), ended)
        return {"final_obs": observations, "_final_obs": ended.copy(), "final_info": infos, "_final_info": ended.copy()}


class _NormalRows:
    """Standard normal numbers, each copy's from a generator of its own, drawn ahead in blocks.

    A generator's numbers do not depend on how many are drawn at once: each copy sees what its scalar twin draws step
    by step.
    """

    _BLOCK = 64

    def __init__(self, n: int, nx: int) -> None:
        self._generators: list[np.random.Generator | None] = [None] * n
        self._rows = np.zeros((self._BLOCK, 2, n, nx))
        self._next = np.zeros(n, dtype=np.intp)

    def restart(self, i: int, generator: np.random.Generator) -> None:
        """Copy ``i`` goes on with another generator."""
        self._generators[i], self._next[i] = generator, self._BLOCK

    def next(self, copies: Indices) -> Array:
        """The next numbers of some copies, those of w and of v, ``(2, n, nx)``; of any value for the others."""
        block, _, n, nx = self._rows.shape
        for i in copies[self._next[copies] == block]:
            generator = self._generators[i]
            if generator is not None:
                self._rows[:, :, i] = generator.standard_normal((block, 2, nx))
            self._next[i] = 0
        rows = self._next[copies]
        self._next[copies] += 1
        if len(copies) == n and (rows == rows[0]).all():
            return np.asarray(self._rows[rows[0]])
        normals = np.zeros((2, n, nx))
        normals[:, copies] = self._rows[rows, :, copies].swapaxes(0, 1)
        return normals


def _checked_autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        known = tuple(known.value for known in AutoresetMode)
        raise ValueError(f"autoreset_mode: expected one of {known}, got {mode!r}.") from None
