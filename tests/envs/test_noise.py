"""Process and measurement noise: where they enter, how large they are, and which random numbers they use."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.envs import ENV_IDS, ControlTask
from mpcoffline.envs.base import wrap_angle

Array = NDArray[np.float64]
SCALES = {LINEAR: [0.1, 0.2, 0.3, 0.4], PENDULUM: [0.1, 0.2], CARTPOLE: [0.1, 0.2, 0.3, 0.4]}


def make(env_id: str, **kwargs: Any) -> ControlTask:
    task = gym.make(env_id, **kwargs).unwrapped
    assert isinstance(task, ControlTask)
    return task


def angle_of(observation: Array, env_id: str) -> Array:
    """The state that an observation would be of, without noise."""
    cos = make(env_id).angle
    if cos is None:
        return observation
    phi = np.arctan2(observation[..., cos + 1], observation[..., cos])
    return np.concatenate([observation[..., :cos], phi[..., None], observation[..., cos + 2 :]], axis=-1)


def difference(a: Array, b: Array, task: ControlTask) -> Array:
    found = a - b
    if task.angle is not None:
        found[..., task.angle] = wrap_angle(found[..., task.angle])
    return found


def assert_standard_normal(draws: Array) -> None:
    """Columns are standard normal, independent of each other and of the draw before (p-values of seeded tests)."""
    for column in draws.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3
        assert abs(np.corrcoef(column[:-1], column[1:])[0, 1]) < 4.0 / np.sqrt(len(column))
    off_diagonal = np.corrcoef(draws.T) - np.eye(draws.shape[1])
    assert np.abs(off_diagonal).max() < 4.0 / np.sqrt(len(draws))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_noise_is_gaussian_of_the_given_size_and_enters_where_documented(env_id: str) -> None:
    scale = np.array(SCALES.get(env_id) or [0.05] * len(make(env_id).plant.states))
    task = make(env_id, process_noise=0.5 * scale, measurement_noise=scale)
    start = np.zeros(len(scale))
    action = 0.3 * task.action_space.high.astype(np.float64)
    process, measurement = [], []
    task.reset(seed=0)
    for _ in range(1500):
        observation, info = task.reset(options={"state": start})
        np.testing.assert_array_equal(info["state"], start)  # what is given is where it starts
        measurement.append(difference(angle_of(observation, env_id), start, task) / scale)
        observation, reward, _, _, info = task.step(action)
        assert info["cost"] == -float(reward) == float(task.cost(start, action))
        process.append(difference(info["state"], task.next_state(start, action), task) / (0.5 * scale))
        measurement.append(difference(angle_of(observation, env_id), info["state"], task) / scale)
    assert_standard_normal(np.hstack([np.array(process), np.array(measurement[::2]), np.array(measurement[1::2])]))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_measurement_noise_leaves_states_and_costs_as_they_are(env_id: str) -> None:
    quiet, noisy = make(env_id), make(env_id, measurement_noise=0.1)
    (_, first), (observed, second) = quiet.reset(seed=4), noisy.reset(seed=4)
    for _ in range(30):
        np.testing.assert_array_equal(first["state"], second["state"])
        assert first["cost"] == second["cost"]
        assert first["is_success"] == second["is_success"]
        assert not np.array_equal(observed, noisy.observe(second["state"]))
        action = np.full(quiet.action_space.shape, 0.7)
        *_, first = quiet.step(action)
        observed, *_, second = noisy.step(action)


@pytest.mark.parametrize("env_id", [PENDULUM, CARTPOLE])
def test_a_noisy_angle_is_still_a_point_on_the_circle(env_id: str) -> None:
    task = make(env_id, measurement_noise=1.0, process_noise=0.2)
    observation, info = task.reset(seed=0)
    cos = 0 if env_id == PENDULUM else 2
    for _ in range(200):
        assert np.hypot(observation[cos], observation[cos + 1]) == pytest.approx(1.0, abs=1e-6)
        assert task.observation_space.contains(observation)
        assert -np.pi < info["state"][task.angle] <= np.pi
        observation, _, _, _, info = task.step(np.zeros(1))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_noise_does_not_change_the_starts(env_id: str) -> None:
    quiet, noisy = make(env_id), make(env_id, process_noise=0.1, measurement_noise=0.1)
    for seed in (0, None, None, 3, None):
        expected, found = (task.reset(seed=seed)[1]["state"] for task in (quiet, noisy))
        np.testing.assert_array_equal(found, expected)
        for task in (quiet, noisy):
            task.step(np.zeros(task.action_space.shape))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_one_kind_of_noise_does_not_change_the_other(env_id: str) -> None:
    def states(measurement_noise: float) -> Array:
        task = make(env_id, process_noise=0.1, measurement_noise=measurement_noise)
        task.reset(seed=1)
        return np.array([task.step(np.zeros(task.action_space.shape))[4]["state"] for _ in range(20)])

    np.testing.assert_array_equal(states(0.0), states(0.3))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_observations_keep_their_bounds_in_long_and_wild_episodes(env_id: str) -> None:
    """States saturate: nothing becomes infinite, however long an unstable plant runs."""
    light = {"m_c": 0.01, "m_p": 0.05, "l": 0.05}
    kwargs = {LINEAR: {"alpha": 4.0}, PENDULUM: {"m": 0.01, "l": 0.05}, CARTPOLE: light}.get(env_id, {})
    task = make(env_id, process_noise=5.0, measurement_noise=50.0, **kwargs)
    observation, info = task.reset(seed=0)
    for _ in range(2000):
        assert task.observation_space.contains(observation)
        assert (np.abs(info["state"]) <= task.state_limit).all()
        observation, _, _, _, info = task.step(task.action_space.high)


@pytest.mark.parametrize("name", ["process_noise", "measurement_noise"])
@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf, [0.1], [0.1, 0.1, 0.1], "0.1", None, [[0.1, 0.1]], True])
def test_bad_noise_is_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"{name}: expected a standard deviation >= 0, or 2 of them"):
        make(PENDULUM, **{name: value})
