"""Files and frames as batches of columns: encodings, separators, headers. Polars reads; this finds out how."""

from __future__ import annotations

import codecs
import csv
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError, StorageError

from .units import EXTRA

if TYPE_CHECKING:
    import polars as pl

BATCH = 250_000  # rows
_HEAD = 64 * 1024  # bytes that are looked at
_LINES = 50
_FEWEST_LINES, _LONGEST_HEAD = 5, 1 << 24  # that are looked at, of tables with thousands of columns
_SEPARATORS, _FEW_NUMBERS = ",;\t|", 0.2  # share of cells below the header
_BINARY = {
    b"\xfd7zXZ": ("an xz archive", "Unpack it first."),
    b"BZh": ("a bzip2 archive", "Unpack it first."),
    b"\x28\xb5\x2f\xfd": ("a zstd archive", "Unpack it first."),
    b"7z\xbc\xaf": ("a 7z archive", "Unpack it first."),
    b"%PDF": ("a PDF", "Export the table as CSV or Parquet."),
    b"{": ("JSON", "Export the table as CSV or Parquet."),
    b"[{": ("JSON", "Export the table as CSV or Parquet."),
    b"[[": ("JSON", "Export the table as CSV or Parquet."),
    b"MATLAB": ("a MATLAB file", "Export the table as CSV or Parquet."),
    b"\x93NUMPY": ("a NumPy array", "Export the table as CSV or Parquet, with names."),
    b"FEA1": ("an old Feather file", "Save it as Parquet or Arrow."),
    b"PK\x03\x04": ("an archive, as of Excel", "Save it as CSV or Parquet."),
    b"\x1f\x8b": ("a gzip archive", "Unpack it first."),
    b"SQLite": ("a database", "Export the table as CSV or Parquet."),
    b"\x89HDF": ("an HDF5 file", "A Minari data set is loaded by its id; export anything else as CSV."),
    b"\xd0\xcf\x11\xe0": ("an old Excel file", "Save it as CSV or Parquet."),
}
_NUMBER = r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?"


def polars() -> Any:
    """The package polars.

    Raises:
        InvalidArgumentError: If it is not installed.
    """
    try:
        import polars
    except ImportError as error:
        raise InvalidArgumentError("logs", expected="the package polars", actual="not installed", hint=EXTRA) from error
    return polars


@dataclass
class Source:
    """A log that can be read batch by batch.

    Attributes:
        name: What messages call it.
        header: Names of its columns.
        units: Units in a row below the header, by place; None where there is no such row.
        frames: Yields frames of columns named by their places, ``"0"``, ``"1"``, ...
        decimal_comma: Whether numbers are written 1,5.
        first: Line of the first row; 0 of what has no lines.
        notes: What was found out, in words.
    """

    name: str
    header: list[str]
    units: list[str] | None
    frames: Iterator[pl.DataFrame]
    decimal_comma: bool = False
    first: int = 0
    notes: tuple[str, ...] = ()

    def place(self, row: int) -> str:
        """What messages call a row."""
        return f"{self.name}, line {self.first + row}" if self.first else f"{self.name}, row {row}"


@contextmanager
def opened(source: Any) -> Iterator[Source]:
    """A log: a file (text, Parquet, Arrow) or a frame (polars, pandas, pyarrow).

    Raises:
        InvalidArgumentError: For anything else, or without polars.
        StorageError: For a file that cannot be read.
        InvalidDataError: For a file that is empty, binary, or no table.
    """
    pl = polars()
    if not isinstance(source, str | Path):
        yield _of_frame(pl, source)
        return
    path = Path(source)
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError as error:
        raise StorageError(str(path), expected="a log", actual=error.strerror or str(error)) from error
    name = path.name
    if not head.strip():
        raise InvalidDataError(name, expected="a table with a header", actual="an empty file")
    try:
        if head.startswith(b"PAR1"):
            yield _of_lazy(name, pl.scan_parquet(path))
            return
        if head.startswith(b"ARROW1"):
            yield _of_lazy(name, pl.scan_ipc(path))
            return
        if head.startswith(b"\xff\xff\xff\xff"):
            yield _of_lazy(name, pl.read_ipc_stream(path).lazy())
            return
    except pl.exceptions.PolarsError as error:
        raise InvalidDataError(name, expected="a table", actual=str(error).splitlines()[0][:200]) from error
    for magic, (what, hint) in _BINARY.items():
        if head.startswith(magic):
            raise InvalidDataError(name, expected="a table as CSV, Parquet or Arrow", actual=what, hint=hint)
    with _in_utf8(path, head) as (plain, encoding):
        yield _of_text(pl, name, plain, encoding)


def _of_frame(pl: Any, source: Any) -> Source:
    """A frame that is in memory."""
    if isinstance(source, pl.LazyFrame):
        return _of_lazy("frame", source)
    try:
        frame = source if isinstance(source, pl.DataFrame) else pl.DataFrame(source)
    except Exception as error:  # whatever polars or the frame's library raises
        expected = "a file, or a frame of polars, pandas or pyarrow"
        raise InvalidArgumentError("log", expected=expected, actual=type(source).__name__) from error
    if not isinstance(source, pl.DataFrame | dict) and not hasattr(source, "__arrow_c_stream__"):
        expected = "a file, or a frame of polars, pandas or pyarrow"
        raise InvalidArgumentError("log", expected=expected, actual=type(source).__name__)
    return _of_lazy("frame", frame.lazy())


def _of_lazy(name: str, frame: Any) -> Source:
    header = frame.collect_schema().names()
    if not header:
        raise InvalidDataError(name, expected="columns", actual="none")
    renamed = frame.rename({old: str(i) for i, old in enumerate(header)})
    return Source(name, [str(each) for each in header], None, renamed.collect_batches(chunk_size=BATCH))


@contextmanager
def _in_utf8(path: Path, head: bytes) -> Iterator[tuple[Path, str]]:
    """The file in UTF-8, itself where it is, and the encoding that it had."""
    encoding = _encoding(path, head)
    if encoding == "utf-8" and (b"\n" in head or b"\r" not in head):  # line ends of old Macs are none to polars
        yield path, encoding
        return
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "log.csv"
        try:
            with path.open(encoding=encoding) as old, plain.open("w", encoding="utf-8") as new:
                shutil.copyfileobj(old, new, 1 << 20)
        except UnicodeError as error:
            raise InvalidDataError(path.name, expected="text", actual=f"bytes that are none ({error})") from error
        yield plain, encoding


def _encoding(path: Path, head: bytes) -> str:
    """By its mark, its zero bytes, or whether it is valid UTF-8 throughout."""
    if head.startswith((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)):
        return "utf-32"
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    even, odd = head[0:2000:2].count(0), head[1:2000:2].count(0)
    size = min(len(head), 2000) // 2
    if odd > 0.4 * size and even == 0:
        return "utf-16-le"
    if even > 0.4 * size and odd == 0:
        return "utf-16-be"
    if even + odd:
        raise InvalidDataError(path.name, expected="a table as CSV, Parquet or Arrow", actual="a binary file")
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 22):
                decoder.decode(block)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _of_text(pl: Any, name: str, path: Path, encoding: str) -> Source:
    """A text table; where it begins and how it is written is told by its first lines."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        text = file.read(_HEAD)
        while text.count("\n") < _FEWEST_LINES and len(text) < _LONGEST_HEAD and (more := file.read(len(text))):
            text += more
    lines = text.splitlines()[: _LINES + 30]
    try:
        separator, skipped = _layout(name, lines)
        rows = list(csv.reader(lines[skipped:], delimiter=separator))[:_LINES]
    except csv.Error as error:
        raise InvalidDataError(name, expected="a table of numbers", actual=f"no row of one ({error})") from error
    header = [cell.strip() for cell in rows[0]]
    if len(rows) < 2:
        raise InvalidDataError(name, expected="rows below the header", actual="none")
    if any(re.fullmatch(_NUMBER, cell) for cell in header):
        hint = "Write the columns' names into the first line."
        above = next(csv.reader(lines[skipped - 1 : skipped], delimiter=separator)) if skipped else []
        if len(above) > 1 and not any(map(_is_value, above)):
            hint = "Are there commas both in numbers and between columns? Quote the numbers, or use another separator."
            if len(above) > len(header):
                hint = "Is there a name too many, or do the rows end early?"
            expected = f"{len(above)} cells, as in the header"
            raise InvalidDataError(f"{name}, line {skipped + 1}", expected=expected, actual=str(len(header)), hint=hint)
        raise InvalidDataError(f"{name}, line {skipped + 1}", expected="a header", actual=f"{rows[0]}"[:200], hint=hint)
    first, units = skipped + 2, None
    if len(rows) > 2 and not any(map(_is_value, rows[1])) and any(map(_is_value, rows[2])):
        first += 1
        if rows[1] != rows[0]:  # else the header again
            units = [cell.strip(" []()") for cell in rows[1]]
    comma = _has_decimal_comma(rows[first - skipped - 1 :], separator)
    notes = [f"{encoding} text"] if encoding != "utf-8" else []
    notes += [f"columns separated by {_named(separator)}"] if separator != "," else []
    notes += ["decimal commas"] if comma else []
    notes += [f"{skipped} lines above the header left out"] if skipped else []
    lazy = pl.scan_csv(
        path,
        separator=separator,
        has_header=False,
        skip_lines=first - 1,
        new_columns=[str(i) for i in range(len(header))],
        schema={str(i): pl.String for i in range(len(header))},
        quote_char='"',
    )
    frames = _told(pl, name, lazy.collect_batches(chunk_size=BATCH), path, separator, first, len(header))
    return Source(name, header, units, frames, comma, first, tuple(notes))


def _told(
    pl: Any, name: str, frames: Iterator[Any], path: Path, separator: str, first: int, width: int
) -> Iterator[Any]:
    """The frames; a row of too many cells is an error that names its line."""
    try:
        yield from frames
    except pl.exceptions.PolarsError as error:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, delimiter=separator)
            for row in _until_broken(reader):
                if reader.line_num >= first and len(row) > width:
                    hint = "Is a comma in a number or a name? Quote it, or use another separator."
                    expected = f"{width} cells, as in the header"
                    where = f"{name}, line {reader.line_num}"
                    raise InvalidDataError(where, expected=expected, actual=str(len(row)), hint=hint) from error
        line = _open_quote(path, first)
        if line:
            hint = "Is a quotation mark missing, or one too many?"
            raise InvalidDataError(
                f"{name}, line {line}", expected="a quotation mark at the end of the cell", actual="none", hint=hint
            ) from error
        raise InvalidDataError(name, expected="a table", actual=str(error).splitlines()[0][:200]) from error


def _until_broken(reader: Iterator[list[str]]) -> Iterator[list[str]]:
    """Rows until one that is longer than any."""
    with suppress(csv.Error):
        yield from reader


def _open_quote(path: Path, first: int) -> int:
    """The first line with a quotation mark that nothing closes; 0 for none."""
    with path.open(encoding="utf-8-sig") as file:
        for number, line in enumerate(file, 1):
            if number >= first and line.count('"') % 2:
                return number
    return 0


def _layout(name: str, lines: list[str]) -> tuple[str, int]:
    """What separates columns, and how many lines come before the header."""
    best: tuple[bool, bool, int, int, str, int] | None = None
    for separator in _SEPARATORS:
        rows = list(csv.reader(lines, delimiter=separator))
        counts = [len(row) for row in rows]
        usual, times = Counter(counts[-max(1, len(counts) - 20) :] or [0]).most_common(1)[0]
        if usual < 2:
            continue
        start = next((i for i, n in enumerate(counts) if n == usual), 0)
        # Decimal commas split numbers alike in every row, but not the names above them.
        named = not any(re.fullmatch(_NUMBER, cell.strip()) for cell in rows[start])
        below = [cell.strip() for row in rows[-20:] for cell in row]
        # ... and where text stands at both ends of a row, no number is left whole.
        whole = sum(bool(re.fullmatch(_NUMBER, cell)) for cell in below) > _FEW_NUMBERS * len(below)
        found = named, whole, times, usual, separator, start
        if best is None or found[:3] > best[:3] or (found[:2] >= best[:2] and usual > best[3] + 1):
            best = found
    if best is None:
        hint = "Columns are separated by a comma, a semicolon, a tab or a bar."
        raise InvalidDataError(name, expected="a table of several columns", actual="one column", hint=hint)
    return best[4], best[5]


def _is_value(cell: str) -> bool:
    text = cell.strip()
    return bool(re.fullmatch(_NUMBER, text)) or bool(re.match(r"\d{1,4}[-./]\d{1,2}[-./]", text))


def _has_decimal_comma(rows: list[list[str]], separator: str) -> bool:
    cells = [cell.strip() for row in rows for cell in row]
    commas = sum(bool(re.fullmatch(r"[+-]?\d*,\d+([eE][+-]?\d+)?", cell)) for cell in cells)
    points = sum(bool(re.fullmatch(r"[+-]?\d*\.\d+([eE][+-]?\d+)?", cell)) for cell in cells)
    return commas > points


def _named(separator: str) -> str:
    return {";": "semicolons", "\t": "tabs", "|": "bars"}.get(separator, separator)
