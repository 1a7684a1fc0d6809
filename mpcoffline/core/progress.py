"""How long work shows where it is: bars with names, for those who want them."""

from __future__ import annotations

from typing import Self


class Bars:
    """Progress bars by name, one under another, on rich's console; or nothing at all.

    Where that is no terminal, as in a file, each name is a line, once it begins.

    Example:
        >>> with Bars() as bars:
        ...     for k in range(1000):
        ...         bars.show("counting", k + 1, 1000, f"at {k}")
        ...     bars.busy("adding up")

    Args:
        shown: Whether to draw any; without, nothing is printed.
        of_bytes: Whether it is bytes that are counted.
    """

    def __init__(self, shown: bool = True, *, of_bytes: bool = False) -> None:
        from rich import get_console
        from rich.progress import (
            BarColumn,
            DownloadColumn,
            MofNCompleteColumn,
            Progress,
            ProgressColumn,
            Task,
            TaskID,
            TextColumn,
            TimeRemainingColumn,
            TransferSpeedColumn,
        )
        from rich.table import Column
        from rich.text import Text

        class Counts(MofNCompleteColumn):
            """Nothing where nothing is counted."""

            def render(self, task: Task) -> Text:
                return Text() if task.total is None else super().render(task)

        bytes_, steps = (DownloadColumn, TransferSpeedColumn), (Counts, TimeRemainingColumn)
        counts: list[ProgressColumn] = [column() for column in (bytes_ if of_bytes else steps)]
        text = TextColumn("{task.description}", markup=False, table_column=Column())  # which wraps: the counts are seen
        console = get_console()
        self._in_lines = shown and not (console.is_terminal or console.is_jupyter)
        self._bars = Progress(text, BarColumn(bar_width=20), *counts, disable=not shown or self._in_lines)
        self._tasks: dict[str, TaskID] = {}
        self._busy: TaskID | None = None

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._rest()
        if not self._bars.disable:  # rich before 14.3 prints an empty line even so
            self._bars.stop()

    def show(self, name: str, done: int, total: int, text: str = "") -> None:
        """Moves the bar of a name, which the first call adds.

        Args:
            name: What is done.
            done: How much of it.
            total: How much there is.
            text: What to say beside the name.
        """
        self._rest()
        if name not in self._tasks:
            self._tasks[name] = self._bars.add_task(name)
            self._line(name)
        description = f"{name}: {text}" if text else name
        self._bars.update(self._tasks[name], completed=done, total=total, description=description)

    def busy(self, name: str) -> None:
        """A bar that moves without count, until something else is shown: for what takes seconds and has no steps.

        Args:
            name: What is done.
        """
        self._rest()
        self._busy = self._bars.add_task(name, total=None)
        self._line(name)

    def _line(self, name: str) -> None:
        if self._in_lines:
            self._bars.console.print(f"  {name}", markup=False, highlight=False)

    def _rest(self) -> None:
        if self._busy is not None:
            self._bars.remove_task(self._busy)
            self._busy = None

    def advance(self, name: str, by: int) -> None:
        """Moves the bar of a name that :meth:`show` has added."""
        self._bars.advance(self._tasks[name], by)
