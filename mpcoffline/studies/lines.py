"""Results in a CSV file: a line a case, on the disk as soon as it is known, so that a study can stop at any time."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Hashable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

from mpcoffline.core.errors import FileFormatError, StorageError


class Line(Protocol):
    """A dataclass of numbers and texts."""

    @property
    def key(self) -> Hashable:
        """What makes it the same case."""


L = TypeVar("L", bound=Line)


def append(path: Path, line: Line) -> None:
    """Adds a line to a CSV file, which it begins where there is none; on the disk when it returns.

    Raises:
        StorageError: If it cannot be written.
    """
    columns = [field.name for field in fields(cast("Any", line))]
    figures = asdict(cast("Any", line)).items()
    values = {key: f"{value:.10g}" if isinstance(value, float) else value for key, value in figures}
    try:
        with path.open("a+b") as file:
            text = io.StringIO()
            writer = csv.DictWriter(text, columns, lineterminator="\n")
            if (size := file.seek(0, os.SEEK_END)) == 0:
                writer.writeheader()
            else:
                file.seek(size - 1)
                if file.read(1) != b"\n":  # what a killed process has left
                    text.write("\n")
            writer.writerow(values)
            file.write(text.getvalue().encode())  # at the end, whatever was read
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise StorageError.of(path, error) from error


def read(path: Path, kind: type[L]) -> list[L]:
    """The lines of a kind in a CSV file, the last of each case; those that are not whole are passed over.

    Raises:
        FileFormatError: For a file with other columns.
    """
    if not path.exists():
        return []
    columns = [field.name for field in fields(cast("Any", kind))]
    with path.open(encoding="utf-8", newline="") as file:
        lines = list(csv.reader(file))
    if lines and lines[0] != columns:
        expected = "results of this version and kind"
        raise FileFormatError(str(path), expected=expected, actual="other columns", hint="Write to another file.")
    found: dict[Hashable, L] = {}
    kinds = {field.name: field.type for field in fields(cast("Any", kind))}
    convert: dict[str, Callable[[str], float | int | str]] = {"int": int, "float": float, "str": str}
    for line in lines[1:]:
        if len(line) != len(columns):
            continue
        try:
            values = {name: convert[str(kinds[name])](value) for name, value in zip(columns, line, strict=True)}
        except ValueError:
            continue
        outcome = kind(**values)
        found[outcome.key] = outcome
    return list(found.values())
