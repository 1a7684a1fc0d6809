"""What became of a log: what was kept, what was left out and why, and what was taken to be so."""

from __future__ import annotations

from dataclasses import dataclass, field

from mpcoffline.core.notebook import html_of
from mpcoffline.core.tables import Table


@dataclass(frozen=True)
class LeftOut:
    """Rows, or cells, that did not enter.

    Attributes:
        what: The column, or ``"rows"``.
        why: The reason.
        count: How many.
        first: The first of them, as ``"log.csv, line 17"``.
        lasting: Whether it is still so in the log's last row.
    """

    what: str
    why: str
    count: int
    first: str
    lasting: bool = False


@dataclass
class LogReport:
    """What became of a log.

    Attributes:
        rows: Rows read.
        steps: Control intervals kept.
        episodes: Stretches without a gap that they stand in.
        seconds: Typical time between rows.
        left_out: What did not enter, and why.
        notes: What was found out or taken to be so.
    """

    rows: int = 0
    steps: int = 0
    episodes: int = 0
    seconds: float = 0.0
    left_out: list[LeftOut] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def leave_out(self, what: str, why: str, count: int, first: str, *, lasting: bool = False) -> None:
        """Enters what was left out, if there is any."""
        if count:
            self.left_out.append(LeftOut(what, why, int(count), first, lasting))

    def note(self, *texts: str) -> None:
        """Enters what was found out, once."""
        self.notes += [text for text in dict.fromkeys(texts) if text and text not in self.notes]

    @property
    def table(self) -> Table:
        """What was left out, as a table."""
        rows = [(each.what, each.why, f"{each.count:,}", each.first) for each in self.left_out]
        return Table(("column", "left out because", "rows", "first"), rows, align="llrl")

    def _repr_html_(self) -> str:
        """What was read, and what was left out, for notebooks."""
        head = str(self).splitlines()[0]
        return html_of(head, tables=[self.table] if self.left_out else [], sentences=self.notes)

    def __str__(self) -> str:
        head = (
            f"{self.rows:,} rows, {self.seconds:g} s apart: {self.steps:,} control intervals in {self.episodes:,}"
            f" {'episode' if self.episodes == 1 else 'episodes'}."
        )
        lines = [head, *(f"* {note}" for note in self.notes)]
        if self.left_out:
            lines.append("Left out:")
            lines += [f"* {e.what}: {e.why}, {e.count:,} rows, the first {e.first}" for e in self.left_out]
        return "\n".join(lines)
