"""How long work shows where it is and how long it took: stages as lines, bars with names for those who want them."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic
from typing import Self

_WORTH = 1.0  # second, from which on it is said how long something took


def seconds(time: float) -> str:
    """A time as text: ``"6.7 s"``, ``"41 s"``."""
    return f"{time:.1f} s" if time < 9.95 else f"{time:.0f} s"


class Stages:
    """Says what is done, a line a stage as it begins, and how long it took once it is over, if that is worth a line.

    A text that is indented is a part of the stage before; a stage is over when another begins that is no part of it.

    Example:
        >>> stages = Stages(print)
        >>> stages("Fitting")
        Fitting
        >>> stages.end()  # after a minute
        Fitting (60 s, 60 s in all)

    Args:
        say: Takes the lines.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._begun = say, monotonic()
        self._open: list[tuple[str, float]] = []

    def __call__(self, text: str) -> None:
        """Begins a stage."""
        self._close(_indent(text))
        self._open.append((text, monotonic()))
        self._say(text)

    def end(self) -> None:
        """The last stage is over."""
        self._close(0)

    def _close(self, indent: int) -> None:
        now = monotonic()
        while self._open and _indent(self._open[-1][0]) >= indent:
            text, begun = self._open.pop()
            if now - begun >= _WORTH:
                in_all = "" if _indent(text) else f", {seconds(now - self._begun)} in all"
                self._say(f"{text} ({seconds(now - begun)}{in_all})")


def _indent(text: str) -> int:
    return len(text) - len(text.lstrip())


class Bars:
    """Progress bars by name, one under another, on rich's console; or nothing at all.

    A bar that is taken away leaves a line with how long it was there. Where that is no terminal, as in a file, each
    name is a line, once it begins, and another, once it is over.

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
            TransferSpeedColumn,
        )
        from rich.table import Column
        from rich.text import Text

        class Counts(MofNCompleteColumn):
            """Nothing where nothing is counted."""

            def render(self, task: Task) -> Text:
                return Text() if task.total is None else super().render(task)

        class Times(ProgressColumn):
            """How long it has taken, and how much longer it will."""

            max_refresh = 0.5

            def render(self, task: Task) -> Text:
                left = "" if task.finished or not task.time_remaining else f", {seconds(task.time_remaining)} left"
                elapsed = task.finished_time if task.finished else task.elapsed
                return Text(f"{seconds(elapsed or 0.0)}{left}")

        bytes_, steps = (DownloadColumn, TransferSpeedColumn), (Counts, Times)
        counts: list[ProgressColumn] = [column() for column in (bytes_ if of_bytes else steps)]
        text = TextColumn("{task.description}", markup=False, table_column=Column())  # which wraps: the counts are seen
        console = get_console()
        self._in_lines = shown and not (console.is_terminal or console.is_jupyter)
        self._bars = Progress(text, BarColumn(bar_width=20), *counts, disable=not shown or self._in_lines)
        self._tasks: dict[str, TaskID] = {}
        self._busy: tuple[str, float, TaskID] | None = None
        self._stages = Stages(self._line)

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._rest()
        self._stages.end()
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
            self._begin(name)
        description = f"{name}: {text}" if text else name
        self._bars.update(self._tasks[name], completed=done, total=total, description=description)

    def busy(self, name: str) -> None:
        """A bar that moves without count, until something else is shown: for what takes seconds and has no steps.

        Args:
            name: What is done.
        """
        self._rest()
        self._busy = name, monotonic(), self._bars.add_task(name, total=None)
        self._begin(name)

    def _begin(self, name: str) -> None:
        if self._in_lines:
            self._stages(f"  {name}")

    def _line(self, text: str) -> None:
        self._bars.console.print(text, markup=False, highlight=False)

    def _rest(self) -> None:
        if self._busy is None:
            return
        (name, begun, task), self._busy = self._busy, None
        self._bars.remove_task(task)
        if not self._bars.disable and monotonic() - begun >= _WORTH:
            self._line(f"{name} ({seconds(monotonic() - begun)})")

    def advance(self, name: str, by: int) -> None:
        """Moves the bar of a name that :meth:`show` has added."""
        self._bars.advance(self._tasks[name], by)
