"""Every registered task with every kind of argument keeps Gymnasium's contract."""

from __future__ import annotations

import copy
import inspect
import pickle
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.envs import ENV_IDS, ControlTask, find_plant

A = [[1.0, 0.0, 0.1, 0.0], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.8, 0.0], [0.0, 0.0, 0.0, 0.8]]

PLANTS: dict[str, dict[str, Any]] = {
    LINEAR: {"A": A, "B": [[0.0, 0.0], [0.0, 0.0], [0.2, 0.0], [0.0, 0.2]]},
    PENDULUM: {"m": 1.3, "l": 0.7, "g": 3.7},
    CARTPOLE: {"m_c": 0.3, "m_p": 0.1, "l": 0.4, "mu": 0.2, "g": 3.7},
}


def cases() -> list[Any]:
    """All tasks with each argument alone, and with all together."""
    found = [pytest.param(LINEAR, {"alpha": 0.5}, id="LinearTracking-alpha")]
    for env_id in ENV_IDS:
        plant = find_plant(env_id)
        assert plant is not None
        each = {
            "defaults": {},
            "plant": PLANTS.get(env_id) or {p.name: 1.1 * float(p.value) for p in plant.parameters},
            "start": {"start": [-0.5, 0.5]},
            "process noise": {"process_noise": 0.05},
            "measurement noise": {"measurement_noise": [0.01 * (i + 1) for i in range(len(plant.states))]},
        }
        each["all"] = {key: value for one in each.values() for key, value in one.items()}
        name = env_id.split("/")[1].split("-")[0]
        found += [pytest.param(env_id, kwargs, id=f"{name}-{label}") for label, kwargs in each.items()]
    return found


every_case = pytest.mark.parametrize(("env_id", "kwargs"), cases())


def episode(env: gym.Env[Any, Any], seed: int, steps: int = 20) -> list[Any]:
    """Everything that a seeded episode with seeded actions returns."""
    env.action_space.seed(seed)
    observation, info = env.reset(seed=seed)
    rows = [observation, info["state"]]
    for _ in range(steps):
        observation, reward, _, _, info = env.step(env.action_space.sample())
        rows += [observation, info["state"], np.array([reward, info["cost"]])]
    return rows


def assert_same(first: list[Any], second: list[Any]) -> None:
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b, strict=True)


@every_case
def test_checkers_are_silent(env_id: str, kwargs: dict[str, Any]) -> None:
    check(gym.make(env_id, **kwargs), skip_render_check=True)
    check(gym.make(env_id, render_mode="rgb_array", **kwargs), skip_render_check=True)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_checkers_are_silent_about_every_render_mode(env_id: str) -> None:
    check(gym.make(env_id, render_mode="human"), skip_render_check=False)


def check(env: gym.Env[Any, Any], *, skip_render_check: bool) -> None:
    """Both libraries' checkers, warnings being errors; Gymnasium's tries all render modes, unless skipped."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Actions keep their physical units.
        warnings.filterwarnings("ignore", message=".*[Ww]e recommend .*(symmetric and )?normalized.*")
        gymnasium_check(env.unwrapped, skip_render_check=skip_render_check)
        sb3_check(env, skip_render_check=False)


@every_case
def test_made_by_module_and_id(env_id: str, kwargs: dict[str, Any]) -> None:
    first, second = gym.make(f"mpcoffline:{env_id}", **kwargs), gym.make(env_id, **kwargs)
    assert_same(episode(first, 0), episode(second, 0))
    assert isinstance(first.unwrapped, ControlTask)


@every_case
def test_the_spec_survives_json(env_id: str, kwargs: dict[str, Any]) -> None:
    env = gym.make(env_id, max_episode_steps=7, **kwargs)
    assert env.spec is not None
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.spec == env.spec
    assert_same(episode(env, 3, steps=7), episode(again, 3, steps=7))
    assert again.spec.kwargs == kwargs


@every_case
@pytest.mark.parametrize("duplicate", [lambda env: pickle.loads(pickle.dumps(env)), copy.deepcopy])
def test_a_copy_goes_on_as_the_original_does(env_id: str, kwargs: dict[str, Any], duplicate: Any) -> None:
    env = gym.make(env_id, render_mode="rgb_array", **kwargs)
    episode(env, 1)
    before: Any = env.render()
    again = duplicate(env)
    np.testing.assert_array_equal(again.render(), before)
    action = 0.3 * task(env).action_space.high
    for _ in range(70):  # beyond a block of noise
        first, second = env.step(action), again.step(action)
        np.testing.assert_array_equal(first[0], second[0])
        np.testing.assert_array_equal(first[4]["state"], second[4]["state"])
    np.testing.assert_array_equal(env.reset()[0], again.reset()[0])


@every_case
def test_the_same_seed_gives_the_same_episodes(env_id: str, kwargs: dict[str, Any]) -> None:
    env, other = gym.make(env_id, **kwargs), gym.make(env_id, **kwargs)
    first = episode(env, 5)
    env.reset()  # random numbers used in between do not matter
    assert_same(first, episode(env, 5))
    assert_same(first, episode(other, 5))
    assert not np.array_equal(first[-2], episode(env, 6)[-2])
    # Without a seed the random numbers go on: another start.
    assert not np.array_equal(env.reset()[1]["state"], env.reset()[1]["state"])


@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("length", [3, 250])
def test_another_length_of_the_task(env_id: str, length: int) -> None:
    env = gym.make(env_id, max_episode_steps=length)
    env.reset(seed=0)
    action = np.zeros(task(env).action_space.shape, np.float32)
    assert [env.step(action)[3] for _ in range(length)] == [False] * (length - 1) + [True]


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_the_documentation_page_is_complete(env_id: str) -> None:
    """Gymnasium's sections in its order; every argument and every space as it is."""
    plant = task(gym.make(env_id))
    page = type(plant).__doc__ or ""
    sections = [line.strip()[3:] for line in page.splitlines() if line.strip().startswith("## ")]
    assert sections == [
        *("Description", "Action Space", "Observation Space", "State Space", "Rewards", "Starting State"),
        *("Episode End", "Arguments", "Info", "Version History", "References"),
    ]
    arguments = page.split("## Arguments")[1].split("## Info")[0]
    parameters = list(inspect.signature(type(plant)).parameters)
    documented = [line.split("`")[1] for line in arguments.splitlines() if line.strip().startswith("| `")]
    assert documented == parameters
    bounds = ([c.low for c in plant.plant.inputs], [c.high for c in plant.plant.inputs])
    low, high = (str(bound if len(set(bound)) > 1 else bound[0]) for bound in bounds)
    assert f"Box({low}, {high}, {plant.action_space.shape}" in page
    rows = page.split("## State Space")[1].split("## Rewards")[0]
    assert "`state_space`" in rows
    assert plant.metadata["render_fps"] == round(1.0 / plant.dt)


def task(env: gym.Env[Any, Any]) -> ControlTask:
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, ControlTask)
    return unwrapped
