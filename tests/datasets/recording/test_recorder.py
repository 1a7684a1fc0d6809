"""The recorder against an independent re-simulation of the environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env as sb3_make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecNormalize

import mpcoffline.envs  # noqa: F401
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets import MinariRecorder, TransitionTable, repair

PENDULUM = "mpcoffline/PendulumSwingUp-v0"
CARTPOLE = "mpcoffline/CartPoleSwingUp-v0"
LINEAR = "mpcoffline/LinearTracking-v0"


def make_vec_env(env: Any, n_envs: int, **arguments: Any) -> VecEnv:
    """SB3's, without the rendering that it asks every registered environment for."""
    return sb3_make_vec_env(
        (lambda: gym.make(f"mpcoffline:{env}")) if isinstance(env, str) else env, n_envs, **arguments
    )


def agent_on(env: Any, algorithm: type[Any] = DDPG, **arguments: Any) -> Any:
    """An untrained agent; with learning_starts beyond the run it only explores, which is quick."""
    settings = {"learning_starts": 10**9, "buffer_size": 2000, "seed": 0, "device": "cpu", **arguments}
    return algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, **settings)


class Countdown(gym.Env[Any, Any]):
    """Terminates after as many steps as its first observation says (1 to 4); has neither cost nor state."""

    observation_space = spaces.Box(0.0, 10.0, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(1, 5))
        return np.array([self.left], np.float32), {}

    def step(self, action: Any) -> Any:
        self.left -= 1
        return np.array([self.left], np.float32), 0.1 + self.left, self.left == 0, False, {}


@pytest.mark.parametrize("env_id", [PENDULUM, CARTPOLE, LINEAR])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_every_transition_is_what_a_fresh_environment_does(env_id: str, n_envs: int) -> None:
    agent = agent_on(make_vec_env(env_id, n_envs, seed=1))
    agent.learn(750, callback=MinariRecorder("mpcoffline/test/re-v0"))

    dataset = minari.load_dataset("mpcoffline/test/re-v0")
    fresh = gym.make(env_id)
    assert dataset.total_steps == 750
    lengths = sorted(len(episode.actions) for episode in dataset.iterate_episodes())
    # 7 episodes and a half from one environment, 2 and a half from each of three.
    assert lengths == ([50] + [100] * 7 if n_envs == 1 else [50] * 3 + [100] * 6)
    for episode in dataset.iterate_episodes():
        steps = len(episode.actions)
        assert len(episode.observations) == len(episode.infos["state"]) == steps + 1
        assert episode.infos["cost"].shape == (steps + 1, 1)
        assert episode.infos["cost"].dtype == episode.infos["state"].dtype == episode.rewards.dtype == np.float64
        observation, _ = fresh.reset(options={"state": episode.infos["state"][0]})
        np.testing.assert_array_equal(episode.observations[0], observation)
        for k in range(steps):
            assert fresh.action_space.contains(episode.actions[k])
            observation, reward, terminated, _, info = fresh.step(episode.actions[k])
            np.testing.assert_array_equal(episode.observations[k + 1], observation)
            np.testing.assert_array_equal(episode.infos["state"][k + 1], info["state"])
            assert episode.rewards[k] == reward == -info["cost"] == -episode.infos["cost"][k + 1, 0]
            assert episode.terminations[k] == terminated == False  # noqa: E712
        assert list(episode.truncations) == [False] * (steps - 1) + [True]


def test_truncation_is_not_termination_in_the_table() -> None:
    agent_on(make_vec_env(PENDULUM, 1)).learn(200, callback=MinariRecorder("mpcoffline/test/tt-v0"))
    table = TransitionTable.from_minari("mpcoffline/test/tt-v0")
    assert len(table) == 200
    assert table.terminations.sum() == 0


@pytest.mark.parametrize("n_envs", [1, 3])
def test_termination_is_recorded_with_the_last_observation(n_envs: int) -> None:
    agent = agent_on(make_vec_env(Countdown, n_envs, seed=3))
    recorder = MinariRecorder("mpcoffline/test/countdown-v0")
    agent.learn(60, callback=recorder)
    dataset = minari.load_dataset("mpcoffline/test/countdown-v0")
    assert dataset.total_steps == 60
    finished = 0
    for episode in dataset.iterate_episodes():
        steps = len(episode.actions)
        first = episode.observations[0, 0]
        np.testing.assert_array_equal(episode.observations[:, 0], first - np.arange(steps + 1))
        # This environment gives no cost: the VecEnv's float32 reward is all there is.
        np.testing.assert_allclose(episode.rewards, 0.1 + episode.observations[1:, 0], rtol=1e-6)
        done = episode.observations[-1, 0] == 0.0
        finished += done
        assert list(episode.terminations) == [False] * (steps - 1) + [done]
        assert list(episode.truncations) == [False] * (steps - 1) + [not done]
    assert finished > 60 / 4 - n_envs
    assert dataset.env_spec is None
    assert not episode.infos


@pytest.mark.parametrize("algorithm", [TD3, SAC])
def test_other_algorithms_that_learn_meanwhile(algorithm: type[Any]) -> None:
    noise = NormalActionNoise(np.zeros(1), np.full(1, 0.5)) if algorithm is TD3 else None
    agent = agent_on(make_vec_env(PENDULUM, 2), algorithm, learning_starts=20, action_noise=noise, batch_size=8)
    agent.learn(120, callback=MinariRecorder("mpcoffline/test/algo-v0"))
    dataset = minari.load_dataset("mpcoffline/test/algo-v0")
    task = gym.make(PENDULUM).unwrapped
    for episode in dataset.iterate_episodes():
        state, action = episode.infos["state"], episode.actions.astype(np.float64)
        np.testing.assert_allclose(task.next_state(state[:-1], action), state[1:], atol=1e-12)
        # In the environment's units (up to 2), not the normalised ones of the replay buffer.
        assert np.abs(episode.actions).max() > 1.0
    assert dataset.storage.metadata["algorithm_name"] == algorithm.__name__


def test_the_environment_comes_back_without_the_training_wrappers() -> None:
    wrapped = gym.wrappers.RescaleObservation(
        gym.make(LINEAR, alpha=0.25, max_episode_steps=30), np.float32(-1.0), np.float32(1.0)
    )
    agent = agent_on(wrapped)
    with pytest.warns(UserWarning, match="a wrapper changes the observation_space"):
        agent.learn(40, callback=MinariRecorder("mpcoffline/test/spec-v0"))
    env = minari.load_dataset("mpcoffline/test/spec-v0").recover_environment()
    assert env.spec is not None
    assert env.spec.id == LINEAR
    assert env.spec.max_episode_steps == 30
    assert env.unwrapped.alpha == 0.25
    assert not env.spec.additional_wrappers
    assert env.observation_space == gym.make(LINEAR).observation_space


def test_vec_normalize_does_not_reach_the_record() -> None:
    env = VecNormalize(make_vec_env(PENDULUM, 2, seed=0))
    agent_on(env).learn(300, callback=MinariRecorder("mpcoffline/test/norm-v0"))
    task = gym.make(PENDULUM).unwrapped
    for episode in minari.load_dataset("mpcoffline/test/norm-v0").iterate_episodes():
        observations = task.observe(episode.infos["state"])
        np.testing.assert_array_equal(episode.observations[:-1], observations[:-1])
        # SB3 keeps the last observation of an episode in normalised form only.
        np.testing.assert_allclose(episode.observations[-1], observations[-1], atol=1e-6)
        assert episode.observations.dtype == np.float32
        cost = task.cost(episode.infos["state"][:-1], episode.actions.astype(np.float64))
        np.testing.assert_allclose(episode.rewards, -cost, atol=1e-12)


@pytest.mark.slow
def test_environments_in_other_processes() -> None:
    env = make_vec_env(PENDULUM, 2, seed=0, vec_env_cls=SubprocVecEnv)
    agent_on(env).learn(210, callback=MinariRecorder("mpcoffline/test/sub-v0"))
    env.close()
    dataset = minari.load_dataset("mpcoffline/test/sub-v0")
    task = gym.make(PENDULUM).unwrapped
    assert sorted(len(episode.actions) for episode in dataset.iterate_episodes()) == [5, 5, 100, 100]
    for episode in dataset.iterate_episodes():
        np.testing.assert_array_equal(episode.observations, task.observe(episode.infos["state"]))
    assert dataset.recover_environment().spec.id == PENDULUM


def test_a_second_learn_goes_on_where_the_first_ended() -> None:
    agent = agent_on(make_vec_env(PENDULUM, 1, seed=0))
    recorder = MinariRecorder("mpcoffline/test/twice-v0")
    agent.learn(130, callback=recorder)
    agent.learn(90, callback=recorder, reset_num_timesteps=False)
    episodes = list(minari.load_dataset("mpcoffline/test/twice-v0").iterate_episodes())
    assert [len(episode.actions) for episode in episodes] == [100, 30, 70, 20]
    np.testing.assert_array_equal(episodes[1].infos["state"][-1], episodes[2].infos["state"][0])
    np.testing.assert_array_equal(episodes[1].observations[-1], episodes[2].observations[0])


def test_joining_a_run_halfway_leaves_the_unknown_first_state_nan() -> None:
    agent = agent_on(make_vec_env(PENDULUM, 1, seed=0))
    agent.learn(30)
    agent.learn(90, callback=MinariRecorder("mpcoffline/test/half-v0"), reset_num_timesteps=False)
    episodes = list(minari.load_dataset("mpcoffline/test/half-v0").iterate_episodes())
    assert [len(episode.actions) for episode in episodes] == [70, 20]
    assert np.isnan(episodes[0].infos["state"][0]).all()
    assert np.isfinite(episodes[0].infos["state"][1:]).all()
    assert np.isfinite(episodes[1].infos["state"]).all()


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_an_existing_id_is_refused_and_left_alone(store: Path) -> None:
    agent = agent_on(make_vec_env(PENDULUM, 1))
    late = MinariRecorder("mpcoffline/test/ex-v0")
    agent.learn(10, callback=MinariRecorder("mpcoffline/test/ex-v0"))
    before = snapshot(store)
    with pytest.raises(InvalidArgumentError, match=r"new data set.*mpcoffline/test/ex-v0.*overwrite=True"):
        MinariRecorder("mpcoffline/test/ex-v0")
    # A recorder that was made before the data set came to be notices before training starts.
    with pytest.raises(InvalidArgumentError, match="exists"):
        agent.learn(10, callback=late)
    assert agent.num_timesteps == 0
    assert snapshot(store) == before

    agent.learn(20, callback=MinariRecorder("mpcoffline/test/ex-v0", overwrite=True))
    assert minari.load_dataset("mpcoffline/test/ex-v0").total_steps == 20
    assert not [path for path in store.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("dataset_id", ["no-version", "a.b/c-v0", "x/y-v0", "../up-v0", "a//b-v0", "", "-v0", 3])
def test_an_id_against_the_grammar_is_refused(dataset_id: Any) -> None:
    with pytest.raises(InvalidArgumentError, match=r"\(namespace/\)\*name-vN"):
        MinariRecorder(dataset_id)


def test_only_off_policy_agents_on_boxes() -> None:
    agent = PPO("MlpPolicy", gym.make(PENDULUM), n_steps=8, batch_size=8, device="cpu")
    with pytest.raises(InvalidArgumentError, match="off-policy"):
        agent.learn(8, callback=MinariRecorder("mpcoffline/test/ppo-v0"))


def test_recording_does_not_change_the_training() -> None:
    weights = []
    for callback in (None, MinariRecorder("mpcoffline/test/same-v0")):
        agent = agent_on(make_vec_env(PENDULUM, 1, seed=0), learning_starts=20, batch_size=8)
        agent.learn(60, callback=callback)
        weights.append(agent.policy.state_dict())
    for name, value in weights[0].items():
        np.testing.assert_array_equal(value.numpy(), weights[1][name].numpy())


class BrokenOffError(Exception):
    pass


class StopAfter(BaseCallback):
    """Breaks a training off in the middle of its second episode."""

    def _on_step(self) -> bool:
        if self.num_timesteps >= 150:
            raise BrokenOffError
        return True


def test_a_recording_is_not_continued_with_another_plant() -> None:
    def interrupted(mass: float) -> None:
        recorder = MinariRecorder("mpcoffline/test/plants-v0")
        try:
            agent = agent_on(make_vec_env(lambda: gym.make(PENDULUM, m=mass), 1))
            agent.learn(250, callback=[recorder, StopAfter()])
        finally:
            recorder.close()

    with pytest.raises(BrokenOffError):
        interrupted(1.3)
    with pytest.raises(InvalidArgumentError, match=r"environment: .*repair"):
        interrupted(1.5)
    with pytest.raises(BrokenOffError):
        interrupted(1.3)


def test_a_training_that_fails_is_continued_by_the_next() -> None:
    agent = agent_on(make_vec_env(PENDULUM, 1, seed=0))
    first = MinariRecorder("mpcoffline/test/again-v0")
    with pytest.raises(BrokenOffError):
        agent.learn(300, callback=[first, StopAfter()])
    assert first.dataset is None
    assert len(first.returns) == 1
    with pytest.raises(InvalidArgumentError, match=r"one recorder at a time.*recorder.close\(\)"):
        agent.learn(10, callback=MinariRecorder("mpcoffline/test/again-v0"))
    first.close()
    second = MinariRecorder("mpcoffline/test/again-v0")
    with pytest.warns(UserWarning, match="1 episodes of an interrupted recording"):
        agent.learn(110, callback=second)
    episodes = list(minari.load_dataset("mpcoffline/test/again-v0").iterate_episodes())
    assert [len(episode.actions) for episode in episodes] == [100, 100, 10]
    assert first.returns + second.returns == [episode.rewards.sum() for episode in episodes]


def test_what_a_failed_training_recorded_can_be_sealed() -> None:
    agent = agent_on(make_vec_env(PENDULUM, 1, seed=0))
    recorder = MinariRecorder("mpcoffline/test/sealed-v0")
    with pytest.raises(BrokenOffError):
        agent.learn(300, callback=[recorder, StopAfter()])
    recorder.close()
    report = repair("mpcoffline/test/sealed-v0")
    assert (report.action, report.episodes, report.steps) == ("sealed", 1, 100)
    assert minari.load_dataset("mpcoffline/test/sealed-v0").recover_environment().spec.id == PENDULUM


def test_the_number_of_episodes_between_synchronisations_is_checked() -> None:
    with pytest.raises(InvalidArgumentError, match="sync_episodes: expected a positive integer, got 0"):
        MinariRecorder("mpcoffline/test/sync-v0", sync_episodes=0)
