"""Data without a learning agent, against re-simulation and hand-made tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets import TransitionTable, dataset_from_arrays, from_csv, record
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


def test_arrays_there_and_back() -> None:
    rng = np.random.default_rng(0)
    episodes = [(rng.normal(size=(n + 1, 2)), rng.uniform(-1, 1, (n, 1)), rng.uniform(size=n)) for n in (3, 1, 5)]
    dataset = dataset_from_arrays("test/a-v0", episodes, action_low=-1, action_high=1, terminated=[False, True, False])
    table = TransitionTable.from_minari(dataset)
    np.testing.assert_array_equal(table.observations, np.concatenate([e[0][:-1] for e in episodes]).astype("f4"))
    np.testing.assert_array_equal(table.next_observations, np.concatenate([e[0][1:] for e in episodes]).astype("f4"))
    np.testing.assert_array_equal(table.actions, np.concatenate([e[1] for e in episodes]).astype("f4"))
    np.testing.assert_array_equal(table.costs, np.concatenate([e[2] for e in episodes]).astype("f4"))
    np.testing.assert_array_equal(table.terminations, [0, 0, 0, 1, 0, 0, 0, 0, 0])
    assert dataset.action_space.high[0] == 1.0


GOOD = (np.zeros((3, 2)), np.zeros((2, 1)), np.zeros(2))


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([], "at least one episode"),
        ([GOOD, (GOOD[0][:2], *GOOD[1:])], r"episode 1: observations: expected 3 rows, with 2 actions, got 2"),
        ([GOOD, (*GOOD[:2], np.array([0.0, np.nan]))], r"episode 1, step 1: cost 0: .* got nan"),
        ([(GOOD[0], GOOD[1] + 3.0, GOOD[2])], r"episode 0, step 0: action 0: expected a value in \[-1, 1\], got 3"),
        ([GOOD, (np.zeros((3, 4)), *GOOD[1:])], "episode 1: expected 2 observations and 1 actions, got 4, 1"),
    ],
)
def test_arrays_that_are_refused(episodes: Any, message: str, store: Path) -> None:
    with pytest.raises(InvalidDataError, match=message):
        dataset_from_arrays("test/bad-v0", episodes, action_low=-1, action_high=1)
    assert not (store / "test").exists()


LOG = """t,run,x, v,u,note
0.0,a,1.0,0.0,0.5,start
0.1,a,1.1,0.2,0.4,
0.2,a,1.2,0.3,0.3,

0.0,b,5.0,0.0,-1,
0.1,b,5.5,0.1,-2,
"""
COLUMNS: dict[str, Any] = {"observations": ["x", "v"], "actions": ["u"], "episode": "run", "time": "t", "dt": 0.1}


def cost(s: Any, a: Any) -> Any:
    return s[:, 0] ** 2 + a[:, 0] ** 2


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.csv"
    path.write_text(LOG)
    return path


def test_the_log_of_a_plant(log: Path) -> None:
    table = from_csv(log, **COLUMNS, cost=cost, dataset_id="test/plant-v0")
    np.testing.assert_allclose(table.observations, [[1.0, 0.0], [1.1, 0.2], [5.0, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(table.next_observations, [[1.1, 0.2], [1.2, 0.3], [5.5, 0.1]], rtol=1e-6)
    np.testing.assert_allclose(table.actions, [[0.5], [0.4], [-1.0]], rtol=1e-6)
    np.testing.assert_allclose(table.costs, [1.25, 1.37, 26.0], rtol=1e-6)
    assert list(table.episode_ids) == [0, 0, 1]
    assert not table.terminations.any()
    stored = TransitionTable.from_minari("test/plant-v0")
    np.testing.assert_array_equal(stored.rows, table.rows)
    np.testing.assert_array_equal(stored.episode_ids, table.episode_ids)


def test_a_log_is_stored_anew_on_request_only(log: Path) -> None:
    from_csv(log, **COLUMNS, cost=cost, dataset_id="test/plant-v0")
    with pytest.raises(InvalidArgumentError, match="overwrite=True"):
        from_csv(log, **COLUMNS, cost=lambda s, a: cost(s, a) + 1.0, dataset_id="test/plant-v0")
    table = from_csv(log, **COLUMNS, cost=lambda s, a: cost(s, a) + 1.0, dataset_id="test/plant-v0", overwrite=True)
    np.testing.assert_allclose(table.costs, [2.25, 2.37, 27.0], rtol=1e-6)
    np.testing.assert_array_equal(TransitionTable.from_minari("test/plant-v0").rows, table.rows)


def test_costs_from_a_column_gaps_and_other_delimiters(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text("t;x;u;l\n0;1;0;7\n1;2;0;8\n5;3;0;9\n6;4;0;10\n")
    arguments: dict[str, Any] = {"observations": ["x"], "actions": ["u"], "cost": "l", "delimiter": ";"}
    assert list(from_csv(path, **arguments).costs) == [7, 8, 9]
    with pytest.raises(InvalidDataError, match=r"line 4: t: expected 1 s more than the row before, got 4 s \(1 such"):
        from_csv(path, **arguments, time="t", dt=1.0)
    table = from_csv(path, **arguments, time="t", dt=1.0, split_gaps=True)
    assert list(table.costs) == [7, 9]
    assert list(table.episode_ids) == [0, 1]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1.1,0.2", "1.1,oops", r"log.csv, line 3: column 'v': expected a finite number, got 'oops'"),
        ("1.1,0.2", "nan,0.2", r"line 3: column 'x'.*got 'nan'"),
        ("1.1,0.2,0.4,", "1.1,0.2", r"line 3: expected 6 columns, got 4"),
        ("0.2,a", "0.25,a", r"line 4: t: expected 0.1 s more than the row before, got 0.15 s"),
        (
            "0.0,b,5.0,0.0,-1,",
            "0.0,b,5.0,0.0,-1,\n0.0,a,1,1,1,",
            r"line 7: column 'run'.*in one piece, got episode 'a'",
        ),
        ("t,run,x, v", "t,run,x,w", r"line 1: column 'v': expected one of that name among t, run, x, w, u, note"),
        ("t,run,x, v", "t,run,x,x", r"line 1: column 'x': .* got 2"),
        (LOG[18:], "", r"at least two rows"),
        ("0.1,a,1.1", "0.1,a,1\x001", r"log.csv, line 3"),
    ],
)
def test_cells_that_are_refused(log: Path, old: str, new: str, message: str) -> None:
    assert old in LOG
    log.write_text(LOG.replace(old, new, 1))
    with pytest.raises(InvalidDataError, match=message):
        from_csv(log, **COLUMNS, cost=cost)


def test_arguments_that_are_refused(log: Path) -> None:
    with pytest.raises(InvalidArgumentError, match="both or neither"):
        from_csv(log, **{**COLUMNS, "dt": None}, cost=cost)
    with pytest.raises(InvalidArgumentError, match="lists of column names"):
        from_csv(log, **{**COLUMNS, "actions": "u"}, cost=cost)
    with pytest.raises(
        InvalidDataError, match=r"cost\(s, a\): expected finite numbers of shape \(3,\), got shape \(3, 1\)"
    ):
        from_csv(log, **COLUMNS, cost=lambda s, a: a)
    with pytest.raises(InvalidDataError, match=r"line 6: cost\(s, a\): .* got inf"):
        from_csv(log, **COLUMNS, cost=lambda s, a: np.where(s[:, 0] > 4, np.inf, 0.0))


def test_an_environment_that_cannot_be_named_in_json_is_refused() -> None:
    spec = gym.spec(PENDULUM)
    entry = gym.make(PENDULUM).unwrapped.__class__
    gym.register("ByClass-v0", entry_point=entry, max_episode_steps=spec.max_episode_steps)
    try:
        with pytest.raises(InvalidArgumentError, match="module:Class"):
            record(gym.make("ByClass-v0"), Proportional(), 1, "test/by-class-v0", seed=0)
    finally:
        del gym.registry["ByClass-v0"]
