"""Tables and short reports of text, for Markdown files and for the terminal from the same rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from .text import markdown, visible

if TYPE_CHECKING:
    from rich.console import RenderableType


_MOST_ROWS = 40  # that a notebook shows


@dataclass(frozen=True)
class Table:
    """Rows of text under a header; rich prints it, and no cell of it is markup or steers the terminal.

    Attributes:
        header: Names of the columns; none for a table without header.
        rows: Their cells.
        title: What stands above it in the terminal.
        align: A letter a column, ``l`` where its cells stand on the left, ``r`` on the right; the last goes on.
        styles: Rich's style of each row.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    align: str = "l"
    styles: Sequence[str] = ()

    def _repr_html_(self) -> str:
        """The table, for notebooks; of long ones the first rows."""
        caption = f"<caption>{escape(visible(self.title))}</caption>" if self.title else ""
        head = f"<thead>{self._row(self.header, 'th')}</thead>" if self.header else ""
        body = "".join(self._row(row, "td") for row in self.rows[:_MOST_ROWS])
        if len(self.rows) > _MOST_ROWS:
            body += f'<tr><td colspan="{len(self.rows[0])}">and {len(self.rows) - _MOST_ROWS} more</td></tr>'
        return f"<table>{caption}{head}<tbody>{body}</tbody></table>"

    def _row(self, cells: Sequence[str], kind: str) -> str:
        sides = ("right" if self._is_right(k) else "left" for k in range(len(cells)))
        inner = (
            f'<{kind} style="text-align: {s}">{escape(visible(c))}</{kind}>' for s, c in zip(sides, cells, strict=True)
        )
        return f"<tr>{''.join(inner)}</tr>"

    def __rich__(self) -> RenderableType:
        from rich.console import Group
        from rich.table import Table as RichTable
        from rich.text import Text

        table = RichTable(box=None, pad_edge=False, show_header=bool(self.header))
        for k, name in enumerate(self.header):
            table.add_column(Text(visible(name)), justify="right" if self._is_right(k) else "left")
        for k, row in enumerate(self.rows):
            table.add_row(*(Text(visible(cell)) for cell in row), style=self.styles[k] if self.styles else None)
        if not self.title:
            return table
        return Group(Text(visible(self.title), style="italic"), table)  # beside it: a table's own is as narrow as it

    @property
    def lines(self) -> list[str]:
        """The table as plain text, a line each, its title first."""
        rows = [list(map(str, row)) for row in (self.header, *self.rows)]
        widths = [max(len(row[k]) for row in rows) for k in range(len(self.header))]
        shown = [
            "  ".join(
                cell.rjust(width) if self._is_right(k) else cell.ljust(width)
                for k, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in rows
        ]
        return [*([self.title] if self.title else []), *(f"  {line}" for line in shown)]

    def markdown(self, cell: Callable[[str], str] = markdown) -> str:
        """The table in Markdown, its lines ended but for the last.

        Args:
            cell: Writes a cell's text in Markdown; ``str`` where the cells are Markdown.
        """
        rule = ["--:" if self._is_right(k) else "---" for k in range(len(self.header))]
        lines = [self.header, rule, *([*map(cell, row)] for row in self.rows)]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)

    def _is_right(self, column: int) -> bool:
        return self.align[min(column, len(self.align) - 1)] == "r"


def verdict(headline: str, ok: bool, table: Table | None, remarks: Iterable[str] = ()) -> RenderableType:
    """A report for the terminal: a line that says how it is, in green or red, what was found, and remarks."""
    from rich.console import Group
    from rich.text import Text

    head = Text(visible(headline), style="bold green" if ok else "bold red")
    return Group(head, *([table] if table is not None else []), *(Text(visible(line)) for line in remarks))
