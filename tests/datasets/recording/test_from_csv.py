"""The log of a plant, against a table made by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets import TransitionTable, from_csv

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
    assert stored.names == table.names == ("x", "v", "u")
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


def test_another_sampling_time_is_told_as_such(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,x,u\n" + "".join(f"{2 * k},{k},0\n" for k in range(9)))
    arguments: dict[str, Any] = {"observations": ["x"], "actions": ["u"], "cost": "x", "time": "t"}
    with pytest.raises(InvalidDataError, match=r"got 2 s \(8 such.*Rows are 2 s apart: pass dt=2\. .*resamples"):
        from_csv(path, **arguments, dt=10.0)
    assert len(from_csv(path, **arguments, dt=2.0)) == 8


def test_headers_that_are_no_names_are_spelled(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("LI#101: PV,u\n1,0\n2,0\n")
    table = from_csv(path, observations=["LI#101: PV"], actions=["u"], cost="u", dataset_id="test/plant-v0")
    assert TransitionTable.from_minari("test/plant-v0").names == table.names == ("LI_101_ PV", "u")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1.1,0.2", "1.1,oops", r"log.csv, line 3: column 'v': expected a finite number, got 'oops'.*Plant.read"),
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
