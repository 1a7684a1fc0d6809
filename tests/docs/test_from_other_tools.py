"""The recipes of the guide "From other tools" that are more than one call: they run as they are written there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
from foreign_data import Episode, assert_same
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from own_store import store

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.datasets import TransitionTable, record

__all__ = ["store"]

GUIDE = (Path(__file__).parents[2] / "docs" / "guides" / "from_other_tools.md").read_text(encoding="utf-8")


def block(heading: str) -> str:
    """The first block of Python below a heading."""
    found = re.search(rf"^## {heading}$.*?^```python\n(.*?)^```", GUIDE, flags=re.MULTILINE | re.DOTALL)
    assert found
    return found[1]


def test_every_block_is_python() -> None:
    for code in re.findall(r"^```python\n(.*?)^```", GUIDE, flags=re.MULTILINE | re.DOTALL):
        compile(code, "guide", "exec")


class Walk(gym.Env[Any, Any]):
    """x+ = x + u; a reward of -x^2, and a cost of 1 where x > 1, as Safety-Gymnasium's wrapper gives it."""

    observation_space, action_space = spaces.Box(-9.0, 9.0, (1,)), spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.k = np.zeros(1, np.float32), 0
        return self.x, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward, limit = -float(self.x[0] ** 2), float(self.x[0] > 1.0)
        self.x, self.k = self.x + np.asarray(action, np.float32), self.k + 1
        return self.x, reward, False, self.k == 4, {"cost": limit}


class Six(Walk):
    """The same with six values a step, as Safety-Gymnasium has them itself."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, info["cost"], terminated, truncated, info


class Up:
    """A policy that goes up."""

    def predict(self, observation: Any, **given: Any) -> tuple[Any, None]:
        return np.ones_like(observation), None


def test_a_safety_cost_is_priced_by_the_guides_class() -> None:
    code = block("Safety-Gymnasium").partition("\n\nenv = ")[0]
    names: dict[str, Any] = {}
    exec(code, names)
    dataset = record(names["Priced"](Six()), Up(), n_episodes=1, dataset_id="test/priced-v0", seed=0)
    table = TransitionTable.from_minari(dataset)
    np.testing.assert_array_equal(table.observations[:, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(table.costs, [0.0, 1.0, 4.0 + 10.0, 9.0 + 10.0])
    with pytest.warns(UserWarning, match=r"info\['cost'\] is .* the reward counts"):
        plain = record(Walk(), Up(), n_episodes=1, dataset_id="test/plain-v0", seed=0)
    np.testing.assert_array_equal(TransitionTable.from_minari(plain).costs, [0, 1, 4, 9])


def test_a_public_set_of_goals_is_read_by_the_guides_lines() -> None:
    """A set in the layout of D4RL's mazes, made by Minari itself."""
    rng = np.random.default_rng(0)
    numbers: Any = (rng.integers(-99, 99, size=(2, 5, 4)) / 8.0).astype(np.float64)
    ends = [True, False]
    buffers = [
        EpisodeBuffer(
            id=i,
            observations={"observation": s[:, :2], "desired_goal": s[:, 2:], "achieved_goal": s[:, :2]},
            actions=s[:-1, :1] / 99.0,
            rewards=-np.arange(4.0) - i,
            terminations=(np.arange(4) == 3) & end,
            truncations=(np.arange(4) == 3) & (not end),
            infos={},
        )
        for i, (s, end) in enumerate(zip(numbers, ends, strict=True))
    ]
    box = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    dataset = minari.create_dataset_from_buffers(
        "D4RL/pointmaze/umaze-v2",
        buffers,
        observation_space=spaces.Dict({"observation": box, "desired_goal": box, "achieved_goal": box}),
        action_space=spaces.Box(-1.0, 1.0, (1,), np.float64),
        algorithm_name="none",
        author="none",
        author_email="none@example.org",
        code_permalink="https://example.org",
        description="none",
    )
    with pytest.raises(InvalidDataError, match="observation space: expected a Box"):
        TransitionTable.from_minari(dataset)
    names: dict[str, Any] = {}
    exec(block("Minari"), names)
    expected = [
        Episode(s, (s[:-1, :1] / 99.0).astype("f4").astype("f8"), np.arange(4.0) + i, end)
        for i, (s, end) in enumerate(zip(numbers, ends, strict=True))
    ]
    assert_same(names["table"], expected)
