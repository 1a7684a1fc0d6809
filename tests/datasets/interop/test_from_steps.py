"""LeRobot, RLDS and do-mpc: objects of their layout built by hand, each transition compared one by one."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow
import pytest
from foreign_data import Episode, assert_same, trajectories

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets import from_do_mpc, from_lerobot, from_rlds

polars = pytest.importorskip("polars", reason='needs pip install "mpcoffline[logs]"')


def going_on(episodes: list[Episode]) -> list[Episode]:
    return [e._replace(terminated=False) for e in episodes]


def frames(episodes: list[Episode]) -> dict[str, list[Any]]:
    """A frame for each observation; the last one's action and reward lead nowhere."""
    columns: dict[str, list[Any]] = {}
    for i, e in enumerate(episodes):
        for k, s in enumerate(e.s):
            last = k == len(e.a)
            row = {
                "observation.state": s.astype("f4").tolist(),
                "action": [77.0] if last else e.a[k].astype("f4").tolist(),
                "next.reward": 99.0 if last else -e.cost[k],
                "next.done": last,
                "episode_index": i,
                "frame_index": k,
                "timestamp": k / 30.0,
            }
            for key, value in row.items():
                columns.setdefault(key, []).append(value)
    return columns


def test_frames_of_lerobot(tmp_path: Path) -> None:
    episodes = going_on(trajectories())
    columns = frames(episodes)
    frame = polars.DataFrame(columns)
    for given in (columns, frame, pyarrow.table(columns), frame[::-1]):
        assert_same(from_lerobot(given), episodes)
    assert_same(from_lerobot(SimpleFrame(columns)), episodes)
    frame[:5].write_parquet(tmp_path / "episode 0.parquet")
    frame[5:].write_parquet(tmp_path / "é.parquet")
    assert_same(from_lerobot([tmp_path / "episode 0.parquet", tmp_path / "é.parquet"]), episodes)
    assert_same(from_lerobot(str(tmp_path / "episode 0.parquet")), episodes[:1])


class SimpleFrame:
    """As pandas: cells are arrays, rows come by ``to_list``."""

    def __init__(self, columns: dict[str, list[Any]]) -> None:
        self.columns = columns

    def __getitem__(self, key: str) -> Any:
        cells = [np.array(each) if isinstance(each, list) else each for each in self.columns[key]]
        return SimpleNamespace(to_list=lambda: cells)


def test_frames_that_are_missing_begin_an_episode() -> None:
    [episode] = going_on(trajectories((6,), (False,)))
    kept = [0, 1, 2, 4, 5, 6]
    columns = {key: [values[k] for k in kept] for key, values in frames([episode]).items()}
    pieces = [
        Episode(episode.s[:3], episode.a[:2], episode.cost[:2], terminated=False),
        Episode(episode.s[4:], episode.a[4:], episode.cost[4:], terminated=False),
    ]
    assert_same(from_lerobot(columns), pieces)


def test_a_reward_of_ones_own_and_several_columns() -> None:
    episodes = going_on(trajectories())
    columns = frames(episodes)
    del columns["next.reward"]
    columns["gripper"] = [float(k) for k in range(len(columns["action"]))]
    table = from_lerobot(columns, observations=("observation.state", "gripper"), cost=lambda s, a: s[:, 2] + a[:, 0])
    np.testing.assert_array_equal(table.observations[:, 2], [0, 1, 2, 3, 5, 7, 8, 9, 10, 11, 12])
    assert table.costs[1] == 1.0 + episodes[0].a[1, 0]


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"next.reward": None}, {}, "a column 'next.reward', got .* cost= computes what is minimised"),
        ({"observation.state": None}, {}, "a column 'observation.state'"),
        ({"camera": [{"bytes": b""}] * 14}, {"observations": ["camera"]}, "camera: expected numbers, got images"),
        ({"action": [0] * 14}, {}, "action: expected a continuous action: .* got int64"),
        ({"action": [[0.0, 1.0], *[[0.0]] * 13]}, {}, "action: expected an array of numbers"),
        ({"next.reward": [np.nan] * 14}, {}, "episode 0, step 0: cost"),
        ({"next.reward": [None] * 14}, {}, "next.reward: expected an array of numbers"),
    ],
)
def test_frames_that_are_refused(changes: dict[str, Any], options: dict[str, Any], message: str) -> None:
    columns = {k: v for k, v in (frames(trajectories()) | changes).items() if v is not None}
    with pytest.raises(InvalidDataError, match=message):
        from_lerobot(columns, **options)


def test_files_that_are_no_parquet(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_text("episode_index,frame_index\n0,0\n")
    for path in (tmp_path / "a.parquet", tmp_path / "none.parquet"):
        with pytest.raises(InvalidArgumentError, match="frames: expected parquet files of one layout"):
            from_lerobot(path)


def steps(episode: Episode, *, late_reward: float = 0.0) -> list[dict[str, Any]]:
    """A step for each observation; the last one's action means nothing."""
    n = len(episode.a)
    return [
        {
            "observation": {"state": s.astype("f4"), "image": np.zeros((8, 8, 3), np.uint8)},
            "action": episode.a[k].astype("f4") if k < n else np.zeros(1, "f4"),
            "reward": np.float32(-episode.cost[k] if k < n else late_reward),
            "discount": np.float32(1.0),
            "is_first": k == 0,
            "is_last": k == n,
            "is_terminal": k == n and episode.terminated,
        }
        for k, s in enumerate(episode.s)
    ]


def test_steps_of_rlds() -> None:
    episodes = trajectories()
    assert_same(from_rlds([{"steps": iter(steps(e))} for e in episodes], observations=["state"]), episodes)
    stacked = [
        {"steps": {key: np.array([step[key] for step in steps(e)]) for key in ("action", "reward", "is_terminal")}}
        for e in episodes
    ]
    for each, e in zip(stacked, episodes, strict=True):
        each["steps"]["observation"] = e.s
    assert_same(from_rlds(stacked), episodes)


def test_a_reward_of_the_last_step_is_told() -> None:
    episodes = trajectories()
    with pytest.warns(UserWarning, match="in 3 episodes the last step has a reward, which belongs to no transition"):
        table = from_rlds([{"steps": steps(e, late_reward=1.0)} for e in episodes], observations=["state"])
    assert_same(table, episodes)


def test_steps_that_are_refused() -> None:
    given = [{"steps": steps(trajectories()[0])}]
    with pytest.raises(InvalidArgumentError, match="the keys that make up the observation, got none of state, image"):
        from_rlds(given)
    with pytest.raises(InvalidDataError, match=r"image: expected one vector a step, .* images"):
        from_rlds(given, observations=["state", "image"])
    with pytest.raises(InvalidArgumentError, match="RLDS, episode 0: expected steps with"):
        from_rlds(given, observations=["state", "speed"])
    for other in ([{}], [3], [{"steps": []}]):
        with pytest.raises(InvalidArgumentError, match="RLDS, episode 0: expected steps with"):
            from_rlds(other)
    for step in given[0]["steps"]:
        step["action"] = np.int64(1)
    with pytest.raises(InvalidDataError, match="expected a continuous action"):
        from_rlds(given, observations=["state"])


class Stored:
    """As ``do_mpc.data.Data``: a field is an attribute, an auxiliary expression is asked for by its name."""

    def __init__(self, episodes: list[Episode], *, dt: float = 0.1, measured: bool = False) -> None:
        self._x = np.concatenate([e.s[:-1] for e in episodes])
        self._y = np.concatenate([e.s[1:] for e in episodes]) if measured else np.empty((0, 2))
        self._u = np.concatenate([e.a for e in episodes])
        self._time = np.concatenate([dt * np.arange(len(e.a))[:, None] for e in episodes])
        self._aux = np.concatenate([np.stack([np.zeros_like(e.cost), e.cost], axis=1) for e in episodes])

    def __getitem__(self, index: tuple[str, str]) -> Any:
        assert index[1] in ("default", "L"), "as do-mpc refuses what is not there"
        return self._aux[:, [["default", "L"].index(index[1])]]


def test_data_of_do_mpc() -> None:
    episodes = going_on(trajectories((4, 2, 6), (False,) * 3))
    for given in (Stored(episodes), [Stored([e]) for e in episodes]):
        assert_same(from_do_mpc(given, cost="L"), episodes, without_last=True)
    table = from_do_mpc(Stored(episodes), cost=lambda s, a: s[:, 1] + a[:, 0])
    assert table.costs[1] == episodes[0].s[1, 1] + episodes[0].a[1, 0]


def test_measurements_of_do_mpc_come_a_row_later() -> None:
    """y of row k is measured after the step: the first action's observation was not stored, the last one's s+ was."""
    episodes = going_on(trajectories((4, 2, 6), (False,) * 3))
    seen = [Episode(e.s[1:], e.a[1:], e.cost[1:], terminated=False) for e in episodes]
    assert_same(from_do_mpc(Stored(episodes, measured=True), cost="L", observations=["_y"]), seen)
    both = from_do_mpc(Stored(episodes, measured=True), cost="L", observations=["_y", "_x"])
    np.testing.assert_array_equal(both.observations[:, :2], both.observations[:, 2:])
    np.testing.assert_array_equal(both.observations[0], [*episodes[0].s[1]] * 2)
    assert both.costs[0] == episodes[0].cost[1]


def test_data_of_do_mpc_that_are_refused() -> None:
    stored = Stored(trajectories())
    with pytest.raises(InvalidArgumentError, match="stored data of do-mpc with '_aux' price"):
        from_do_mpc(stored, cost="price")
    with pytest.raises(InvalidArgumentError, match="11 rows in each field, as in _u, got _y 0"):
        from_do_mpc(stored, cost="L", observations=["_y"])
    with pytest.raises(InvalidArgumentError, match="data: expected stored data of do-mpc with '_u', got str"):
        from_do_mpc("results.pkl", cost="L")
    stored._u[2] = np.nan
    with pytest.raises(InvalidDataError, match=r"action 0: .* got nan"):
        from_do_mpc(stored, cost="L")
