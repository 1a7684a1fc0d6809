"""Bars: what is drawn, that names and texts are no markup, and that nothing is drawn where none are wanted."""

from __future__ import annotations

import io

import pytest
import rich
from rich.console import Console

from mpcoffline.core.progress import Bars


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """What a terminal of 100 columns is sent."""
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=100, color_system=None)
    monkeypatch.setattr(rich, "_console", console)
    return stream


def test_bars_say_what_is_done(terminal: io.StringIO) -> None:
    with Bars() as bars:
        bars.show("first", 1, 4, "loss 3")
        bars.show("[bold]second", 1, 2)
        bars.show("first", 3, 4, "loss 2")
    first, second = (" ".join(line.split()) for line in terminal.getvalue().splitlines()[-3:-1])
    assert "first: loss 2 " in first
    assert "3/4" in first
    assert "[bold]second " in second
    assert "1/2" in second


def test_bytes_are_counted_in_their_units(terminal: io.StringIO) -> None:
    with Bars(of_bytes=True) as bars:
        bars.show("file", 0, 2_200_000)
        bars.advance("file", 400_000)
        bars.advance("file", 600_000)
    assert "1.0/2.2 MB" in terminal.getvalue()


def test_bars_that_are_not_wanted_print_nothing(capsys: pytest.CaptureFixture[str], terminal: io.StringIO) -> None:
    with Bars(False) as bars:
        bars.show("work", 1, 2)
        bars.advance("work", 1)
    assert capsys.readouterr() == ("", "")
    assert not terminal.getvalue()


def test_what_has_no_steps_is_shown_until_something_else_is(terminal: io.StringIO) -> None:
    with Bars() as bars:
        bars.busy("terminal cost")
        bars.show("choosing", 1, 2)
    last = terminal.getvalue().splitlines()[-2]
    assert "choosing" in last
    assert "terminal cost" not in last


def test_elsewhere_a_line_says_what_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a file hours of work would else look as if nothing happened."""
    stream = io.StringIO()
    monkeypatch.setattr(rich, "_console", Console(file=stream, force_terminal=False, width=100))
    with Bars() as bars:
        bars.show("first", 1, 4, "loss 3")
        bars.busy("[bold]models")
        bars.show("choosing", 1, 2)
        bars.show("choosing", 2, 2)
    assert stream.getvalue() == "  first\n  [bold]models\n  choosing\n"
