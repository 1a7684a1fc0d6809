"""Columns of a log that nothing is read from, yet may tell rows apart: modes of operation, quality of values."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Collection, Sequence
from typing import Any

from .sources import polars

_MOST = 6  # words that a mode has
_FILLED = 0.5  # share of rows that have one of them
_LONGEST = 60  # characters of a word, or of a header


class Modes:
    """Counts the words in columns of few."""

    def __init__(self) -> None:
        self._rows = 0
        self._counts: dict[str, Counter[str]] = {}
        self._others: set[str] = set()

    def add(self, header: Sequence[str], frame: Any, read: Collection[int]) -> None:
        """Takes a batch.

        Args:
            header: Names of its columns.
            frame: The batch, columns named by their places.
            read: Places of columns that something is read from.
        """
        self._rows += len(frame)
        for i, name in enumerate(header):
            if i in read or not _plain(name) or name in self._others:
                continue
            if not self._counted(name, frame[str(i)]):
                self._others.add(name)
                self._counts.pop(name, None)

    def _counted(self, name: str, series: Any) -> bool:
        """Whether a column still holds few words, which are no numbers."""
        pl = polars()
        if series.dtype not in (pl.String, pl.Boolean, pl.Categorical):
            return False
        words = series.cast(pl.String).str.strip_chars()
        few = words.filter(words != "").value_counts().head(_MOST + 1)
        texts = few[:, 0]
        if (
            len(few) > _MOST
            or texts.str.replace(",", ".", literal=True).cast(pl.Float64, strict=False).is_not_null().any()
        ):
            return False
        own = self._counts.setdefault(name, Counter())
        own.update(dict(zip(texts.to_list(), few[:, 1].to_list(), strict=True)))
        return len(own) <= _MOST

    @property
    def notes(self) -> list[str]:
        """What these columns hold, a sentence each."""
        told = []
        for name, counts in self._counts.items():
            if len(counts) < 2 or counts.total() < _FILLED * self._rows or not all(map(_plain, counts)):
                continue
            shares = ", ".join(f"{word!r} in {n / self._rows:.1%}" for word, n in counts.most_common())
            one = counts.most_common(1)[0][0]
            told.append(
                f"column {name!r} is not used: {shares} of the rows; where={{{name!r}: {one!r}}}"
                f" (--where {shlex.quote(f'{name}={one}')}) reads these alone"
            )
        return told


def _plain(text: str) -> bool:
    return bool(text) and len(text) <= _LONGEST and text.isprintable()
