"""Transitions, and data sets, of the log file of a real plant."""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.core.text import as_name
from mpcoffline.datasets.table.numbers import real_numbers
from mpcoffline.datasets.table.transitions import TransitionTable

from .from_arrays import dataset_from_arrays

_RESAMPLED = "mpcoffline.Plant.read resamples to the control interval of a described plant."
_RAW = (
    "mpcoffline.Plant.read takes a log as a historian writes it: empty cells, time stamps, decimal commas, other units."
)

Cost = Callable[[NDArray[np.float64], NDArray[np.float64]], ArrayLike]


def from_csv(
    path: str | Path,
    *,
    observations: Sequence[str],
    actions: Sequence[str],
    cost: Cost | str,
    episode: str | None = None,
    time: str | None = None,
    dt: float | None = None,
    split_gaps: bool = False,
    delimiter: str = ",",
    dataset_id: str | None = None,
    overwrite: bool = False,
) -> TransitionTable:
    """Reads the log of a real plant: a text table with a header, one row a sampling instant.

    Row k holds the observation s_k and the action a_k that acts until row k+1; so the last row of an episode gives
    only the s+ of the one before it, and episodes end cut off, not terminated.

    Args:
        path: The file.
        observations: Names of the columns of s, ``ny``.
        actions: Names of the columns of a, ``nu``.
        cost: L(s, a) for arrays ``(n, ny)`` and ``(n, nu)``, giving ``(n,)``; or the name of a column.
        episode: Name of a column that says which episode a row belongs to (any text); by default all are one.
        time: Name of the column of the time in seconds, to check the sampling time.
        dt: The sampling time in seconds; rows must be this far apart, to 1 %.
        split_gaps: Whether a row at another distance begins a new episode instead of being an error.
        delimiter: What separates columns.
        dataset_id: Also stores the log as a Minari data set of this id.
        overwrite: Whether an existing data set of this id may be replaced.

    Returns:
        The transitions.

    Raises:
        InvalidArgumentError: For ``time`` without ``dt`` or the reverse, no columns, or a bad id or one that exists.
        InvalidDataError: For a missing column, a cell that is not a finite number, rows that do not follow each other
            by ``dt``, an episode in two pieces, or costs of another shape; names line and column.
    """
    if (time is None) != (dt is None) or (dt is not None and not dt > 0.0):
        raise InvalidArgumentError("time, dt", expected="both or neither, dt > 0", actual=f"{time!r}, {dt}")
    if not observations or not actions or isinstance(observations, str) or isinstance(actions, str):
        raise InvalidArgumentError(
            "observations, actions", expected="lists of column names", actual=f"{observations!r}, {actions!r}"
        )
    name = f"file {path}"
    numbers = [*observations, *actions, *([time] if time else []), *([cost] if isinstance(cost, str) else [])]
    values, labels, lines = _read(Path(path), name, numbers, episode, delimiter)
    starts = _starts(name, labels, lines, episode)
    ny, nu = len(observations), len(actions)
    if dt is not None:
        gaps = np.diff(values[:, ny + nu])
        wrong = (np.abs(gaps - dt) > 0.01 * dt) & ~starts[1:]
        if wrong.any() and not split_gaps:
            row = int(np.flatnonzero(wrong)[0]) + 1
            raise InvalidDataError(
                f"{name}, line {lines[row]}: {time}",
                expected=f"{dt:g} s more than the row before",
                actual=f"{gaps[row - 1]:g} s ({int(wrong.sum())} such rows)",
                hint=_hint_of_gaps(gaps[~starts[1:]], dt),
            )
        starts[1:] |= wrong
    goes_on = np.flatnonzero(~starts[1:])
    if len(goes_on) == 0:
        raise InvalidDataError(name, expected="two rows of one episode", actual=f"{len(values)} rows in as many")
    s, a = values[:, :ny], values[:, ny : ny + nu]
    costs = (
        values[goes_on, -1] if isinstance(cost, str) else real_numbers(name, "cost(s, a)", cost(s[goes_on], a[goes_on]))
    )
    if costs.shape != goes_on.shape or not np.isfinite(costs).all():
        bad = costs.shape == goes_on.shape
        where = f", line {lines[goes_on[np.flatnonzero(~np.isfinite(costs))[0]]]}" if bad else ""
        raise InvalidDataError(
            f"{name}{where}: cost(s, a)",
            expected=f"finite numbers of shape {goes_on.shape}",
            actual=str(costs[~np.isfinite(costs)][0]) if bad else f"shape {costs.shape}",
        )
    ids = np.cumsum(starts) - 1
    table = TransitionTable.from_arrays(
        s[goes_on], a[goes_on], costs, s[goes_on + 1], np.zeros(len(goes_on)), ids[goes_on], name=name
    )
    table.names = tuple(map(as_name, (*observations, *actions)))
    if dataset_id is not None:
        pieces = [goes_on[ids[goes_on] == i] for i in np.unique(ids[goes_on])]
        order = np.searchsorted(goes_on, np.concatenate(pieces))
        ends = np.cumsum([len(piece) for piece in pieces])
        parts = np.split(costs[order], ends[:-1])
        dataset_from_arrays(
            dataset_id,
            [(s[k[0] : k[-1] + 2], a[k], c) for k, c in zip(pieces, parts, strict=True)],
            description=f"Log {Path(path).name}.",
            names=table.names,
            overwrite=overwrite,
        )
    return table


def _read(
    path: Path, name: str, columns: list[str], episode: str | None, delimiter: str
) -> tuple[NDArray[np.float64], list[str], list[int]]:
    """Numbers ``(n, len(columns))``, each row's episode, and its line in the file."""
    rows: list[list[float]] = []
    labels: list[str] = []
    lines: list[int] = []
    with path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file, delimiter=delimiter)
        try:
            header = [cell.strip() for cell in next(reader, [])]
            places = []
            for column in [*columns, *([episode] if episode else [])]:
                if header.count(column) != 1:
                    raise InvalidDataError(
                        f"{name}, line 1: column {column!r}",
                        expected=f"one of that name among {', '.join(header) or '(none)'}",
                        actual=str(header.count(column)),
                    )
                places.append(header.index(column))
            for row in reader:
                if not row:
                    continue
                if len(row) != len(header):
                    raise InvalidDataError(
                        f"{name}, line {reader.line_num}", expected=f"{len(header)} columns", actual=str(len(row))
                    )
                rows.append([_number(name, reader.line_num, c, row[i]) for c, i in zip(columns, places, strict=False)])
                labels.append(row[places[-1]].strip() if episode else "")
                lines.append(reader.line_num)
        except (csv.Error, UnicodeDecodeError) as error:
            raise InvalidDataError(
                f"{name}, line {reader.line_num + 1}", expected="a text table", actual=str(error)
            ) from error
    if not rows:
        raise InvalidDataError(name, expected="at least two rows", actual="none")
    return np.array(rows), labels, lines


def _number(name: str, line: int, column: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        expected, actual = "a finite number", repr(cell)
        raise InvalidDataError(f"{name}, line {line}: column {column!r}", expected=expected, actual=actual, hint=_RAW)
    return value


def _hint_of_gaps(gaps: NDArray[np.float64], dt: float) -> str:
    """What to do about rows at other distances: most of them, and it is the sampling time; a few, and they are gaps."""
    usual = float(np.median(gaps))
    if abs(usual - dt) > 0.01 * dt:
        return f"Rows are {usual:g} s apart: pass dt={usual:g}. {_RESAMPLED}"
    return "Name the column that tells episodes apart, or pass split_gaps=True."


def _starts(name: str, labels: list[str], lines: list[int], episode: str | None) -> NDArray[np.bool_]:
    """Whether each row begins an episode, ``(n,)``."""
    starts = np.array([True, *(b != a for a, b in itertools.pairwise(labels))])
    seen: set[str] = set()
    for row in np.flatnonzero(starts):
        if labels[row] in seen:
            raise InvalidDataError(
                f"{name}, line {lines[row]}: column {episode!r}",
                expected="the rows of an episode in one piece",
                actual=f"episode {labels[row]!r} again",
            )
        seen.add(labels[row])
    return starts
