"""Plants and wrappers of tests: a scalar plant whose numbers follow from its inputs, and what people put around one."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

Array = np.ndarray[Any, Any]


class Drift(gym.Env[Array, Array]):
    """x+ = x + u, reward -(x^2 + u^2 / 2) of the step; what its info says is a function of the step's number k.

    Args:
        length: Steps until it is truncated; 0 for never.
        info: Gives the info of step k from (k, cost); k = 0 is the reset.
        gain: Of the input.
    """

    observation_space = spaces.Box(-1e3, 1e3, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, length: int = 10, info: Any = None, gain: float = 1.0) -> None:
        self.length, self.info, self.gain = length, info, gain
        self.paid: list[float] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.k = float(self.np_random.uniform(-1.0, 1.0)), 0
        return self._observed(), {} if self.info is None else self.info(0, 0.0)

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        u = float(action[0])
        cost = self.x**2 + 0.5 * u**2
        self.x, self.k = self.x + self.gain * u, self.k + 1
        self.paid.append(-cost)
        info = {} if self.info is None else self.info(self.k, cost)
        return self._observed(), -cost, False, self.k == self.length, info

    def _observed(self) -> Array:
        return np.array([self.x], np.float32)


def costly(k: int, cost: float) -> dict[str, Any]:
    """The info of a plant whose cost is the cost."""
    return {"cost": cost}


def unsafe(k: int, cost: float) -> dict[str, Any]:
    """The info of safe RL: 1 where a limit is violated."""
    return {"cost": float(cost > 0.2)}


class Zero:
    """A policy that does nothing."""

    def __init__(self, value: float = 0.0) -> None:
        self.value = value

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        return np.full((*np.shape(observation)[:-1], 1), self.value, np.float32), None


class HalfObservation(gym.ObservationWrapper[Any, Any, Any]):
    """Scales observations, and says nothing of it in its space."""

    def observation(self, observation: Any) -> Any:
        return np.asarray(0.5 * observation, np.float32)


class HalfAction(gym.ActionWrapper[Any, Any, Any]):
    """Scales actions, and says nothing of it in its space."""

    def action(self, action: Any) -> Any:
        return np.asarray(0.5 * action, np.float32)


class Tenth(gym.RewardWrapper[Any, Any]):
    """Scales rewards."""

    def reward(self, reward: Any) -> float:
        return 0.1 * float(reward)


class Plain(gym.Wrapper[Any, Any, Any, Any]):
    """Changes nothing, and cannot be rebuilt from a spec."""


class Twice(gym.Wrapper[Any, Any, Any, Any]):
    """Repeats each action."""

    def step(self, action: Any) -> Any:
        _, first, *_ = self.env.step(action)
        observation, second, *rest = self.env.step(action)
        return observation, float(first) + float(second), *rest


def half_drift() -> gym.Env[Any, Any]:
    """An entry point that wraps its plant."""
    return HalfObservation(Drift())
