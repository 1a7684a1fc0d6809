"""Data simulated again: bitwise here, deviations named, and nothing imported that a file names."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from pendulum_data import PENDULUM, recorded, resealed, stored
from rich.console import Console

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError, UnknownIdError
from mpcoffline.datasets.check.replaying import recover_environment, replay
from mpcoffline.datasets.store.writing import write_dataset
from mpcoffline.envs import ENV_IDS

LINEAR = "mpcoffline/LinearTracking-v0"
EVIL = "evil_environment_of_a_download"


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_what_was_recorded_here_is_repeated_bit_for_bit(env_id: str) -> None:
    dataset = stored("test/full-v0", env_id=env_id, episodes=recorded(100, 3, env_id=env_id))
    for given in (dataset, "test/full-v0"):
        report = replay(given)
        assert report.ok
        assert report.bitwise
        assert (report.env_id, report.episodes, report.steps) == (env_id, 3, 300)
        assert all(d.absolute == 0.0 for d in (*report.free_run.values(), *report.one_step.values()))
        assert "bitwise equal (3 episodes, 300 steps)" in str(report)


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_shipped_data_are_repeated() -> None:
    report = replay("mpcoffline/pendulum/ddpg-v0", n_episodes=5)
    assert report.ok
    assert (report.episodes, report.steps, report.skipped) == (5, 500, ())


def test_a_deviation_has_a_size_and_a_place() -> None:
    episodes = recorded(episodes=3)
    episodes[1].observations[2, 0] += 0.25  # type: ignore[index]
    episodes[2].rewards[3] -= 1e-7
    report = replay(stored(episodes=episodes))
    assert not report.ok
    assert not report.bitwise
    found = report.free_run["observation"]
    assert (found.episode, found.step) == (1, 2)
    assert found.absolute == pytest.approx(0.25, abs=1e-6)
    cost = report.one_step["cost"]
    assert (cost.episode, cost.step) == (2, 4)
    assert cost.absolute == pytest.approx(1e-7, rel=1e-6)
    assert report.free_run["state"].absolute == 0.0
    lenient = replay("test/set-v0", tolerances={"cost": 1e-6, "observation": 1.0})
    assert lenient.ok
    assert not lenient.bitwise
    console = Console(width=120, record=True)
    console.print(report)
    assert "(episode 1, step 2)" in console.export_text()


def test_errors_pile_up_over_episodes_but_not_over_single_steps() -> None:
    """A state that jumps once: the whole episode stays off, of the single steps two do."""
    episodes = recorded(length=20, episodes=1)
    states = episodes[0].infos["state"]  # type: ignore[index]
    env = gym.make(PENDULUM)
    env.reset(options={"state": states[10] + np.array([1e-9, 0.0])})
    states[10] += np.array([1e-9, 0.0])
    for k in range(10, 20):
        observation, reward, _, _, info = env.step(episodes[0].actions[k])
        states[k + 1], episodes[0].observations[k + 1] = info["state"], observation  # type: ignore[index]
        episodes[0].rewards[k], episodes[0].infos["cost"][k + 1] = reward, info["cost"]  # type: ignore[index]
    report = replay(stored(episodes=episodes), tolerances={"state": 1e-8})
    assert report.ok
    assert report.one_step["state"].step == 10
    assert report.one_step["state"].absolute == pytest.approx(1e-9, rel=1e-3)
    assert report.free_run["state"].absolute > 1.2e-9
    assert (report.free_run["state"].step or 0) > 10


def test_another_plant_is_noticed() -> None:
    episodes = recorded(100, 1, env_id=LINEAR, alpha=0.5)
    dataset = stored("test/alpha-v0", env_id=LINEAR, alpha=0.5, episodes=episodes)
    assert replay(dataset).bitwise
    path = Path(dataset.spec.data_path) / "metadata.json"
    path.write_text(path.read_text().replace('\\"alpha\\": 0.5', '\\"alpha\\": 0.6'))
    resealed("test/alpha-v0")
    report = replay("test/alpha-v0")
    assert not report.ok
    assert report.one_step["state"].absolute > 1e-3


def test_terminations_are_compared() -> None:
    report = replay(stored(episodes=recorded(episodes=2, terminate=True)))
    assert report.wrong_ends == (1,)
    assert not report.ok
    assert "terminations differ in episodes 1" in str(report)


def test_an_episode_joined_halfway_begins_where_its_state_is_known() -> None:
    episodes = recorded(episodes=3)
    for key in ("cost", "state"):
        episodes[0].infos[key][0] = np.nan  # type: ignore[index]
    episodes[1].infos["state"][:] = np.nan  # type: ignore[index]
    episodes[2].infos["state"][0] = 1e9  # type: ignore[index]
    report = replay(stored(episodes=episodes))
    assert report.bitwise
    assert (report.episodes, report.steps) == (1, 4)
    assert [number for number, _ in report.skipped] == [1, 2]
    assert "2 skipped" in report.headline
    assert "episode 2 skipped: reset option 'state'" in str(report)


def test_nothing_simulated_is_not_ok() -> None:
    episodes = recorded(episodes=1)
    episodes[0].infos["state"][:] = np.nan  # type: ignore[index]
    report = replay(stored(episodes=episodes))
    assert not report.ok
    assert not report.bitwise


def test_a_changed_shape_is_an_infinite_deviation() -> None:
    episodes = recorded(episodes=1)
    wide: Any = np.asarray(episodes[0].observations)[:, :2]
    space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    report = replay(stored(episodes=[replace(episodes[0], observations=wide)], observation_space=space))
    assert report.free_run["observation"].absolute == math.inf
    assert not report.ok


@pytest.mark.parametrize("noise", ["process_noise", "measurement_noise"])
def test_noise_cannot_be_simulated_again(noise: str) -> None:
    env = gym.make(PENDULUM, **{noise: 0.01})
    dataset = write_dataset(
        "test/noisy-v0",
        recorded(**{noise: 0.01}),
        env_spec=env.spec,
        observation_space=env.observation_space,
        action_space=env.action_space,
    )
    with pytest.raises(InvalidDataError, match="expected an environment without noise"):
        replay(dataset)


def test_what_cannot_be_replayed_says_why() -> None:
    episodes = [replace(episode, infos={}) for episode in recorded()]
    with pytest.raises(InvalidDataError, match="episode 0: infos/state: expected the state at every step"):
        replay(stored("test/plain-v0", episodes=episodes))
    with pytest.raises(InvalidDataError, match="environment that it was recorded in"):
        replay(stored("test/alone-v0", env_spec=None))
    foreign = stored("test/foreign-v0", env_spec=gym.spec("CartPole-v1"))
    with pytest.raises(InvalidDataError, match=r"starts from reset\(options"):
        replay(foreign)
    for wrong in (0, -1):
        with pytest.raises(InvalidArgumentError, match="n_episodes"):
            replay("test/plain-v0", wrong)
    with pytest.raises(InvalidArgumentError, match="tolerances"):
        replay("test/plain-v0", tolerances={"speed": 1.0})
    with pytest.raises(UnknownIdError, match="data set id"):
        replay("test/nothing-v0")


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module that leaves a trace when it is imported; it holds an environment and a wrapper."""
    trace = tmp_path / "trace"
    (tmp_path / f"{EVIL}.py").write_text(
        f"import pathlib\npathlib.Path({str(trace)!r}).touch()\n"
        "import gymnasium\nfrom mpcoffline.envs import PendulumSwingUpEnv as Env\n"
        "class Wrapper(gymnasium.Wrapper):\n    pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield trace
    sys.modules.pop(EVIL, None)


@pytest.mark.parametrize("way", ["entry point", "registered id", "module in id", "wrapper"])
def test_nothing_is_imported_that_a_file_names(evil: Path, way: str) -> None:
    dataset = stored()
    path = Path(dataset.spec.data_path) / "metadata.json"
    metadata = json.loads(path.read_text())
    spec = json.loads(metadata["env_spec"])
    if way == "wrapper":
        spec["additional_wrappers"] = [{"name": "W", "entry_point": f"{EVIL}:Wrapper", "kwargs": {}}]
    else:
        spec["entry_point"] = f"{EVIL}:Env"
        spec["id"] = {"registered id": PENDULUM, "entry point": "evil/Env-v0"}.get(way, f"{EVIL}:evil/Env-v0")
    metadata["env_spec"] = json.dumps(spec)
    path.write_text(json.dumps(metadata))
    resealed()
    with pytest.raises((UnknownIdError, InvalidDataError), match=r"data set 'test/set-v0'.*environment"):
        replay("test/set-v0")
    assert EVIL not in sys.modules
    assert not evil.exists()
    if way in ("entry point", "registered id"):
        assert replay("test/set-v0", allow_import=True).ok
        assert evil.exists()


def test_a_missing_module_is_named() -> None:
    dataset = stored()
    path = Path(dataset.spec.data_path) / "metadata.json"
    path.write_text(path.read_text().replace("mpcoffline.envs.pendulum_swing_up", "not_here.pendulum"))
    resealed()
    with pytest.raises(UnknownIdError, match=r"not_here\.pendulum.*allow_import"):
        replay("test/set-v0")
    with pytest.raises(InvalidDataError, match=r"No module named 'not_here'.*Install the package"):
        replay("test/set-v0", allow_import=True)


def test_the_environment_has_the_arguments_of_the_data_set() -> None:
    env = gym.make(LINEAR, alpha=0.25, max_episode_steps=7)
    dataset = stored("test/linear-v0", env_spec=env.spec)
    again = recover_environment(dataset)
    assert again.unwrapped.alpha == 0.25  # type: ignore[attr-defined]
    assert again.spec is not None
    assert again.spec.max_episode_steps == 7
