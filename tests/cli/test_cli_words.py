"""What the command line prints: broken between words on a terminal, whole in a pipe; what the shell completes."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from mpcoffline.cli import common
from mpcoffline.cli.main import app
from mpcoffline.cli.options import beginning, environments
from mpcoffline.cli.own_plants import pairs, read_options
from mpcoffline.core.tables import Table

LONG = (
    "a sentence of words that is longer than forty columns are, and names /a/path/that/is/longer/than/all/of/them.zip"
)


@pytest.mark.parametrize("terminal", [True, False])
def test_messages_are_broken_between_words_on_a_terminal_alone(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    where = common.SafeConsole(file=stream, force_terminal=terminal, width=40, highlight=False, color_system=None)
    monkeypatch.setattr(common, "messages", where)
    common.message(LONG)
    lines = stream.getvalue().splitlines()
    assert " ".join(line.strip() for line in lines) == LONG
    assert len(lines) > 1 if terminal else len(lines) == 1
    assert all(len(line.rstrip()) <= 40 or "/" in line for line in lines) or not terminal


def test_a_title_is_as_wide_as_the_terminal_not_as_its_table() -> None:
    stream = io.StringIO()
    common.SafeConsole(file=stream, width=80).print(Table(("a", "b"), [("1", "2")], "A title of several words"))
    assert "A title of several words" in stream.getvalue().splitlines()[0]


def completed(words: str, incomplete: str) -> list[str]:
    """What the shell's completion offers, as bash asks for it."""
    line = f"{words} {incomplete}".rstrip() if incomplete else f"{words} "
    env = {
        "_MPCOFFLINE_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words.split())),
    }
    result = CliRunner(env=env).invoke(app, [], prog_name="mpcoffline")
    return result.stdout.split()


def test_data_sets_environments_and_tasks_are_completed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    Path("room.py").write_text("")
    assert completed("mpcoffline learn --dataset", "mpcoffline/pen") == ["mpcoffline/pendulum/ddpg-v0"]
    assert completed("mpcoffline evaluate p.zip --env", "mpcoffline/Lin") == ["mpcoffline/LinearTracking-v0"]
    assert "room.py" in completed("mpcoffline evaluate p.zip --env", "")
    assert completed("mpcoffline learn", "p") == ["pendulum"]
    assert completed("mpcoffline datasets show", "mpcoffline/car") == ["mpcoffline/cartpole/ddpg-v0"]
    assert beginning(environments)("nothing") == []


def test_results_have_one_option() -> None:
    group = typer.main.get_group(app)
    written = {
        name: [o for p in command.params for o in p.opts if o in ("--out", "--output")]
        for name, command in group.commands.items()
    }
    assert all(options in ([], ["--out"]) for options in written.values())
    assert {name for name, options in written.items() if options} == {
        "run", "reproduce", "tune", "learn", "diagnose", "plot", "distill", "export",
    }  # fmt: skip


@pytest.mark.parametrize("command", [[], ["check"], ["datasets"], ["datasets", "verify"]])
def test_a_flag_looks_like_one_and_arguments_are_in_capitals(command: list[str]) -> None:
    result = CliRunner(env={"COLUMNS": "80", "TERMINAL_WIDTH": "80"}).invoke(app, [*command, "--help"])
    assert result.exit_code == 0
    assert "<bool>" not in result.stdout.lower()
    assert "boolean" not in result.stdout.lower()
    assert "dataset_id" not in result.stdout
    assert all(len(line.rstrip()) <= 80 for line in result.stdout.splitlines())


def test_a_header_that_is_given_again_is_an_or_a_name_that_is_given_again_a_mistake() -> None:
    options = read_options(["h1=LI"], None, ["mode=AUTO", "mode=CAS", "line=2"], None, None, None, None, None)
    assert options["where"] == {"mode": ["AUTO", "CAS"], "line": "2"}
    with pytest.raises(typer.BadParameter, match="'h1' is given twice, 'LI' and 'PI'"):
        pairs("--column", ["h1=LI", "h1=PI"])
