"""The command line: what cannot be written is refused before the work, and no text steers the terminal."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.table import Table
from rich.text import Text
from typer.testing import CliRunner

from mpcoffline.cli.common import SafeConsole
from mpcoffline.cli.main import app
from mpcoffline.datasets.check.summary import Summary
from mpcoffline.datasets.store.verification import Finding, VerifyReport

HOSTILE = "\x1b]0;title\x07\x1b[2J\u202e <b>_x_</b>"


@pytest.mark.parametrize(
    "command",
    [
        ["learn", "pendulum", "--out", "{taken}"],
        ["learn", "pendulum", "--out", "{folder}/x.zip", "--checkpoint", "{taken}"],
        ["learn", "pendulum", "--out", "{folder}/x.zip", "--log-csv", "{taken}"],
        ["learn", "pendulum", "--out", "{folder}/x.zip", "--tensorboard", "{folder}/file/events"],
        ["run", "pendulum", "--out", "{folder}/file/results"],
        ["reproduce", "--out", "{folder}/file/results"],
        ["datasets", "show", "mpcoffline/pendulum/ddpg-v0", "--figure", "{folder}/file/x.png"],
    ],
)
def test_what_cannot_be_written_is_refused_before_the_work(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def worked(*_: object, **__: object) -> None:
        raise AssertionError("the work began")

    for work in ("mpcoffline.learner.OfflineMPCLearner.fit", "mpcoffline.datasets.check.summary._columns"):
        monkeypatch.setattr(work, worked)
    (tmp_path / "file").write_text("kept")
    (tmp_path / "taken.zip").symlink_to("/dev/full")
    given = [part.format(folder=tmp_path, taken=tmp_path / "taken.zip") for part in command]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 1, result.output
    assert "Error:" in result.output
    assert (tmp_path / "file").read_text() == "kept"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "taken.zip"]


def test_a_console_prints_no_escape_but_its_own() -> None:
    table = Table("x")
    table.add_row(HOSTILE)
    stream = io.StringIO()
    console = SafeConsole(file=stream, force_terminal=True, width=200, highlight=False)
    for shown in (HOSTILE, Text(HOSTILE, style="bold"), table):
        console.print(shown)
    assert "\x1b]" not in stream.getvalue()
    assert "\x1b[2J" not in stream.getvalue()
    assert "\u202e" not in stream.getvalue()
    assert stream.getvalue().count(r"\x1b]0;title") == 3


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_every_character_set_will_do(encoding: str) -> None:
    result = CliRunner(charset=encoding).invoke(app, ["datasets", "show", "no/\N{SNOWMAN}-v0"])
    assert not isinstance(result.exception, UnicodeError)
    assert result.exit_code == 1


def test_reports_are_plain_text() -> None:
    report = VerifyReport(f"a/{HOSTILE}-v0", 0, 0, False, (Finding("metadata", HOSTILE),))
    summary = Summary("a/b-v0", "", {"description": HOSTILE}, (), None)
    for text in (str(report), str(summary)):
        assert all(line.isprintable() for line in text.splitlines())
    assert r"\<b\>\_x\_\</b\>" in str(summary)
