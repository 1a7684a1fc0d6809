"""Commands that a package outside this one adds, without a line of it being changed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mpcoffline.cli.main import app

HELLO = """\
import typer
from mpcoffline.core.errors import InvalidArgumentError

app = typer.Typer()

@app.command()
def hello(name: str, times: int = 1) -> None:
    '''Greets.'''
    if times < 1:
        raise InvalidArgumentError("--times", expected="1 or more", actual=str(times))
    typer.echo(f"hello {name} " * times)
"""


Installer = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Installer:
    """Puts a package of one module on the path, as pip would."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("COLUMNS", "100")

    def installed(package: str, source: str, *entries: str) -> None:
        (tmp_path / f"{package}.py").write_text(source)
        folder = tmp_path / f"{package}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (folder / "entry_points.txt").write_text("\n".join(["[mpcoffline.commands]", *entries, ""]))

    return installed


def call(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, arguments)
    return result.exit_code, " ".join(result.stdout.split()), " ".join(result.stderr.split())


def test_a_command_is_shown_completed_and_called(install: Installer) -> None:
    install("greetings_of_a_test", HELLO, "hello = greetings_of_a_test:app")
    code, out, _ = call("--help")
    assert code == 0
    assert "hello Added by greetings_of_a_test." in out
    assert "greetings_of_a_test" not in sys.modules
    assert call("hello", "you", "--times", "2") == (0, "hello you hello you", "")
    assert "Greets." in call("hello", "--help")[1]
    assert call("hello", "you", "--times", "0")[::2] == (1, "Error: --times: expected 1 or more, got 0.")
    assert call("hello", "you", "--tims", "0")[0] == 2


@pytest.mark.parametrize(
    ("source", "entries", "message"),
    [
        ("raise ZeroDivisionError('broken')", ["bad = broken_of_a_test:app"], "ZeroDivisionError: broken"),
        ("app = 3", ["bad = broken_of_a_test:app"], "expected a typer.Typer, got 3"),
        ("app = 3", ["bad = broken_of_a_test:nothing"], "AttributeError"),
        ("", ["bad = absent_of_a_test:app"], "ModuleNotFoundError"),
    ],
)
def test_what_is_broken_breaks_nothing_else(
    install: Installer, monkeypatch: pytest.MonkeyPatch, source: str, entries: list[str], message: str
) -> None:
    install("broken_of_a_test", source, *entries)
    try:
        assert "bad Added by broken_of_a_test." in call("--help")[1]
        assert call("--version")[0] == 0
        code, out, error = call("bad")
        assert (code, out) == (1, "")
        assert "Error: command 'bad' of broken_of_a_test: " in error
        assert message in error
    finally:
        sys.modules.pop("broken_of_a_test", None)


def test_own_names_stay_and_those_taken_twice_are_refused(install: Installer) -> None:
    install("first_of_a_test", "", "doctor = first_of_a_test:app", "both = first_of_a_test:app")
    install("second_of_a_test", "", "both = second_of_a_test:app")
    assert "doctor Added by" not in call("--help")[1]
    assert "Check this installation" in call("doctor", "--help")[1]
    message = "Error: command 'both' of first_of_a_test and second_of_a_test: expected one package that adds it"
    assert message in call("both")[2]


def test_help_without_other_packages_has_no_panel_for_them() -> None:
    code = "from mpcoffline.cli import app; app(['--help'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Other packages" not in done.stdout


def test_a_plant_is_a_task_of_the_command_line(tmp_path: Path) -> None:
    folder = tmp_path / "own_plant-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: own_plant\nVersion: 1.0\n")
    entries = "[mpcoffline.plants]\nspring = own_plant\nbroken = absent_of_a_test\n"
    (folder / "entry_points.txt").write_text(entries)
    paths = os.pathsep.join((str(tmp_path), str(Path(__file__).parents[1] / "helpers")))
    command = [sys.executable, "-m", "mpcoffline", "learn", "spring"]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=False)
    assert done.returncode == 1  # the task is known, and has no data set
    assert "Without the plant of 'absent_of_a_test': ModuleNotFoundError" in done.stderr
    assert "task: expected one of" in done.stderr
