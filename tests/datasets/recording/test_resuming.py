"""What goes on is the same recording; another one is refused or kept elsewhere, and the lock goes with its process."""

from __future__ import annotations

import os
import signal
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
from crashing import DATASET, check_survivors, episode, recording
from gymnasium import spaces
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

import mpcoffline.envs  # noqa: F401
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets import MinariRecorder, dataset_from_arrays, record, repair
from mpcoffline.datasets.recipes import Recipe
from mpcoffline.datasets.store.recording_lock import RecordingLock, log_files
from mpcoffline.gallery.collection import collect_with

PENDULUM = "mpcoffline/PendulumSwingUp-v0"
CUT = "test/cut-v0"


def first_actions(dataset: minari.MinariDataset) -> list[float]:
    return [float(found.actions[0, 0]) for found in dataset.iterate_episodes()]


class Constant:
    """A policy that fails in its third episode, unless it is told not to."""

    def __init__(self, value: float, fails: bool = False) -> None:
        self.value, self.calls, self.fails = value, 0, fails

    def __call__(self, observation: Any) -> Any:
        self.calls += 1
        if self.fails and self.calls == 250:
            raise RuntimeError("power cut")
        return np.array([self.value], np.float32)


@pytest.fixture
def interrupted() -> Path:
    """The log of a recording of five episodes that broke off in the third."""
    with pytest.raises(RuntimeError, match="power cut"):
        record(PENDULUM, Constant(1.5, fails=True), 5, CUT, seed=3)
    return log_files(CUT)[0]


def test_the_same_recording_goes_on_and_says_so(interrupted: Path) -> None:
    policy = Constant(1.5)
    with pytest.warns(UserWarning, match="2 episodes of an interrupted recording .* are continued; resume=False"):
        dataset = record(PENDULUM, policy, 5, CUT, seed=3)
    assert policy.calls == 300
    assert (dataset.total_episodes, dataset.total_steps) == (5, 500)


def corrected(observation: Any) -> Any:
    return np.array([-0.5], np.float32)


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("policy", {"policy": corrected}),
        ("seed", {"seed": 4}),
        ("number of episodes", {"n_episodes": 3}),
        ("algorithm", {"algorithm_name": "another"}),
        ("deterministic", {"deterministic": False}),
        ("environment", {"env": gym.make(PENDULUM, m=2.0)}),
        ("environment", {"env": gym.make("mpcoffline/CartPoleSwingUp-v0")}),
    ],
)
def test_another_recording_starts_anew_and_loses_nothing(what: str, change: dict[str, Any], interrupted: Path) -> None:
    content = interrupted.read_bytes()
    arguments = {"env": PENDULUM, "policy": Constant(-0.5), "n_episodes": 5, "seed": 3, **change}
    with pytest.warns(UserWarning, match=rf"{what} .*Its 2 episodes are kept in (.*)\.$") as told:
        dataset = record(dataset_id=CUT, overwrite=True, **arguments)
    assert first_actions(dataset) == [-0.5] * arguments["n_episodes"]
    kept = Path(str(told[0].message).split("kept in ")[1][:-1])
    assert (kept / interrupted.name).read_bytes() == content
    assert not log_files(CUT)


def test_declining_to_resume_deletes_what_there_is(interrupted: Path, store: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dataset = record(PENDULUM, Constant(0.5), 5, CUT, seed=3, resume=False)
    assert first_actions(dataset) == [0.5] * 5
    assert not (store / ".broken").exists()
    interrupted.parent.mkdir(parents=True)
    interrupted.write_bytes(b"damaged")
    record(PENDULUM, Constant(0.5), 1, CUT, seed=3, resume=False, overwrite=True)


def agent_on(env: Any, algorithm: type[Any] = DDPG, **arguments: Any) -> Any:
    settings = {"learning_starts": 10**9, "buffer_size": 2000, "seed": 0, "device": "cpu", **arguments}
    return algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, **settings)


class BreakOff(BaseCallback):
    """Ctrl-C after so many steps."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self.after = after

    def _on_step(self) -> bool:
        if self.n_calls >= self.after:
            raise KeyboardInterrupt
        return True


def test_a_recorder_goes_on_with_its_algorithm_only() -> None:
    with pytest.raises(KeyboardInterrupt):
        agent_on(gym.make(PENDULUM)).learn(300, callback=[first := MinariRecorder(CUT), BreakOff(150)])
    first.close()
    with pytest.raises(InvalidArgumentError, match=r"algorithm: expected that of .*: DDPG, got TD3.*repair.*resume=F"):
        agent_on(gym.make(PENDULUM), TD3).learn(50, callback=MinariRecorder(CUT))
    with pytest.warns(UserWarning, match=r"1 episodes of an interrupted .* seed \(0\) .* same episodes again"):
        agent_on(gym.make(PENDULUM)).learn(50, callback=MinariRecorder(CUT))
    assert minari.load_dataset(CUT).total_steps == 150


class Tank(gym.Env[Any, Any]):
    """A plant without a spec."""

    observation_space: spaces.Space[Any] = spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space: spaces.Space[Any] = spaces.Box(-1.0, 1.0, (1,), np.float32)
    made = 0

    def __init__(self) -> None:
        Tank.made += 1
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return self.observation_space.sample(), 0.0, False, self.steps % 10 == 0, {}


class Pump(Tank):
    """Another one with the same spaces."""


@pytest.mark.parametrize(
    ("first", "second", "named"),
    [
        (lambda: gym.make(PENDULUM), lambda: gym.make("mpcoffline/CartPoleSwingUp-v0"), r"Pendulum.*got .*CartPole"),
        (lambda: gym.make(PENDULUM, m=1.0), lambda: gym.make(PENDULUM, m=2.0), r"'m': 1.0.*got .*'m': 2.0"),
        (Tank, Pump, r"Tank, got Pump"),
    ],
)
def test_one_recorder_holds_one_plant(first: Any, second: Any, named: str, store: Path) -> None:
    recorder = MinariRecorder(CUT)
    agent_on(first()).learn(20, callback=recorder)
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    other = agent_on(second())
    with pytest.raises(InvalidArgumentError, match=rf"environment of what extends .*{named}.*One data set"):
        other.learn(20, callback=recorder)
    assert other.num_timesteps == 0
    assert {path: path.read_bytes() for path in store.rglob("*") if path.is_file()} == before
    agent_on(first()).learn(20, callback=recorder)
    assert minari.load_dataset(CUT).total_steps == 40


@pytest.mark.parametrize("way", ["set_env", "load", "more environments", "without a monitor"])
def test_the_first_row_is_that_of_the_state_it_starts_from(way: str, tmp_path: Path) -> None:
    agent, recorder = agent_on(gym.make(PENDULUM)), MinariRecorder(CUT)
    agent.learn(150, callback=recorder)
    if way == "set_env":
        agent.set_env(gym.make(PENDULUM))
    else:
        agent.save(tmp_path / "agent.zip")
        count = 3 if way == "more environments" else 1
        env = DummyVecEnv([lambda: gym.make(PENDULUM)] * count) if way != "load" else gym.make(PENDULUM)
        agent = DDPG.load(tmp_path / "agent.zip", env=env)
    agent.learn(150, callback=recorder, reset_num_timesteps=False)
    task = gym.make(PENDULUM).unwrapped
    dataset = minari.load_dataset(CUT)
    assert dataset.total_steps == 300
    for found in dataset.iterate_episodes():
        np.testing.assert_array_equal(found.observations, task.observe(found.infos["state"]))


def test_no_second_plant_is_made() -> None:
    Tank.made = 0
    gym.register("test/Tank-v0", f"{__name__}:Tank")
    try:
        wrapped = gym.wrappers.RescaleObservation(gym.make("test/Tank-v0"), np.float32(0.0), np.float32(9.0))
        with pytest.warns(UserWarning, match=r"changes the observation_space to Box\(0.0, 9.0.*gives Box\(-1.0, 1.0"):
            agent_on(wrapped).learn(20, callback=MinariRecorder(CUT))
    finally:
        gym.registry.pop("test/Tank-v0")
    assert Tank.made == 1


def break_off(recipe: Recipe, after: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mpcoffline.gallery.collection._StopAt", lambda steps: BreakOff(after))
        with pytest.raises(KeyboardInterrupt):
            collect_with(recipe, overwrite=True, progress=False)


def test_collecting_again_gives_what_was_asked_for() -> None:
    recipe = Recipe.load("linear").vary(steps=300, seed=1, dataset_id=CUT)
    whole, _ = collect_with(recipe, progress=False)
    expected = [found.observations for found in whole.iterate_episodes()]
    for _ in range(2):
        break_off(recipe, 150)
    with pytest.warns(UserWarning, match="1 episodes of an interrupted recording of 'test/cut-v0' are recorded anew"):
        again, _ = collect_with(recipe, overwrite=True, progress=False)
    for found, wanted in zip(again.iterate_episodes(), expected, strict=True):
        np.testing.assert_array_equal(found.observations, wanted)


def test_an_interrupted_collection_can_be_repaired() -> None:
    recipe = Recipe.load("linear").vary(steps=300, dataset_id=CUT)
    break_off(recipe, 250)
    assert repair(CUT).episodes == 2


@pytest.mark.parametrize("end", ["close", "kill"])
def test_the_lock_goes_with_the_process_that_records(end: str) -> None:
    ours, theirs = os.pipe()
    recorder = os.fork()
    if recorder == 0:
        recorded = recording()
        recorded.append(0, episode(0), complete=True)
        child = os.fork()  # as multiprocessing makes its workers
        if child == 0:
            try:
                recorded.append(0, episode(1), complete=True)
            except InvalidArgumentError:
                os.write(theirs, b"refused ")
            signal.pause()
        os.write(theirs, f"{child} ".encode())
        if end == "close":
            recorded.close()
        os.write(theirs, b"done")
        signal.pause()
    said = b""
    while b"done" not in said or b"refused" not in said:
        said += os.read(ours, 100)
    child = next(int(word) for word in said.split() if word.isdigit())
    try:
        if end == "kill":
            os.kill(recorder, signal.SIGKILL)
            os.waitpid(recorder, 0)
        assert check_survivors(1) == 1
    finally:
        os.kill(child, signal.SIGKILL)
        if end == "close":
            os.kill(recorder, signal.SIGKILL)
            os.waitpid(recorder, 0)


def test_the_holder_that_is_named_lives(store: Path) -> None:
    lock = RecordingLock(DATASET)
    (lock.folder / "lock").write_text(f"process 4194305 on {os.uname().nodename}")
    with pytest.raises(InvalidArgumentError, match=r"another one at work \(another process\)"):
        RecordingLock(DATASET)
    lock.release()
    assert not list(store.rglob("*"))


def test_nobody_else_writes_what_is_being_recorded() -> None:
    arrays = [(np.zeros((3, 2)), np.zeros((2, 1)), np.zeros(2))]
    recorded = recording()
    refused = rf"nothing is recorded, got a recording under way \(process {os.getpid()} .*Choose another id"
    with pytest.raises(InvalidArgumentError, match=refused):
        dataset_from_arrays(DATASET, arrays, overwrite=True)
    recorded.append(0, episode(0), complete=True)
    with pytest.raises(InvalidArgumentError, match=refused):
        dataset_from_arrays(DATASET, arrays, overwrite=True)
    recorded.close()
    with pytest.raises(InvalidArgumentError, match=r"got an interrupted recording in .*repair"):
        dataset_from_arrays(DATASET, arrays, overwrite=True)
    assert check_survivors(1) == 1


def test_a_data_set_that_came_in_between_is_moved_out_of_the_way(store: Path) -> None:
    recorded = recording()
    recorded.append(0, episode(0), complete=True)
    kept = store / ".recording" / DATASET
    kept.rename(store / "aside")
    dataset_from_arrays(DATASET, [(np.zeros((3, 2)), np.zeros((2, 1)), np.zeros(2))])
    (store / "aside").rename(kept)
    with pytest.raises(InvalidArgumentError, match=r"Move its folder away, then .*repair"):
        recorded.seal()
    (store / DATASET).rename(store / "moved")
    assert check_survivors(1) == 1


class Odd(Tank):
    """Has the spaces and gives the observations that it is told."""

    def __init__(self, observed: spaces.Space[Any], acted: spaces.Space[Any], observation: Any = None) -> None:
        super().__init__()
        self.observation_space, self.action_space, self.given = observed, acted, observation

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.observation_space.sample() if self.given is None else self.given, {}

    def step(self, action: Any) -> Any:
        raise AssertionError("no step is taken")


BOX = spaces.Box(-1.0, 1.0, (1,), np.float32)
REFUSED = [
    spaces.Dict({"q": BOX}),
    spaces.Tuple((BOX, BOX)),
    spaces.Text(5),
    spaces.Sequence(BOX),
    spaces.Graph(BOX, None),
]


@pytest.mark.parametrize("space", REFUSED, ids=lambda space: type(space).__name__)
@pytest.mark.parametrize("kind", ["observation", "action"])
def test_what_cannot_be_stored_is_refused_before_the_first_step(space: Any, kind: str, store: Path) -> None:
    env = Odd(space, BOX) if kind == "observation" else Odd(BOX, space)
    hint = "FlattenObservation" if kind == "observation" else "ActionWrapper"
    with pytest.raises(InvalidArgumentError, match=rf"{kind} space: .*got {type(space).__name__}: .*{hint}"):
        record(env, lambda observation: env.action_space.sample(), 2, CUT)
    assert not list(store.rglob("*"))


def test_a_recorder_refuses_dict_observations(store: Path) -> None:
    env = Odd(spaces.Dict({"q": BOX}), BOX)
    agent = DDPG("MultiInputPolicy", env, learning_starts=10**9, buffer_size=100, device="cpu")
    with pytest.raises(InvalidArgumentError, match=r"observation space: .*got Dict: .*FlattenObservation"):
        agent.learn(10, callback=MinariRecorder(CUT))
    assert not list(store.rglob("*.log"))


@pytest.mark.parametrize(
    "observation", [{"q": 1.0}, np.array([None]), [[1.0], [1.0, 2.0]], np.zeros(1, "U3"), np.zeros(1, [("q", "f4")])]
)
def test_observations_that_are_no_numbers_are_refused(observation: Any, store: Path) -> None:
    with pytest.raises(InvalidDataError, match="first observation: expected an array of numbers"):
        record(Odd(BOX, BOX, observation), lambda observation: np.zeros(1, np.float32), 2, CUT)
    assert not list(store.rglob("*"))


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2)])
def test_whole_numbers_are_stored_as_they_are(space: Any) -> None:
    class Whole(Odd):
        def step(self, action: Any) -> Any:
            return Tank.step(self, action)

    space.seed(0)
    env = Whole(space, space)
    acted = [space.sample() for _ in range(10)]
    actions = iter(acted)
    dataset = record(env, lambda observation: next(actions), 1, CUT)
    assert dataset.observation_space == space
    np.testing.assert_array_equal(dataset[0].actions, acted)
