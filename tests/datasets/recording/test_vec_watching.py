"""The recorder below wrappers that change rewards, observations and actions: against what the plant itself notes."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from drift_plant import Drift, HalfObservation, Plain, Tenth, Twice, costly, unsafe
from gymnasium import wrappers
from stable_baselines3 import DDPG
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
)

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets import MinariRecorder, verify

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


class Tenfold(VecEnvWrapper):
    """Scales all that passes: rewards, observations in place, actions."""

    def reset(self) -> Any:
        return 10.0 * self.venv.reset()

    def step_async(self, actions: Any) -> None:
        self.venv.step_async(0.1 * actions)

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        observations *= 10.0
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = 10.0 * info["terminal_observation"]
        return observations, 10.0 * rewards, dones, infos


def recorded(env: Any, steps: int = 35, **options: Any) -> tuple[Any, DDPG]:
    agent = DDPG("MlpPolicy", env, learning_starts=10**9, buffer_size=500, seed=0, device="cpu")
    recorder = MinariRecorder("test/vec-v0", overwrite=True, **options)
    agent.learn(steps, callback=recorder)
    assert recorder.dataset is not None
    assert verify(recorder.dataset).ok
    return recorder.dataset, agent


def rewards_of(dataset: Any) -> list[float]:
    return [float(reward) for episode in dataset for reward in episode.rewards]


def check_physics(dataset: Any) -> None:
    """x+ = x + u holds for what was recorded, in the plant's units."""
    for episode in dataset:
        assert episode.observations.shape[1:] == (1,)
        np.testing.assert_allclose(np.diff(episode.observations, axis=0), episode.actions, atol=1e-5)


@pytest.mark.parametrize("info", [None, costly, unsafe])
@pytest.mark.parametrize(
    "wrapped",
    [
        lambda venv: VecNormalize(venv, norm_obs=True, norm_reward=True),
        lambda venv: VecNormalize(venv, norm_obs=False, norm_reward=True),
        Tenfold,
        lambda venv: VecNormalize(Tenfold(venv)),
        lambda venv: Tenfold(VecNormalize(venv)),
        lambda venv: VecFrameStack(venv, 3),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_what_the_plant_paid_is_recorded_below_the_wrappers_of_a_vec_env(
    wrapped: Callable[[VecEnv], VecEnv], info: Any
) -> None:
    plant = Drift(info=info)
    dataset, _ = recorded(wrapped(DummyVecEnv([lambda: plant])))
    assert rewards_of(dataset) == plant.paid  # every digit
    assert [len(episode.rewards) for episode in dataset] == [10, 10, 10, 5]
    assert [("cost" in episode.infos) for episode in dataset] == [info is costly] * 4
    check_physics(dataset)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: wrappers.TransformReward(env, lambda reward: 0.1 * reward),
        wrappers.NormalizeReward,
        lambda env: wrappers.ClipReward(env, -0.1, 0.1),
        Monitor,
        Plain,
    ],
)
@pytest.mark.parametrize("info", [None, costly, unsafe])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_what_the_plant_paid_is_recorded_below_wrappers_of_each_environment(wrap: Any, info: Any) -> None:
    plants = [Drift(info=info), Drift(info=info)]
    dataset, _ = recorded(DummyVecEnv([lambda p=p: wrap(p) for p in plants]), steps=40)
    assert sorted(rewards_of(dataset)) == sorted(plants[0].paid + plants[1].paid)
    check_physics(dataset)


def test_a_changed_reward_that_counts_is_told_of() -> None:
    env = wrappers.TransformReward(Drift(), lambda reward: 0.1 * reward)
    with pytest.warns(UserWarning, match="MinariRecorder: a wrapper makes .* of the plant's reward") as told:
        recorded(env)
    assert len([each for each in told if "MinariRecorder" in str(each.message)]) == 1


def test_an_action_that_is_repeated_earns_the_sum() -> None:
    plant = Drift(length=20, info=costly)
    with pytest.warns(UserWarning, match=r"info\['cost'\]"):
        dataset, _ = recorded(Twice(plant), steps=10)
    assert rewards_of(dataset) == [a + b for a, b in zip(plant.paid[::2], plant.paid[1::2], strict=True)]


def test_coinciding_costs_do_not_mix_with_rewards() -> None:
    """The key agrees with the reward for twelve steps, then no more: all of the second episode is by the reward."""

    def info(k: int, cost: float) -> dict[str, Any]:
        calls.append(k)
        return {"cost": cost if len(calls) < 15 else 0.0}

    calls: list[int] = []
    plant = Drift(info=info)
    with pytest.warns(UserWarning, match="the reward counts"):
        dataset, _ = recorded(plant)
    assert [("cost" in episode.infos) for episode in dataset] == [True, False, False, False]
    assert rewards_of(dataset) == plant.paid


@pytest.mark.parametrize("number", [lambda c: np.array([c]), np.float64, lambda c: [c]])
def test_costs_in_arrays_of_one(number: Any) -> None:
    dataset, _ = recorded(Drift(info=lambda k, cost: {"cost": number(cost)}))
    assert all(episode.infos["cost"].shape == (len(episode.rewards) + 1, 1) for episode in dataset)


@pytest.mark.parametrize("state", [{"x": 1.0}, "rest", None])
def test_states_that_are_no_numbers_are_left_out(state: Any) -> None:
    with pytest.warns(UserWarning, match=r"MinariRecorder: info\['state'\] is .*left out"):
        dataset, _ = recorded(Drift(info=lambda k, cost: {"cost": cost, "state": state}))
    assert all(set(episode.infos) == {"cost"} for episode in dataset)


def test_states_of_changing_shape_are_left_out_from_that_episode_on() -> None:
    calls: list[int] = []

    def info(k: int, cost: float) -> dict[str, Any]:
        calls.append(k)
        return {"state": np.zeros(2 if len(calls) < 15 else 3)}

    with pytest.warns(UserWarning, match=r"of shape \(3,\)"):
        dataset, _ = recorded(Drift(info=info))
    assert [bool(episode.infos) for episode in dataset] == [True, False, False, False]


def test_a_claimed_key_is_recorded_as_the_cost_or_refused() -> None:
    plant = Drift(info=lambda k, cost: {"energy": cost, "cost": 0.0})
    dataset, _ = recorded(plant, cost_key="energy")
    for episode in dataset:
        np.testing.assert_array_equal(episode.infos["cost"][1:, 0], -episode.rewards)
    with pytest.raises(InvalidArgumentError, match=r"info\['price'\]"):
        recorded(Drift(info=costly), cost_key="price")
    with pytest.raises(InvalidDataError, match=r"info\['cost'\].*minus the reward"):
        recorded(Drift(info=unsafe), cost_key="cost")


def test_copies_with_different_arguments_are_refused_by_name() -> None:
    env = DummyVecEnv([lambda m=m: gym.make(PENDULUM, m=m) for m in (1.0, 1.0, 1.5)])
    with pytest.raises(InvalidArgumentError, match=r"copies of one.*'m': 1\.0.*'m': 1\.5.*as number 2"):
        recorded(env)
    same = DummyVecEnv([lambda m=m: gym.make(PENDULUM, m=m) for m in (1.5, np.float64(1.5), np.float32(1.5))])
    dataset, _ = recorded(same, steps=6)
    assert dataset.env_spec.kwargs == {"m": 1.5}


def test_arrays_as_arguments_are_stored_and_rebuilt() -> None:
    noise = np.array([0.0, 0.1], np.float32)
    dataset, _ = recorded(gym.make(PENDULUM, measurement_noise=noise))
    env = dataset.recover_environment()
    np.testing.assert_array_equal(env.unwrapped.measurement_noise, noise.astype(np.float64))


def test_nothing_stays_behind_and_no_random_number_is_drawn() -> None:
    plant = Drift()
    venv = VecNormalize(DummyVecEnv([lambda: Monitor(plant)]))
    _, agent = recorded(venv)
    for each in (plant, venv, venv.venv, venv.venv.envs[0]):
        assert not {"step", "step_wait", "step_async"} & vars(each).keys()
    other = Drift()
    again = DDPG(
        "MlpPolicy",
        VecNormalize(DummyVecEnv([lambda: Monitor(other)])),
        **{"learning_starts": 10**9, "buffer_size": 500, "seed": 0, "device": "cpu"},
    )
    again.learn(35)
    assert other.paid == plant.paid
    np.testing.assert_array_equal(agent.replay_buffer.rewards, again.replay_buffer.rewards)  # type: ignore[union-attr]


def test_a_copy_of_a_watched_environment_is_another_environment() -> None:
    """A callback that plans on copies steps them, not the plant."""
    from mpcoffline.datasets.recording.watching import watched

    env = Plain(Drift())
    with watched(env) as watch:
        env.reset(seed=0)
        twin = copy.deepcopy(env)
        twin.step(np.ones(1, np.float32))
        assert env.unwrapped.paid == []
        assert watch.reward is None
        assert len(twin.unwrapped.paid) == 1
        env.step(np.zeros(1, np.float32))
        assert watch.reward == env.unwrapped.paid[0]
    assert "step" not in vars(env)


def test_scaled_observations_without_a_changed_space_are_told_of() -> None:
    with pytest.warns(UserWarning, match="a wrapper makes .* of the plant's observation"):
        recorded(HalfObservation(Drift()))


@pytest.mark.slow
def test_in_other_processes_what_the_vec_env_gives_counts() -> None:
    env = SubprocVecEnv([lambda: Tenth(gym.make(f"mpcoffline:{PENDULUM}"))])
    with pytest.warns(UserWarning, match="the reward counts"):
        dataset, agent = recorded(VecNormalize(env))
    buffer = agent.replay_buffer
    assert buffer is not None
    np.testing.assert_allclose(rewards_of(dataset), buffer.rewards[:35, 0], rtol=1e-6)
    env.close()
    stacked = SubprocVecEnv([lambda: gym.make(f"mpcoffline:{PENDULUM}")])
    with pytest.raises(InvalidArgumentError, match="VecFrameStack around SubprocVecEnv"):
        recorded(VecFrameStack(stacked, 2))
    stacked.close()


def test_our_own_environments_record_without_a_word() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dataset, _ = recorded(VecNormalize(DummyVecEnv([lambda: gym.make(PENDULUM)])))
    task: Any = gym.make(PENDULUM).unwrapped
    for episode in dataset:
        cost = task.cost(episode.infos["state"][:-1], episode.actions.astype(np.float64))
        np.testing.assert_array_equal(episode.rewards, -cost)
