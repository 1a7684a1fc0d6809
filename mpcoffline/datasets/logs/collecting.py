"""The rows of one log or several: numbers in the plant's units, in the order of time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.types import Array

from .columns import Column, Quantity, allowed, found, place_of
from .modes import Modes
from .report import LogReport
from .sources import Source, opened
from .times import NAMES, Clock, in_zone, without_set_back
from .units import readings

_MOST_LOST = 0.2  # share of rows that may have no time stamp
_EXCEL, _NO_SECONDS = (25_569.0, 73_050.0), 1e-3  # days of 1970 and 2100, and of a control interval
_APART = 1_000.0  # control intervals between what restarts


@dataclass(frozen=True)
class Options:
    """How a log is read.

    Attributes:
        columns: Headers by name of the quantity.
        units: Units of the log by name of the quantity.
        time: Header of the time, or of date and time.
        time_format: How stamps are written, as ``"%d.%m.%Y %H:%M"``.
        timezone: Of stamps without offset, as ``"Europe/Berlin"``.
        episode: Header of what tells episodes apart.
        where: Values of further columns that rows must have, as ``{"mode": "AUTO"}``; of several, one.
        max_gap: Seconds between rows beyond which a new episode begins.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    time: str | Sequence[str] | None = None
    time_format: str | None = None
    timezone: str | None = None
    episode: str | None = None
    where: Mapping[str, Any] = field(default_factory=dict)
    max_gap: float | None = None


@dataclass
class Rows:
    """Rows in the order of time.

    Attributes:
        t: Seconds since the first row, increasing, ``(n,)``.
        epoch: Seconds from 1970, or from where the log counts, to the first row.
        values: By name, NaN where there is none, ``(n,)`` each.
        blocked: Rows that nothing may reach over, ``(n,)``.
        origin: The row of the log that each was, ``(n,)``; None where they are in order.
        files: First row and source of each file.
    """

    t: Array
    epoch: float
    values: dict[str, Array]
    blocked: NDArray[np.bool_]
    origin: NDArray[np.intp] | None
    files: list[tuple[int, Source]]

    def place(self, row: int) -> str:
        """What messages call a row."""
        own = min(row, len(self.t) - 1)
        return _place(self.files, own if self.origin is None else int(self.origin[own]))


def _place(files: list[tuple[int, Source]], row: int) -> str:
    start, source = next(each for each in reversed(files) if each[0] <= row)
    return source.place(row - start)


@dataclass
class _Parts:
    """What was collected so far."""

    values: dict[str, list[Array]] = field(default_factory=dict)
    times: list[Array] = field(default_factory=list)
    kept: list[NDArray[np.bool_]] = field(default_factory=list)
    episodes: list[Any] = field(default_factory=list)
    files: list[tuple[int, Source]] = field(default_factory=list)
    rows: int = 0
    absolute: bool = True
    zoned: bool = False
    unitless: bool = True
    modes: Modes = field(default_factory=Modes)


def collected(
    sources: Sequence[Any], quantities: Sequence[Quantity], dt: float, options: Options, report: LogReport
) -> Rows:
    """The rows of some logs.

    Args:
        sources: Files or frames.
        quantities: What is read of them.
        dt: Control interval in s.
        options: How they are read.
        report: Where it is entered what was left out.

    Raises:
        InvalidDataError: For a log that cannot be understood; names row and column.
    """
    parts = _Parts(values={each.name: [] for each in quantities})
    for each in sources:
        with opened(each) as source:
            _collect(source, quantities, dt, options, report, parts)
    report.rows = parts.rows
    report.note(*parts.modes.notes)
    _days(parts, dt, report)
    t, kept = np.concatenate(parts.times), np.concatenate(parts.kept)
    parts.times.clear()
    begins = _begins(parts, t)
    values = {name: np.concatenate(parts.values.pop(name)) for name in list(parts.values)}
    lost = ~np.isfinite(t)
    if lost.any():
        first = _place(parts.files, int(np.flatnonzero(lost)[0]))
        if lost.mean() > _MOST_LOST:
            actual = f"none in {lost.mean():.0%} of the rows"
            raise InvalidDataError(f"{first}: time", expected="a time stamp", actual=actual)
        report.leave_out("rows", "no time stamp", int(lost.sum()), first)
    for name, v in values.items():
        empty = np.isnan(v)
        if empty.any():
            if empty.all():
                raise InvalidDataError(
                    f"{parts.files[0][1].name}: {name}", expected="numbers", actual="no number at all"
                )
            report.leave_out(name, "no number", int(empty.sum()), _place(parts.files, int(np.flatnonzero(empty)[0])))
    if not kept.all():
        first = _place(parts.files, int(np.flatnonzero(~kept)[0]))
        report.leave_out("rows", f"not {_worded(options.where)}", int((~kept).sum()), first)
    t, epoch = _continued(t, begins, dt, options, parts, report)
    order = _ordered(t, lost, parts, report)
    if order is not None:
        t, kept = t[order], kept[order]
        values = {name: v[order] for name, v in values.items()}
    if len(t) < 2:
        if parts.rows < 2:
            raise InvalidDataError(parts.files[0][1].name, expected="two rows", actual=str(parts.rows))
        actual = f"{parts.rows} rows of one time"
        raise InvalidDataError(f"{parts.files[0][1].name}: time", expected="rows at two times", actual=actual)
    t -= (begin := float(t[0]))
    return Rows(t, epoch + begin, values, ~kept, order, parts.files)


def _collect(
    source: Source, quantities: Sequence[Quantity], dt: float, options: Options, report: LogReport, parts: _Parts
) -> None:
    """The rows of one log."""
    columns = {name: Column(each) for name, each in found(source, quantities, options.columns, options.units).items()}
    stamps, clock = _clock(source, options, {each.found.place for each in columns.values()})
    places = [(place_of(source, name, name)[0], values) for name, values in options.where.items()]
    episode = None if options.episode is None else place_of(source, options.episode, options.episode)[0]
    parts.files.append((parts.rows, source))
    read = {each.found.place for each in columns.values()} | {*stamps, *(place for place, _ in places)}
    read |= set() if episode is None else {episode}
    rows = 0
    for frame in source.frames:
        for column in columns.values():
            column.add(frame[str(column.found.place)], source.decimal_comma)
        if clock is None:
            parts.times.append(np.asarray((rows + np.arange(len(frame))) * dt, dtype=np.float64))
        else:
            parts.times.append(clock.seconds([frame[str(i)] for i in stamps], source.decimal_comma))
        kept = np.ones(len(frame), dtype=bool)
        for place, values in places:
            several = values if isinstance(values, list | tuple | set) else [values]
            kept &= allowed(frame[str(place)], list(several))
        parts.kept.append(kept)
        parts.modes.add(source.header, frame, read)
        if episode is not None:
            parts.episodes.append(np.asarray(frame[str(episode)].cast(str).to_numpy(), dtype=object))
        rows += len(frame)
    if not rows:
        raise InvalidDataError(source.name, expected="rows below the header", actual="none")
    for name, column in columns.items():
        column.check(source)
        if column.texts:
            why = f"text in place of a number, as {column.first[1]!r:.40}"
            report.leave_out(name, why, column.texts, source.place(column.first[0]))
        parts.values[name] += column.parts
        report.note(column.found.said)
    report.note(*source.notes)
    if clock is None:
        report.note(f"no column of time was found: rows are taken to be {dt:g} s apart")
    else:
        report.note(clock.said)
    parts.rows += rows
    parts.absolute &= clock is not None and clock.absolute
    parts.unitless &= clock is not None and clock.unitless
    parts.zoned |= clock is not None and clock.zoned


def _days(parts: _Parts, dt: float, report: LogReport) -> None:
    """Plain numbers that are no seconds, but Excel's days since 1899: as days they fit the control interval."""
    if parts.absolute or not parts.unitless:
        return
    t = np.concatenate(parts.times)
    t = t[np.isfinite(t)]
    steps = np.diff(t)
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    if len(t) and _EXCEL[0] < t.min() and t.max() < _EXCEL[1] and 0.0 < usual < _NO_SECONDS * dt:
        parts.times[:] = [86_400.0 * (each - _EXCEL[0]) for each in parts.times]
        parts.absolute = True
        report.note("time in days since 1899, as Excel writes it")


def _clock(source: Source, options: Options, quantities: set[int]) -> tuple[list[int], Clock | None]:
    """The columns of the time, and what reads them; none where there is no such column.

    Without an option it is no column that a quantity has, as T of a temperature.
    """
    if options.time is not None:
        names = [options.time] if isinstance(options.time, str) else list(options.time)
        found_ones = [place_of(source, name, name) for name in names]
    else:
        taken: dict[str, int] = {}
        for i, header in enumerate(source.header):
            for reading in readings(header) if i not in quantities else ():
                taken.setdefault(reading.name.casefold().strip(), i)
        first = next((name for name in NAMES if name in taken), None)
        if first is None:
            return [], None
        second = {"date": "time", "datum": "uhrzeit"}
        both = [f for f, s in second.items() if f in taken and s in taken]
        chosen = [taken[both[0]], taken[second[both[0]]]] if both else [taken[first]]
        if "datum" in taken and "zeit" in taken and not both:
            chosen = [taken["datum"], taken["zeit"]]
        found_ones = [(i, next((r.unit for r in readings(source.header[i]) if r.unit), None)) for i in chosen]
    places = [place for place, _ in found_ones]
    unit = found_ones[0][1]
    header = " and ".join(repr(source.header[i]) for i in places)
    return places, Clock(f"{source.name}: column {header}", unit if len(places) == 1 else None, options.time_format)


def _begins(parts: _Parts, t: Array) -> NDArray[np.intp]:
    """Rows at which something new begins whatever the time says: files without a calendar, episodes."""
    begins = np.zeros(len(t), dtype=bool)
    if not parts.absolute:
        begins[[start for start, _ in parts.files]] = True
        steps = np.diff(t)
        usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
        if np.sum(steps > 0.0) > 0.5 * len(steps):  # where the clock was started again
            begins[1:] |= (steps < 0.0) & (t[1:] <= np.nanmin(t) + 2.0 * usual)
    if parts.episodes:
        labels = np.concatenate(parts.episodes)
        begins[1:] |= labels[1:] != labels[:-1]
    begins[0] = False
    return np.flatnonzero(begins)


def _continued(
    t: Array, begins: NDArray[np.intp], dt: float, options: Options, parts: _Parts, report: LogReport
) -> tuple[Array, float]:
    """Times that only go on: in UTC, and what restarts put behind what was before."""
    if options.timezone is not None and parts.absolute and not parts.zoned:
        local = t
        t = in_zone(t, options.timezone)
        lost = np.isfinite(local) & ~np.isfinite(t)
        first = _place(parts.files, int(np.flatnonzero(lost)[0])) if lost.any() else ""
        report.leave_out("rows", f"a time that {options.timezone} does not have", int(lost.sum()), first)
    elif parts.absolute and not parts.zoned:
        t, times = without_set_back(t)
        if times:
            report.note("the clock goes back by an hour once: taken as the end of daylight saving")
    if len(begins):
        t = t.copy()
        for a, e in zip(begins, np.append(begins[1:], len(t)), strict=True):
            before = np.nanmax(t[:a])
            if not np.nanmin(t[a:e]) > before + _APART * dt:
                t[a:e] += before + _APART * dt - np.nanmin(t[a:e])
        report.note(f"{len(begins) + 1} parts, each an episode of its own")
    return t, 0.0


def _ordered(t: Array, lost: NDArray[np.bool_], parts: _Parts, report: LogReport) -> NDArray[np.intp] | None:
    """The rows in the order of time, of those of one time the last; None where they are so already."""
    lost = ~np.isfinite(t)
    steps = np.diff(t)
    if not lost.any() and (steps > 0.0).all():
        return None
    order = np.flatnonzero(~lost)
    own = t[order]
    back = np.diff(own) < 0.0
    if back.any():
        row = int(order[int(np.flatnonzero(back)[0]) + 1])
        report.note(f"{int(back.sum())} rows were out of order, the first {_place(parts.files, row)}: put in order")
        order = order[np.argsort(own, kind="stable")]
        own = t[order]
    again = np.append(np.diff(own) <= 0.0, False)
    if again.any():
        first = _place(parts.files, int(order[int(np.flatnonzero(again)[0])]))
        report.leave_out("rows", "another row of the same time follows", int(again.sum()), first)
    return np.asarray(order[~again], dtype=np.intp)


def _worded(where: Mapping[str, Any]) -> str:
    several = {name: v if isinstance(v, list | tuple | set) else [v] for name, v in where.items()}
    return " and ".join(f"{name} = {' or '.join(map(str, values))}" for name, values in several.items())
