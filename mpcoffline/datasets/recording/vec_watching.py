"""Looking on while Stable-Baselines3 steps its environments, below whatever changes rewards or observations."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)

from mpcoffline.core.errors import InvalidArgumentError

from .watching import PlantWatch, Shadow, plant_of

#: Wrappers under which the observations from before the first step are known: they change none, or keep the original.
_KEEPING = (VecCheckNan, VecMonitor, VecNormalize, VecVideoRecorder)


class VecWatch:
    """Watches the environments of a training: after each step, what went into and came out of them.

    It stands below all wrappers of the ``VecEnv``; only one that makes the observations a Box in the first place
    (``VecExtractDictObs``) is looked through from above. In a ``DummyVecEnv`` the rewards are those of the plants
    (:class:`~mpcoffline.datasets.recording.watching.PlantWatch`), in float64; environments in other processes cannot be
    watched, and show what the ``VecEnv`` gives.

    Args:
        env: The training's environment.
        name: Who watches, for messages.

    Raises:
        InvalidArgumentError: Where a wrapper may change observations, and the plants' own cannot be had.

    Attributes:
        observation_space: That of the observations below.
        action_space: That of the actions below.
        observations: Those after the last step, ``(n, ny)``.
        actions: Those of the last step, ``(n, nu)``.
        rewards: What the plants paid.
        given: What the environments gave for it, their wrappers included.
        dones: Which episodes ended with the last step.
        infos: The infos of the last step.
        terminal: By environment, the last observation of an episode that has ended.
    """

    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]

    def __init__(self, env: VecEnv, name: str) -> None:
        chain = [env]
        while isinstance(chain[-1], VecEnvWrapper):
            chain.append(chain[-1].venv)
        self._base = chain[-1]
        below = next((i for i in reversed(range(len(chain))) if isinstance(chain[i].observation_space, spaces.Box)), 0)
        self._watched, self._name = chain[below], name
        self.observation_space, self.action_space = self._watched.observation_space, self._watched.action_space
        above = [each for each in chain[:below] if not isinstance(each, _KEEPING)]
        self._first = self._watched if above else None
        if above and not isinstance(self._watched, DummyVecEnv):
            raise InvalidArgumentError(
                f"{name}'s environment",
                expected="observations below VecEnv wrappers that can be looked at, as in a DummyVecEnv",
                actual=f"{type(above[-1]).__name__} around {type(self._watched).__name__}",
                hint="Use a DummyVecEnv, or put the wrapper around the environment itself.",
            )
        if above and above[-1].observation_space != self.observation_space:
            warnings.warn(
                f"{name}: {type(above[-1]).__name__} changes the observations; recorded are those below it,"
                f" {self.observation_space}.",
                stacklevel=3,
            )
        envs = self._base.envs if isinstance(self._base, DummyVecEnv) else []
        self._plants = [PlantWatch(each) for each in envs]
        # A changed space is told of by who stores it.
        self._told = any(plant_of(each).observation_space != each.observation_space for each in envs)
        self.observations: NDArray[Any] = np.empty((0,))
        self.actions: NDArray[Any] = np.empty((0,))
        self.rewards: list[float] = []
        self.given: list[float] = []
        self.dones: NDArray[np.bool_] = np.empty((0,), dtype=bool)
        self.infos: list[dict[str, Any]] = []
        self.terminal: dict[int, NDArray[Any]] = {}
        self._shadows = [
            Shadow(self._watched, "step_async", self._of_actions),
            Shadow(self._watched, "step_wait", self._of_results),
        ]

    @property
    def reset_infos(self) -> list[dict[str, Any]]:
        """The infos of the last reset of each environment."""
        return self._base.reset_infos

    def remove(self) -> None:
        """Stops watching; harmless when repeated."""
        for shadow in reversed(self._shadows):
            shadow.remove()
        for plant in self._plants:
            plant.remove()

    def first_observations(self, known: NDArray[Any]) -> NDArray[Any]:
        """The observations from which the next step starts.

        Args:
            known: Those that the agent remembers, not normalised.
        """
        return np.array(known if self._first is None else self._first._obs_from_buf())  # type: ignore[attr-defined]

    def _of_actions(self, step_async: Callable[..., Any], given: tuple[Any, ...]) -> Any:
        self.actions = given[0]
        return step_async(*given)

    def _of_results(self, step_wait: Callable[..., Any], given: tuple[Any, ...]) -> Any:
        results = step_wait(*given)
        observations, rewards, dones, infos = results
        self.observations, self.dones, self.infos = np.array(observations), np.array(dones), infos
        self.given = [float(reward) for reward in rewards]
        self.rewards = list(self.given)
        for i, plant in enumerate(self._plants):
            if plant.reward is not None:
                self.rewards[i] = plant.reward
        # Wrappers above change the dictionaries of infos, so that it is kept here.
        self.terminal = {
            int(i): np.array(infos[i]["terminal_observation"], dtype=self.observations.dtype)
            for i in np.flatnonzero(self.dones)
        }
        self._tell_changes()
        return results

    def _tell_changes(self) -> None:
        """Says once where a wrapper around an environment changes numbers without changing a space."""
        if self._told:
            return
        for i, plant in enumerate(self._plants):
            after = self.terminal.get(i, self.observations[i])
            changed = plant.changes(self.actions[i], after)
            if changed is not None:
                self._told = True
                what, own, outside = changed
                warnings.warn(
                    f"{self._name}: a wrapper makes {outside} of the plant's {what} {own}, and that is what gets"
                    " recorded. Scale inside the agent instead.",
                    stacklevel=2,
                )
                return
