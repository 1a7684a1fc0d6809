"""Data of other tools simulated again: from seeds where there are no states, and by the one rule for costs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from drift_plant import Drift, Zero, unsafe
from minari.data_collector import EpisodeBuffer

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.datasets import record, replay
from mpcoffline.datasets.store.writing import write_dataset

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


class Unsafe(Drift):
    """Says 1 for a violated limit under the key of the cost, and its state; starts from one."""

    def __init__(self, gain: float = 1.0) -> None:
        super().__init__(info=lambda k, cost: unsafe(k, cost) | {"state": [self.x]}, gain=gain)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observation, info = super().reset(seed=seed)
        if options is None:
            return observation, info
        self.x = float(options["state"][0])
        return self._observed(), {"state": [self.x]}


@pytest.fixture
def ids() -> Iterator[tuple[str, str]]:
    gym.register("test/Drift-v0", entry_point="drift_plant:Drift", disable_env_checker=True)
    gym.register("test/Unsafe-v0", entry_point=f"{__name__}:Unsafe", disable_env_checker=True)
    yield "test/Drift-v0", "test/Unsafe-v0"
    for name in ("test/Drift-v0", "test/Unsafe-v0"):
        gym.registry.pop(name)


def collected(
    env_id: str, name: str, *, options: Any = None, said: tuple[Any, ...] = (5, 6, 7), **arguments: Any
) -> Any:
    """Three episodes as Minari's own collector stores them: with the seed of each reset, and no infos."""
    env = gym.make(env_id, **arguments)
    env.action_space.seed(0)
    buffers = []
    for seed, stated in zip((5, 6, 7), said, strict=True):
        observations, actions, rewards, done = [env.reset(seed=seed, options=options)[0]], [], [], False
        while not done:
            actions.append(env.action_space.sample())
            observation, reward, terminated, truncated, _ = env.step(actions[-1])
            observations.append(observation)
            rewards.append(reward)
            done = terminated or truncated
        ends = np.arange(len(actions)) == len(actions) - 1
        columns: dict[str, Any] = {
            "observations": np.array(observations)
            if isinstance(observations[0], np.ndarray)
            else {key: np.array([each[key] for each in observations]) for key in observations[0]},
            "actions": np.array(actions),
            "rewards": np.array(rewards),
            "terminations": ends & terminated,
            "truncations": ends & (not terminated),
        }
        buffers.append(EpisodeBuffer(**columns, seed=stated, options=options, infos={}))
    return write_dataset(
        name, buffers, env_spec=env.spec, observation_space=env.observation_space, action_space=env.action_space
    )


@pytest.mark.parametrize("arguments", [{}, {"measurement_noise": 0.1, "process_noise": 0.01}])
def test_seeds_are_enough(arguments: dict[str, Any]) -> None:
    report = replay(collected(PENDULUM, "test/seeds-v0", max_episode_steps=8, **arguments))
    assert report.bitwise
    assert (report.episodes, report.steps, report.skipped) == (3, 24, ())
    assert set(report.free_run) == {"observation", "cost"}
    assert report.one_step == {}


def test_options_of_the_reset_are_used() -> None:
    dataset = collected(PENDULUM, "test/options-v0", options={"start": "hanging"}, max_episode_steps=8)
    assert replay(dataset).bitwise


def test_seeds_work_in_other_peoples_environments() -> None:
    report = replay(collected("MountainCarContinuous-v0", "test/car-v0", max_episode_steps=20))
    assert report.bitwise
    assert report.steps == 60


def test_another_seed_is_noticed() -> None:
    report = replay(collected(PENDULUM, "test/other-v0", said=(5, 99, 7), max_episode_steps=8))
    assert not report.ok
    assert report.free_run["observation"].episode == 1


def test_a_damaged_seed_is_no_seed() -> None:
    report = replay(collected(PENDULUM, "test/negative-v0", said=(-3, 6, 7), max_episode_steps=8))
    assert [number for number, _ in report.skipped] == [0]
    assert report.episodes == 2
    dataset = collected(PENDULUM, "test/text-v0", said=("many", 6, 7), max_episode_steps=8)
    with pytest.raises(InvalidDataError, match="infos/state: expected the state at every step, or the seed"):
        replay(dataset)


def test_a_key_that_is_not_the_cost_is_not_compared_with_it(ids: tuple[str, str]) -> None:
    with pytest.warns(UserWarning, match=r"record: info\['cost'\]"):
        dataset = record(ids[1], Zero(0.5), 3, "test/unsafe-v0", seed=0)
    with pytest.warns(UserWarning, match=r"replay: info\['cost'\]"):
        report = replay(dataset)
    assert report.bitwise
    assert set(report.free_run) == {"observation", "state", "cost"}


def test_observations_that_are_no_arrays_are_refused_by_name() -> None:
    env_id = "test/Dict-v0"
    gym.register(env_id, entry_point=f"{__name__}:DictDrift", disable_env_checker=True)
    try:
        dataset = collected(env_id, "test/dict-v0")
        with pytest.raises(InvalidDataError, match="observations: expected one array of numbers, got Dict"):
            replay(dataset)
    finally:
        gym.registry.pop(env_id)


class DictDrift(Drift):
    """Gives its observation in a dictionary."""

    observation_space = gym.spaces.Dict({"x": Drift.observation_space})  # type: ignore[assignment]

    def _observed(self) -> Any:
        return {"x": super()._observed()}


def test_no_window_is_opened(ids: tuple[str, str]) -> None:
    class Windowed(Drift):
        metadata = {"render_modes": ["human"], "render_fps": 50}  # noqa: RUF012 -- gymnasium's

        def __init__(self, render_mode: str | None = None) -> None:
            super().__init__()
            modes.append(render_mode)

    modes: list[str | None] = []
    dataset = collected(ids[0], "test/window-v0")
    registered = gym.registry[ids[0]]
    registered.entry_point = Windowed
    spec = dataset.env_spec
    assert spec is not None
    spec.entry_point, spec.kwargs = Windowed, {"render_mode": "human"}
    dataset.spec.env_spec = spec
    dataset._env_spec = spec
    assert replay(dataset).bitwise
    assert modes == [None]
    np.testing.assert_array_equal(dataset.episode_indices, np.arange(3))
