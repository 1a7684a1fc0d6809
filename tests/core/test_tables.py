"""Tables: the same rows in Markdown and in the terminal, whatever their cells hold."""

from __future__ import annotations

import io

from rich.console import Console

from mpcoffline.core.tables import Table, verdict

TABLE = Table(("name", "J"), [("MPC_1", "1.0"), ("a|b", "22.5")], "costs", "lr")


def printed(what: object) -> str:
    console = Console(width=60, file=io.StringIO(), record=True)
    console.print(what)
    return console.export_text()


def test_markdown() -> None:
    assert TABLE.markdown() == "| name | J |\n| --- | --: |\n| MPC_1 | 1.0 |\n| a\\|b | 22.5 |"
    assert Table(("x",), [("`code`",)]).markdown(str) == "| x |\n| --- |\n| `code` |"


def test_terminal() -> None:
    assert [line.rstrip() for line in printed(TABLE).splitlines()] == [
        "costs",
        "name      J",
        "MPC_1   1.0",
        "a|b    22.5",
    ]


def test_no_cell_is_markup_or_steers_the_terminal() -> None:
    text = printed(Table((), [("[red]x[/]", "\x1b[2Jy")], "[bold]t"))
    assert "[red]x[/]" in text
    assert "[bold]t" in text
    assert "\x1b" not in text


def test_short_rows_and_what_goes_on_to_the_right() -> None:
    wide = Table(("", "a", "b"), [("x", "1", "2"), ("long", "3")], align="lr")
    assert wide.markdown().splitlines()[1] == "| --- | --: | --: |"
    assert [line.split() for line in printed(wide).splitlines()] == [["a", "b"], ["x", "1", "2"], ["long", "3"]]


def test_a_verdict_is_its_line_its_table_and_its_remarks() -> None:
    lines = [line.rstrip() for line in printed(verdict("set: ok", True, TABLE, ["and [b]more"])).splitlines()]
    assert (lines[0], lines[1], lines[-1]) == ("set: ok", "costs", "and [b]more")
    assert printed(verdict("set: 1 errors", False, None)).strip() == "set: 1 errors"
