"""The table of the main job: what it says, and that it survives being written and read."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from mpcoffline.core.errors import FileFormatError
from mpcoffline.studies import ControllerResult, TaskResult


def controller(name: str, costs: list[float], **changes: object) -> ControllerResult:
    fields: dict[str, object] = {
        "name": name,
        "description": f"what {name} is",
        "costs": costs,
        "discounted_costs": [cost / 4 for cost in costs],
        "successes": [True, False],
        "solve_time": 0.002,
        "n_solves": 200,
        "states": [[3.0, 0.0], [-3.0, 0.1], [-2.9, 0.1]],
        "actions": [[2.0], [-2.0]],
    }
    return ControllerResult(**(fields | changes))  # type: ignore[arg-type]


@pytest.fixture
def result() -> TaskResult:
    return TaskResult(
        task="pendulum",
        alpha=1.0,
        seed=0,
        env_id="mpcoffline/PendulumSwingUp-v0",
        dataset_id="mpcoffline/pendulum/ddpg-v0",
        value="residual",
        discount=0.9,
        dt=0.05,
        starts=["broad", "hanging"],
        example=1,
        theta={"MPC_1": {"model.m": 1.0}},
        controllers=[
            controller("MPC_1", [300.0, 500.0]),
            controller("MPC_2", [150.0, 250.0], fit_time=12.0, n_failures=3),
            controller("MPC_3", [75.0, 125.0], fit_time=3.0),
            controller("reference", [90.0, 110.0]),
        ],
        behaviour=controller(
            "behaviour", [40.0], successes=None, solve_time=None, n_solves=0, states=None, actions=None
        ),
    )


def test_means_and_relative_performance(result: TaskResult) -> None:
    assert result.controller("MPC_1").cost == 400.0
    assert result.controller("MPC_1").discounted_cost == 100.0
    assert result.controller("MPC_1").success == 0.5
    assert result.relative_performance("MPC_1") == (0.25, 0.25)
    assert result.relative_performance("reference") == (1.0, 1.0)


def test_rows_have_a_cell_a_column_and_leave_out_what_is_unknown(result: TaskResult) -> None:
    rows = {row["controller"]: row for row in result.rows()}
    assert list(rows) == ["MPC_1", "MPC_2", "MPC_3", "reference", "behaviour"]
    assert len({tuple(row) for row in rows.values()}) == 1
    assert rows["MPC_2"] == {
        "controller": "MPC_2",
        "J": "200.0",
        "Jd": "50.00",
        "success": "50%",
        "rel. J": "0.500",
        "rel. Jd": "0.500",
        "fit (s)": "12.0",
        "solve (ms)": "2.00",
    }
    assert [rows["behaviour"][name] for name in ("success", "rel. J", "solve (ms)")] == ["", "", ""]


def test_notes_count_failed_solves(result: TaskResult) -> None:
    told = [note for note in result.notes() if "ailed" in note]
    n = result.controller("MPC_2").n_solves
    assert told == [f"Failed solves: MPC_2 3 of {n} ({300 / n:.2g} %); the best plan at hand was applied."]
    good = replace(result, controllers=[replace(c, n_failures=0) for c in result.controllers])
    assert "Failed solves: none." in good.notes()


def test_notes_split_the_cost_by_kind_of_start(result: TaskResult) -> None:
    assert "J from hanging starts: MPC_1 500.0, MPC_2 250.0, MPC_3 125.0, reference 110.0." in result.notes()
    same = replace(result, starts=["broad", "broad"])
    assert not [note for note in same.notes() if note.startswith("J from")]


def test_title_counts_the_starts(result: TaskResult) -> None:
    assert result.title == "pendulum, alpha = 1, seed 0: 2 starts (1 broad, 1 hanging)"


def test_terminal_table_shows_every_cell_on_eighty_columns(result: TaskResult) -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(result.table())
    text = console.export_text()
    assert "…" not in text
    for row in result.rows():
        assert all(cell in text for cell in row.values())


def test_files_hold_the_table_and_everything_else(result: TaskResult, tmp_path: Path) -> None:
    files = result.save(tmp_path)
    assert [file.name for file in files] == ["results.json", "results.md", "results.csv"]
    assert TaskResult.load(tmp_path / "results.json") == result
    with open(tmp_path / "results.csv", encoding="utf-8") as file:
        assert list(csv.DictReader(file)) == result.rows()
    text = (tmp_path / "results.md").read_text(encoding="utf-8")
    assert "| MPC_3 | 100.0 | 25.00 | 50% | 1.000 | 1.000 | 3.0 | 2.00 |" in text
    assert "`mpcoffline/pendulum/ddpg-v0`" in text


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "[]",
        lambda text: json.dumps(json.loads(text) | {"version": 99}),
        lambda text: json.dumps({k: v for k, v in json.loads(text).items() if k != "controllers"}),
        lambda text: json.dumps(json.loads(text) | {"more": 1}),
    ],
)
def test_a_damaged_or_foreign_file_is_refused_by_name(result: TaskResult, tmp_path: Path, damage: object) -> None:
    result.save(tmp_path)
    path = tmp_path / "results.json"
    path.write_text(damage(path.read_text()))  # type: ignore[operator]
    with pytest.raises(FileFormatError, match=r"results\.json"):
        TaskResult.load(path)


def test_what_says_that_a_run_is_complete_is_written_last(
    result: TaskResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An interruption leaves no results.json beside the tables and figures of another run."""
    written: list[str] = []
    monkeypatch.setattr("mpcoffline.studies.results.write_file", lambda path, content: written.append(path.name))
    result.save(tmp_path)
    assert written[-1] == "results.json"
    assert sorted(written) == ["results.csv", "results.json", "results.md"]
