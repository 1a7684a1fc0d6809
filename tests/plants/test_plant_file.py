"""Plant files: the one that ``new`` writes, and errors that name the line."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from mpcoffline import InvalidDataError, StorageError, load_plant
from mpcoffline.cli import app


def test_new_writes_a_file_that_runs_and_never_replaces_one(tmp_path: Path) -> None:
    file, runner = tmp_path / "two_tank.py", CliRunner()
    assert runner.invoke(app, ["new", str(file)]).exit_code == 0
    plant = load_plant(file)
    assert plant.names("states") == ["h1", "h2"]
    assert "mpcoffline check two_tank.py log.csv" in file.read_text()
    file.write_text("mine")
    again = runner.invoke(app, ["new", str(file)])
    assert again.exit_code == 1
    assert "expected a name that is free" in again.stderr
    assert file.read_text() == "mine"
    assert runner.invoke(app, ["new", str(tmp_path / "plant.txt")]).exit_code == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\ny = 1 / 0\n", "plant.py, line 2: expected a program that runs, got ZeroDivisionError"),
        ("x = (\n", "plant.py, line 1: expected Python"),
        ("from mpcoffline import State\n\nState('h', 'cm', 2, 1)\n", "plant.py, line 3: state h: range: expected low"),
        ("x = 1\n", "expected one mpcoffline.Plant, called plant, got none"),
    ],
)
def test_errors_name_the_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "plant.py"
    file.write_text(text)
    with pytest.raises(InvalidDataError, match=message):
        load_plant(file)


def test_an_error_in_a_function_names_its_own_line(tmp_path: Path) -> None:
    file = tmp_path / "two_tank.py"
    CliRunner().invoke(app, ["new", str(file)])
    text = file.read_text()
    file.write_text(text.replace("d.set_point) ** 2", "d.setpoint) ** 2"))
    line = 1 + text[: text.index("d.set_point) ** 2")].count("\n")
    with pytest.raises(InvalidDataError, match=rf"cost \(two_tank.py, line {line}\), d.setpoint"):
        load_plant(file)


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"none\.py: expected a plant file"):
        load_plant(tmp_path / "none.py")
