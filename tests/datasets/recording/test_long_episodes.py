"""Episodes that hardly ever end: written in pieces, so that a crash costs the last steps only."""

from __future__ import annotations

import os
import signal
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
from crashing import run_and_kill
from stable_baselines3 import DDPG

from mpcoffline.datasets import MinariRecorder, record, repair
from mpcoffline.datasets.recording import episode_builder

PENDULUM = "mpcoffline/PendulumSwingUp-v0"
LONG = "test/long-v0"


@pytest.fixture(autouse=True)
def pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces of 16 steps."""
    monkeypatch.setattr(episode_builder, "PIECE_STEPS", 16)


def columns(dataset_id: str) -> list[np.ndarray[Any, Any]]:
    found = []
    for episode in minari.load_dataset(dataset_id).iterate_episodes():
        found += [episode.observations, episode.actions, episode.rewards, episode.terminations, episode.truncations]
        found += [episode.infos["cost"], episode.infos["state"]]
    return found


@pytest.mark.parametrize("steps", [15, 16, 17, 32, 33, 100])
def test_pieces_make_the_same_episode(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(dataset_id: str) -> None:
        env = gym.make(PENDULUM, max_episode_steps=steps)
        record(env, lambda observation: np.clip(-observation[1:2], -2, 2), 2, dataset_id, seed=0)

    run(LONG)
    monkeypatch.setattr(episode_builder, "PIECE_STEPS", 10**9)
    run("test/whole-v0")
    for found, wanted in zip(columns(LONG), columns("test/whole-v0"), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_a_recorder_writes_pieces_of_every_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(dataset_id: str) -> list[float]:
        agent = DDPG("MlpPolicy", gym.make(PENDULUM), learning_starts=10**9, buffer_size=100, seed=0, device="cpu")
        recorder = MinariRecorder(dataset_id)
        agent.learn(150, callback=recorder)
        return recorder.returns

    returns = run(LONG)
    monkeypatch.setattr(episode_builder, "PIECE_STEPS", 10**9)
    np.testing.assert_allclose(returns, run("test/whole-v0"), rtol=1e-12)
    for found, wanted in zip(columns(LONG), columns("test/whole-v0"), strict=True):
        np.testing.assert_array_equal(found, wanted)


class Clipped:
    """A policy that fails, or kills its process, when it is asked for the so manieth time."""

    def __init__(self, last: int, kill: bool = False) -> None:
        self.calls, self.last, self.kill = 0, last, kill

    def __call__(self, observation: Any) -> Any:
        self.calls += 1
        if self.calls == self.last and self.kill:
            os.kill(os.getpid(), signal.SIGKILL)
        if self.calls == self.last:
            raise RuntimeError("power cut")
        return np.clip(-observation[1:2], -2, 2)


def run(policy: Clipped, episodes: int = 2, steps: int = 10**6) -> None:
    record(gym.make(PENDULUM, max_episode_steps=steps), policy, episodes, LONG, seed=0)


def killed_at(step: int, **arguments: Any) -> None:
    def until_closed(pipe: int) -> str:
        while os.read(pipe, 100):
            pass
        return ""

    run_and_kill(lambda say: run(Clipped(step, kill=True), **arguments), until_closed)


def test_a_killed_process_loses_a_piece_at_most() -> None:
    killed_at(75)
    report = repair(LONG)
    assert (report.episodes, report.steps) == (1, 64)
    found = minari.load_dataset(LONG)[0]
    assert found.truncations.tolist() == [False] * 63 + [True]
    task = gym.make(PENDULUM).unwrapped
    np.testing.assert_array_equal(found.observations, task.observe(found.infos["state"]))
    np.testing.assert_allclose(
        task.next_state(found.infos["state"][:-1], found.actions.astype(np.float64)), found.infos["state"][1:]
    )


def test_going_on_begins_the_episode_again() -> None:
    killed_at(75, steps=50)
    with pytest.warns(UserWarning, match="1 episodes of an interrupted recording"):
        run(Clipped(10**9), steps=50)
    record(gym.make(PENDULUM, max_episode_steps=50), Clipped(10**9), 2, "test/whole-v0", seed=0)
    for found, wanted in zip(columns(LONG), columns("test/whole-v0"), strict=True):
        np.testing.assert_array_equal(found, wanted)
