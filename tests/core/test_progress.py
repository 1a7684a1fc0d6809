"""Bars: what is drawn, that names and texts are no markup, and that nothing is drawn where none are wanted."""

from __future__ import annotations

import io

import pytest
import rich
from rich.console import Console

from mpcoffline.core.progress import Bars, Stages


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


class Clock:
    """A time that tests set."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr("mpcoffline.core.progress.monotonic", found)
    return found


def test_stages_say_how_long_they_took_where_that_is_a_second(clock: Clock) -> None:
    """A part ends with the next part, and with the stage; what is over at once has no second line."""
    said: list[str] = []
    stages = Stages(said.append)
    for text, lasts in (
        ("Checking", 0.5),
        ("  units", 0.2),
        ("  dead time", 6.7),
        ("Advice: one", 0.0),
        ("Fitting", 33.2),
    ):
        stages(text)
        clock.now += lasts
    stages.end()
    assert said == [
        "Checking", "  units", "  dead time", "  dead time (6.7 s)", "Checking (7.4 s, 7.4 s in all)",
        "Advice: one", "Fitting", "Fitting (33 s, 41 s in all)",
    ]  # fmt: skip


def test_elsewhere_a_line_says_how_long_it_took(monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(rich, "_console", Console(file=stream, force_terminal=False, width=100))
    with Bars() as bars:
        for name, lasts in (("first", 12.0), ("models", 0.9)):
            bars.busy(name)
            clock.now += lasts
        bars.show("choosing", 1, 2)
        clock.now += 3.25
        bars.show("choosing", 2, 2)
        clock.now += 1.0
    assert stream.getvalue() == "  first\n  first (12 s)\n  models\n  choosing\n  choosing (4.2 s)\n"


def test_a_bar_that_is_taken_away_leaves_its_time(terminal: io.StringIO, clock: Clock) -> None:
    with Bars() as bars:
        bars.busy("terminal cost")
        clock.now += 2.5
        bars.show("choosing", 1, 2)
    assert "terminal cost (2.5 s)" in terminal.getvalue()
    assert " s" in next(line for line in terminal.getvalue().splitlines() if "1/2" in line).split("1/2")[1]
