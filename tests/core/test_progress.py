"""Bars: what is drawn, that names and texts are no markup, and that nothing is drawn where none are wanted."""

from __future__ import annotations

import pytest

from mpcoffline.core.progress import Bars


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")


def test_bars_say_what_is_done(capsys: pytest.CaptureFixture[str]) -> None:
    with Bars() as bars:
        bars.show("first", 1, 4, "loss 3")
        bars.show("[bold]second", 1, 2)
        bars.show("first", 3, 4, "loss 2")
    first, second = (" ".join(line.split()) for line in capsys.readouterr().out.splitlines())
    assert first.startswith("first: loss 2 ")
    assert "3/4" in first
    assert second.startswith("[bold]second ")
    assert "1/2" in second


def test_bytes_are_counted_in_their_units(capsys: pytest.CaptureFixture[str]) -> None:
    with Bars(of_bytes=True) as bars:
        bars.show("file", 0, 2_200_000)
        bars.advance("file", 400_000)
        bars.advance("file", 600_000)
    assert "1.0/2.2 MB" in capsys.readouterr().out


def test_bars_that_are_not_wanted_print_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with Bars(False) as bars:
        bars.show("work", 1, 2)
        bars.advance("work", 1)
    assert capsys.readouterr() == ("", "")


def test_what_has_no_steps_is_shown_until_something_else_is(capsys: pytest.CaptureFixture[str]) -> None:
    with Bars() as bars:
        bars.busy("terminal cost")
        bars.show("choosing", 1, 2)
    assert capsys.readouterr().out.split()[0] == "choosing"
