"""Recorded episodes simulated again, and how far that is from what was recorded."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidDataError, MPCOfflineError
from mpcoffline.datasets.recording.stage_cost import PlantInfo, number_of
from mpcoffline.envs import ControlTask

if TYPE_CHECKING:
    from minari import MinariDataset

    Env = gym.Env[Any, Any]

QUANTITIES = ("observation", "state", "cost")
# Relative to 1 + size, for one step: another machine's sine differs in the last bit of float64, and rounding to
# float32 can turn that into one unit in its last place.
TOLERANCES: Mapping[str, float] = {"observation": 1e-6, "state": 1e-10, "cost": 1e-10}


@dataclass(frozen=True)
class Deviation:
    """The largest difference between what was recorded and what the environment gives.

    Attributes:
        absolute: In the unit of the quantity; inf where one of the two is not finite.
        relative: The same difference over 1 + size of what was recorded.
        episode: Where; None where there is no difference.
        step: The row of the episode's observations.
    """

    absolute: float = 0.0
    relative: float = 0.0
    episode: int | None = None
    step: int | None = None


class Simulation:
    """Steps an environment along recorded episodes and keeps the largest deviations.

    Args:
        env: The environment.
        dataset: Where the episodes come from.

    Attributes:
        episodes: Number of episodes simulated.
        steps: Number of steps simulated.
        free_run: The largest deviation of each quantity over whole episodes.
        one_step: The same, each step from the recorded state.
        wrong_ends: Episodes that terminate where the recording does not, or the other way round.
        skipped: Episodes that could not be simulated, each with the reason.
    """

    env: gym.Env[Any, Any]
    name: str
    episodes: int
    steps: int

    def __init__(self, env: Env, dataset: MinariDataset) -> None:
        self.env, self._dataset, self.name = env, dataset, f"data set {dataset.spec.dataset_id!r}"
        self.task: ControlTask | None = env.unwrapped if isinstance(env.unwrapped, ControlTask) else None
        self.episodes = self.steps = 0
        self.free_run: dict[str, Deviation] = dict.fromkeys(QUANTITIES, Deviation())
        self.one_step: dict[str, Deviation] = dict.fromkeys(QUANTITIES, Deviation())
        self.wrong_ends: list[int] = []
        self.skipped: list[tuple[int, str]] = []
        self._compared: dict[int, set[str]] = {}
        self._rule = PlantInfo("replay")

    def compared(self, deviations: Mapping[str, Deviation]) -> dict[str, Deviation]:
        """Those of ``free_run`` or ``one_step`` that were compared in some episode."""
        found = self._compared.get(id(deviations), set())
        return {name: deviation for name, deviation in deviations.items() if name in found}

    def run(self, episode: Any) -> None:
        """Simulates one episode.

        Raises:
            InvalidDataError: Where it says neither its state nor its seed, or the environment does not start from it.
        """
        number, recorded = int(episode.id), self._recorded(episode)
        actions, first = np.asarray(episode.actions), 0
        repeats = self.task is not None and not self.task.noisy and "state" in recorded
        seed, options = (None, None) if repeats else self._reset_of(number)
        if "state" in recorded:
            known = np.isfinite(recorded["state"]).all(axis=1)
            # Recording may have begun within the episode: from the first known state on.
            first = int(np.argmax(known)) if known.any() else len(known)
            if first >= len(actions):
                self.skipped.append((number, "no finite state to start from"))
                return
            recorded = {key: value[first:] for key, value in recorded.items()}
            recorded["cost"][0] = 0.0  # that of the step before
            actions = actions[first:]
        elif seed is None:
            raise InvalidDataError(
                f"{self.name}, episode {number}: infos/state",
                expected="the state at every step, or the seed of the reset",
                actual="none",
            )
        try:
            if "state" in recorded and self._starts_from(recorded["state"][0], seed if first == 0 else None):
                simulated, terminated = self._simulate(actions, {"options": {"state": recorded["state"][0]}})
            else:
                simulated, terminated = self._simulate(actions, {"seed": seed, "options": options})
        except MPCOfflineError:
            raise
        except (ValueError, gym.error.Error) as error:  # a state or seed that the environment does not start from
            self.skipped.append((number, str(error)))
            return
        self.episodes, self.steps = self.episodes + 1, self.steps + len(actions)
        self._compare(self.free_run, recorded, simulated, number, first)
        if terminated != list(map(bool, episode.terminations[first:])):
            self.wrong_ends.append(number)
        if repeats:
            self._compare(self.one_step, recorded, self._single_steps(recorded["state"], actions), number, first)

    def _recorded(self, episode: Any) -> dict[str, NDArray[Any]]:
        observations = np.asarray(episode.observations)
        if observations.dtype.kind not in "biuf":
            raise InvalidDataError(
                f"{self.name}, episode {int(episode.id)}: observations",
                expected="one array of numbers",
                actual=str(self._dataset.observation_space),
            )
        cost = np.concatenate([[0.0], -np.asarray(episode.rewards, dtype=np.float64)])
        recorded = {"observation": observations, "cost": cost}
        state = np.asarray((episode.infos or {}).get("state"))
        if state.dtype.kind not in "biuf" or len(state) != len(cost):
            return recorded
        return recorded | {"state": state.reshape(len(state), -1)}

    def _reset_of(self, number: int) -> tuple[int | None, dict[str, Any] | None]:
        """Seed and options of an episode's reset, where they are stored."""
        try:
            metadata = next(iter(self._dataset.storage.get_episode_metadata([number])))
            seed = metadata.get("seed")
            return (None, None) if seed is None else (int(seed), metadata.get("options") or None)
        except (KeyError, TypeError, ValueError, OverflowError, AssertionError, StopIteration):
            return None, None

    def _starts_from(self, state: NDArray[Any], seed: int | None) -> bool:
        """Whether the environment starts from a state; where it has to, for want of a seed, it is refused if not."""
        if self.task is not None and self.task.noisy:
            if seed is not None:
                return False
            spec = self._dataset.env_spec
            raise InvalidDataError(
                self.name,
                expected="an environment without noise, or seeds, with which alone it can be simulated again",
                actual=f"{spec.id if spec else self.env} with process or measurement noise",
            )
        try:
            _, info = self.env.reset(options={"state": state})
        except (ValueError, TypeError, KeyError):
            if seed is not None:
                return False
            raise
        found = self._rule.state(info, reset=True)
        starts = found is not None and np.array_equal(found.ravel(), state)
        if not starts and seed is None:
            raise InvalidDataError(
                f"{self.name}: its environment",
                expected="one that starts from reset(options={'state': s}) and says so in info['state']",
                actual=f"info['state'] = {info.get('state')} for s = {state}",
            )
        return bool(starts)

    def _simulate(self, actions: NDArray[Any], reset: Mapping[str, Any]) -> tuple[dict[str, NDArray[Any]], list[bool]]:
        rule = self._rule
        observation, info = self.env.reset(**reset)
        observations, states, terminations = [observation], [rule.state(info, reset=True)], []
        costs, rewards = [0.0], [0.0]
        for action in actions:
            observation, reward, terminated, _, info = self.env.step(action)
            paid = number_of(reward)
            rewards.append(math.nan if paid is None else paid)
            costs.append(rule.cost(info, rewards[-1]))
            observations.append(observation)
            states.append(rule.state(info))
            terminations.append(bool(terminated))
        simulated = {
            "observation": np.array(observations),
            "cost": np.array(costs) if rule.has_cost else -np.array(rewards),
        }
        known = [state.ravel() for state in states if state is not None]
        if len(known) == len(states):
            simulated["state"] = np.array(known)
        return simulated, terminations

    def _single_steps(self, states: NDArray[Any], actions: NDArray[Any]) -> dict[str, NDArray[Any]]:
        if self.task is None:
            return {}
        space, before = self.task.action_space, states[:-1]
        applied = np.clip(actions.astype(np.float64), space.low, space.high)
        reached = np.concatenate([states[:1], self.task.next_state(before, applied)])
        cost = np.concatenate([[0.0], self.task.cost(before, applied)])
        return {"observation": self.task.observe(reached), "state": reached, "cost": cost}

    def _compare(
        self,
        worst: dict[str, Deviation],
        recorded: Mapping[str, NDArray[Any]],
        simulated: Mapping[str, NDArray[Any]],
        episode: int,
        first: int,
    ) -> None:
        for key in worst.keys() & recorded.keys():
            self._compared.setdefault(id(worst), set()).add(key)
            if key not in simulated or recorded[key].shape != simulated[key].shape:
                worst[key] = Deviation(math.inf, math.inf, episode, first)
                continue
            a, b = recorded[key].astype(np.float64), simulated[key].astype(np.float64)
            with np.errstate(invalid="ignore", over="ignore"):
                if key == "cost" and np.array_equal(a, a.astype(np.float32), equal_nan=True):
                    b = b.astype(np.float32).astype(np.float64)  # as a VecEnv rounded what was recorded
                absolute = np.where(a == b, 0.0, np.nan_to_num(np.abs(a - b), nan=np.inf))
                relative = np.nan_to_num(absolute / (1.0 + np.abs(a)), nan=np.inf)
            largest = float(absolute.max())
            if largest > 0.0 and float(relative.max()) >= worst[key].relative:
                place = np.unravel_index(int(relative.argmax()), relative.shape)
                found = Deviation(float(absolute[place]), float(relative[place]), episode, first + int(place[0]))
                worst[key] = found
