"""Forty logs that are broken in one way each: what is said of them, or that their numbers are right all the same."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from tank_logs import START, simulated, text

LOG = simulated()
_TEXT = text(LOG)
_LINES = _TEXT.splitlines()


def _header(header: str) -> str:
    return "\n".join([header, *_LINES[1:]])


def _cells(change: Callable[[list[str]], list[str]], *lines: int) -> str:
    """The log with some lines changed, all but the header by default; the header is line 1."""
    chosen = set(lines) or set(range(2, len(_LINES) + 1))
    return "\n".join(",".join(change(line.split(","))) if n in chosen else line for n, line in enumerate(_LINES, 1))


def _times(form: Callable[[int], str]) -> str:
    return "\n".join([_LINES[0], *(form(i) + line[line.index(",") :] for i, line in enumerate(_LINES[1:]))])


def _stamp(i: int, form: str = "%Y-%m-%d %H:%M:%S") -> str:
    return (START + np.timedelta64(5 * i, "s")).item().strftime(form)


def _of_polars(write: Callable[[Any, Any], Any]) -> bytes:
    import polars as pl

    out = io.BytesIO()
    write(pl.DataFrame({"time": LOG.t, "h1": LOG.h1, "h2": LOG.h2, "pump": LOG.pump, "set_point": LOG.set_point}), out)
    return out.getvalue()


def _cell(place: int, value: str) -> Callable[[list[str]], list[str]]:
    return lambda cells: [value if i == place else each for i, each in enumerate(cells)]


#: Right numbers in spite of what is wrong: nothing may be lost.
MENDED: dict[str, str | bytes] = {
    "Chinese letters of GB 18030": "\n".join(f"{line},{'好' if i else '备注'}" for i, line in enumerate(_LINES)).encode(
        "gb18030"
    ),
    "UTF-32": _TEXT.encode("utf-32"),
    "UTF-16, big end first, no mark": _TEXT.encode("utf-16-be"),
    "a letter that is no UTF-8": "\n".join(f"{line},\xb5" for line in _LINES).encode("latin-1"),
    "line ends of old Macs": _TEXT.replace("\n", "\r"),
    "line ends of two kinds": _TEXT.replace("\n", "\r\n", 20),
    "decimal commas in quotes, commas between": _cells(lambda cells: [f'"{c.replace(".", ",")}"' for c in cells]),
    "Excel's separator line": "sep=;\n" + _TEXT.replace(",", ";"),
    "comment lines above": "# exported\n# by X\n" + _TEXT,
    "the header twice": _LINES[0] + "\n" + _TEXT,
    "the header again in between": "\n".join([*_LINES[:30], _LINES[0], *_LINES[30:]]),
    "a sum below": _TEXT + "\nTotal rows: 60\n",
    "a separator at each line's end": "\n".join(f"{line}," for line in _LINES),
    "row numbers without a header": "\n".join(f"{i or ''},{line}" for i, line in enumerate(_LINES)),
    "empty brackets for a unit": _header("time,h1 [],h2 [cm],pump,set_point"),
    "day and month that could be exchanged": _times(lambda i: _stamp(i, "%d/%m/%Y %H:%M:%S")),
    "times of day over midnight": _times(
        lambda i: f"{(86_300 + 5 * i) // 3600 % 24:02d}:{(86_300 + 5 * i) // 60 % 60:02d}:{(86_300 + 5 * i) % 60:02d}"
    ),
    "days since 1899, as of Excel": _times(lambda i: f"{45_000 + 5 * i / 86_400:.9f}"),
    "UTC behind the stamp": _times(lambda i: f"{_stamp(i)} UTC"),
    "nanoseconds since 1970": _times(lambda i: f"{1_772_431_200_000_000_000 + 5_000_000_000 * i}"),
    "a bell in a name": _header("time,h1 [cm],h2 [cm],pu\x07mp,set_point"),
    "an Arrow stream": b"",
}

#: What is refused, and the words for it.
REFUSED: dict[str, tuple[str | bytes, str]] = {
    "decimal commas, commas between": (
        _cells(lambda cells: [c.replace(".", ",") for c in cells]),
        "log.csv, line 2: expected 5 cells, as in the header, got 8. Are there commas both in numbers and between",
    ),
    "blanks between columns": (_TEXT.replace(",", " "), "log.csv: expected a table of several columns, got one column"),
    "a quotation mark that nothing closes": (
        _cells(_cell(1, '"9.1'), 31),
        "log.csv, line 31: expected a quotation mark at the end of the cell, got none",
    ),
    "units in the cells": (
        _cells(lambda cells: [cells[0], cells[1] + " cm", *cells[2:]]),
        r"log.csv, line 2: column 'h1 \[cm\]': expected a number, got '9.0000 cm' \(60 of 60 rows\)",
    ),
    "an empty name": (_header("time,h1 [cm],,pump,set_point"), "column of 'h2': expected one among 'time', 'h1"),
    "a temperature for a level": (
        _header("time,h1 [degC],h2 [cm],pump,set_point"),
        r"column 'h1 \[degC\]': unit: expected a unit that can become cm, got degC",
    ),
    "code for a unit": (_header("time,h1 [__import__('os')],h2,pump,set_point"), "column of 'h1': expected one among"),
    "a name too many": (
        _header(_LINES[0] + ",note"),
        "log.csv, line 2: expected 6 cells, as in the header, got 5. Is there a name too many",
    ),
    "stamps of two forms": (
        _times(lambda i: _stamp(i, "%Y-%m-%d %H:%M:%S" if i < 30 else "%d.%m.%Y %H:%M:%S")),
        "got '2026-03-02 06:00:00', and further on '02.03.2026 06:02:30'",
    ),
    "names of time zones": (
        _times(lambda i: f"{_stamp(i)} CET"),
        "got '2026-03-02 06:00:00 CET'. Leave out the zone's name, and give timezone=",
    ),
    "days alone": (
        _times(lambda i: f"2026-03-{1 + i % 28:02d}"),
        "time: expected rows at most as far apart as .* 5 s, got 86400 s",
    ),
    "one time throughout": (
        _times(lambda i: "5"),
        "log.csv: time: expected rows at two times, got 60 rows of one time",
    ),
    "times beyond all numbers": (_times(lambda i: f"{i}e300"), "time: expected rows at most as far apart as"),
    "JSON": ('{"time":1,"h1":2}\n{"time":2,"h1":2}\n', "log.csv: expected a table .*, got JSON"),
    "a PDF": (b"%PDF-1.7\n\x00\x01" * 40, "got a PDF. Export the table"),
    "a bzip2 archive": (b"BZh91AY&SY" + bytes(80), "got a bzip2 archive. Unpack it first"),
    "a pickle": (b"\x80\x04\x95\x10\x00\x00\x00" + bytes(50), "got a binary file"),
    "half a Parquet file": (b"", "log.csv: expected a table, got parquet: File out of specification"),
    "a header of ten thousand columns": (
        ",".join(["time", *(f"c{i}" for i in range(10_000))]) + "\n" + "\n".join(["1" + ",1" * 10_000] * 3),
        "columns of 'h1', 'h2', 'pump', 'set_point': expected one among 'time', 'c0', .* and 9971 more, got none",
    ),
    "one line of 20 MB": (b"a" * 20_000_000, "log.csv: expected a table of numbers, got no row of one"),
}

#: Single cells that are none: left out, and told with their row.
LEFT_OUT: dict[str, tuple[str | bytes, str, str]] = {
    "a word": (_cells(_cell(1, "abc"), 31), "h1", "text in place of a number, as 'abc'"),
    "1e400": (_cells(_cell(1, "1e400"), 31), "h1", "no number"),
    "a hexadecimal number": (_cells(_cell(2, "0x1F"), 31), "h2", "text in place of a number, as '0x1F'"),
    "two points": (_cells(_cell(1, "1.234.567"), 31), "h1", "text in place of a number, as '1.234.567'"),
    "a row that ends early": (_cells(lambda cells: cells[:2], 31), "h2", "no number"),
    "a number of a million digits": (_cells(_cell(1, "9" * 1_000_000), 31), "h1", "no number"),
}


def contents(name: str) -> bytes:
    """The file of a name."""
    if name == "an Arrow stream":
        return _of_polars(lambda frame, out: frame.write_ipc_stream(out))
    if name == "half a Parquet file":
        return _of_polars(lambda frame, out: frame.write_parquet(out))[:-50]
    found = MENDED[name] if name in MENDED else (REFUSED | LEFT_OUT)[name][0]  # type: ignore[operator]
    return found if isinstance(found, bytes) else found.encode()
