"""A policy that is recorded without a learning agent, against re-simulation."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets import record
from mpcoffline.datasets.store.recording_lock import log_files

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


class Proportional:
    """A policy with SB3's `predict`; counts in its state how often it was asked in an episode."""

    def __init__(self, fails_at: int = -1) -> None:
        self.calls = 0
        self.fails_at = fails_at

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        assert deterministic
        assert (state is None) == bool(episode_start[0])
        self.calls += 1
        if self.calls == self.fails_at:
            raise RuntimeError("power cut")
        return np.clip(-observation[1:2], -2, 2), (state or 0) + 1


def columns(dataset_id: str) -> list[np.ndarray[Any, Any]]:
    dataset = minari.load_dataset(dataset_id)
    return [np.concatenate([e.observations.ravel(), e.actions.ravel(), e.rewards]) for e in dataset.iterate_episodes()]


def test_a_policy_is_recorded_and_an_interruption_leaves_no_trace() -> None:
    whole = record(PENDULUM, Proportional(), 3, "test/whole-v0", seed=5)
    assert (whole.total_episodes, whole.total_steps) == (3, 300)
    env = gym.make(PENDULUM)
    for number, episode in enumerate(whole.iterate_episodes()):
        observation, _ = env.reset(seed=5 + number)
        for k in range(100):
            np.testing.assert_array_equal(observation, episode.observations[k])
            np.testing.assert_array_equal(np.clip(-observation[1:2], -2, 2), episode.actions[k])
            observation, reward, *_ = env.step(episode.actions[k])
            assert reward == episode.rewards[k]
    with pytest.raises(RuntimeError, match="power cut"):
        record(PENDULUM, Proportional(fails_at=250), 3, "test/cut-v0", seed=5)
    assert len(log_files("test/cut-v0")) == 1
    record(PENDULUM, Proportional(), 3, "test/cut-v0", seed=5)
    for a, b in zip(columns("test/whole-v0"), columns("test/cut-v0"), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_function_is_a_policy_and_its_actions_are_checked() -> None:
    env = gym.make(PENDULUM)
    record(env, lambda observation: env.action_space.sample(), 1, "test/random-v0", seed=0)
    record(env, lambda observation: env.action_space.sample(), 1, "test/same-v0", seed=0)
    np.testing.assert_array_equal(columns("test/random-v0")[0], columns("test/same-v0")[0])
    with pytest.raises(
        InvalidArgumentError, match=r"policy, episode 0, step 0: action: expected an element of Box.*\[99"
    ):
        record(env, lambda observation: np.array([99.0]), 1, "test/high-v0")
    with pytest.raises(InvalidArgumentError, match="n_episodes"):
        record(env, Proportional(), 0, "test/none-v0")


def test_an_environment_that_cannot_be_named_in_json_is_refused() -> None:
    spec = gym.spec(PENDULUM)
    entry = gym.make(PENDULUM).unwrapped.__class__
    gym.register("ByClass-v0", entry_point=entry, max_episode_steps=spec.max_episode_steps)
    try:
        with pytest.raises(InvalidArgumentError, match="module:Class"):
            record(gym.make("ByClass-v0"), Proportional(), 1, "test/by-class-v0", seed=0)
    finally:
        del gym.registry["ByClass-v0"]
