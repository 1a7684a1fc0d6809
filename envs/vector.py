"""The tasks' vector twin: many copies of one task, stepped as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from .base import Array, ControlTask, Observation


class ControlTaskVectorEnv(VectorEnv[NDArray[np.float32], NDArray[Any], NDArray[Any]]):
    """``num_envs`` copies of a :class:`ControlTask`, each equal to the scalar environment bit for bit.

    Made by ``gym.make_vec(id, num_envs, vectorization_mode="vector_entry_point")``. Copy i draws its starts from a
    generator seeded with ``seed + i``, as Gymnasium's own vector environments do. An episode that has ended restarts
    with the next step (``AutoresetMode.NEXT_STEP``), which ignores its action and returns the first observation with
    reward 0.

    Args:
        num_envs: Number of copies.
        max_episode_steps: Steps after which an episode is truncated.
        **task_kwargs: Arguments of the scalar environment.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012
    task_class: ClassVar[type[ControlTask]]

    def __init__(self, num_envs: int = 1, max_episode_steps: int = 100, **task_kwargs: Any) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs: expected a positive integer, got {num_envs}.")
        self.task = self.task_class(**task_kwargs)
        self.num_envs, self.max_episode_steps = num_envs, max_episode_steps
        self.single_observation_space = self.task.observation_space
        self.single_action_space = self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._state: Array | None = None
        self._start: dict[str, Any] = {}
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode in every copy.

        Args:
            seed: Seed of the first copy, the others following, or one a copy.
            options: As in the scalar environment; ``{"state": s}`` takes ``(num_envs, nx)``. A ``"start"`` holds for
                the automatic resets too.

        Returns:
            Observations ``(num_envs, ny)`` and infos of arrays ``(num_envs, ...)``.

        Raises:
            ValueError: For options that the scalar environment refuses, or another number of seeds or states.
        """
        self._seed(seed)
        options = dict(options or {})
        if "state" in options:
            states = np.asarray(options.pop("state"), dtype=np.float64)
            if len(states) != self.num_envs:
                raise ValueError(f"reset option 'state': expected {self.num_envs} rows, got {len(states)}.")
            self._start = {}
            self._state = np.stack([self.task.initial_state({"state": s, **options}) for s in states])
        else:
            self._start = options
            self._state = np.stack([self._sample(i) for i in range(self.num_envs)])
        self._steps[:] = 0
        self._ended[:] = False
        return self.task.observe(self._state), self._infos(self._state, np.zeros(self.num_envs))

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Applies an action ``(num_envs, nu)`` in every copy; actions beyond the bounds are clipped to them.

        Raises:
            ValueError: For actions of the wrong shape or not finite.
            gymnasium.error.ResetNeeded: Before the first ``reset``.
        """
        if self._state is None:
            raise gym.error.ResetNeeded("step: expected a reset environment, call reset() first.")
        applied = self.task.checked_action(actions, (self.num_envs, *self.task.action_space.shape))
        cost = self.task.cost(self._state, applied)
        state = self.task.next_state(self._state, applied)
        self._steps += 1
        for i in np.flatnonzero(self._ended):
            state[i] = self._sample(int(i))
        cost = np.where(self._ended, 0.0, cost)
        self._steps[self._ended] = 0
        self._ended = self._steps >= self.max_episode_steps
        self._state = state
        terminated = np.zeros(self.num_envs, dtype=bool)
        return self.task.observe(state), -cost, terminated, self._ended.copy(), self._infos(state, cost)

    def _seed(self, seed: int | Sequence[int | None] | None) -> None:
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + i for i in range(self.num_envs)]
        if seed is None:
            seed = [None] * self.num_envs
            if self._generators:
                return
        if len(seed) != self.num_envs:
            raise ValueError(f"seed: expected one, or {self.num_envs}, got {len(seed)}.")
        self._generators = [seeding.np_random(s)[0] for s in seed]

    def _sample(self, i: int) -> Array:
        """An initial state of copy i, drawn as its scalar twin would."""
        self.task.np_random = self._generators[i]
        return self.task.initial_state(self._start)

    def _infos(self, state: Array, cost: Array) -> dict[str, Any]:
        """Gymnasium's form: an array an entry, and under ``_name`` which copies have it."""
        present = np.ones(self.num_envs, dtype=bool)
        infos = {"cost": cost, "state": state.copy(), "is_success": self.task.is_success(state)}
        return infos | {f"_{name}": present.copy() for name in infos}
