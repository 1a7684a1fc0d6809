"""Time stamps of any usual form, to seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.core.types import Array

from .sources import polars
from .units import conversion

NAMES = (
    "time", "timestamp", "time stamp", "datetime", "date time", "date/time", "date", "t", "ts", "utc", "zeit",
    "zeitstempel", "datum", "datum/zeit", "uhrzeit", "epoch", "_time", "seconds",
)  # fmt: skip
_DATES = (
    "%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%d.%m.%Y", "%d.%m.%y", "%d/%m/%Y", "%m/%d/%Y", "%d/%m/%y", "%m/%d/%y",
    "%d-%m-%Y", "%d-%b-%Y", "%d-%b-%y", "%d %b %Y", "%b %d %Y", "%Y%m%d",
)  # fmt: skip
_CLOCKS = ("%H:%M:%S%.f", "%H:%M", "%I:%M:%S%.f %p", "%I:%M %p", "%H%M%S")
_OF_DAY = r"^(\d{1,3}):([0-5]\d)(?::([0-5]\d(?:[.,]\d+)?))?$"
_ENOUGH = 0.95  # share of a sample that a form must fit
_SAMPLE = 1_000
_YEARS = (1970, 2100)
#: Seconds of a unit of epochs, by the size of the numbers.
_EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))


class Clock:
    """Reads the time stamps of a log; the first batch tells their form.

    Args:
        where: The column, for messages.
        unit: Its unit, of numbers.
        form: As :meth:`polars.Expr.str.to_datetime` takes it; found out by default.

    Attributes:
        absolute: Whether stamps are of a calendar; False of seconds from any beginning.
        zoned: Whether they say their distance from UTC.
        unitless: Whether they are plain numbers, taken to be seconds.
        said: What was found out, in words.
    """

    absolute: bool
    zoned: bool
    unitless: bool
    said: str

    def __init__(self, where: str, unit: str | None, form: str | None) -> None:
        self._where, self._unit, self._form = where, unit, form
        self._kind = ""
        self._scale = 1.0
        self._last, self._days = -np.inf, 0  # of a clock without a date
        self.absolute = self.zoned = self.unitless = False
        self.said = ""

    def seconds(self, columns: Sequence[Any], decimal_comma: bool) -> Array:
        """Seconds ``(n,)`` of one column, or of date and time apart; NaN where a stamp is none.

        Raises:
            InvalidDataError: For stamps of no form that is known, or of two.
        """
        pl = polars()
        column = columns[0]
        if len(columns) > 1:
            column = columns[0].cast(pl.String).str.strip_chars() + " " + columns[1].cast(pl.String).str.strip_chars()
        if column.dtype in (pl.Datetime, pl.Date):
            self.absolute, self.zoned = True, bool(getattr(column.dtype, "time_zone", None))
            return _epoch(column.cast(pl.Datetime("us", getattr(column.dtype, "time_zone", None))))
        if column.dtype != pl.String:
            return self._of_numbers(np.asarray(column.cast(pl.Float64, strict=False).to_numpy(), dtype=np.float64))
        text = column.str.strip_chars()
        if not self._kind:
            self._find(text, decimal_comma)
        if self._kind == "number":
            number = text.str.replace(",", ".", literal=True) if decimal_comma else text
            return self._of_numbers(np.asarray(number.cast(pl.Float64, strict=False).to_numpy(), dtype=np.float64))
        if self._kind == "clock":
            return self._of_day(text)
        return _epoch(_plain(text, self.zoned).str.to_datetime(self._form, time_unit="us", strict=False))

    def _of_numbers(self, numbers: Array) -> Array:
        if not self._kind or (self._kind == "number" and not self.said):
            self._kind = "number"
            finite = np.abs(numbers[np.isfinite(numbers)])
            size = float(np.median(finite)) if len(finite) else 0.0
            if self._unit:
                self._scale, _ = conversion(self._where, self._unit, "s")
                self.said = f"time in {self._unit}"
            elif size > _EPOCHS[-1][0]:
                self._scale = next(scale for least, scale in _EPOCHS if size > least)
                self.absolute = self.zoned = True
                self.said = f"time since 1970 in {self._scale:g} s"
            else:
                self.absolute = self.zoned = size > 6e8
                self.unitless = not self.absolute
                self.said = "time in s" + (" since 1970" if self.absolute else "")
        return numbers * self._scale

    def _of_day(self, text: Any) -> Array:
        """Seconds from the first midnight on, or elapsed ones; what is half a day before the last is a day later."""
        pl = polars()
        parts = text.str.extract_groups(_OF_DAY).struct.unnest()
        hours, minutes, seconds = (
            np.asarray(parts[name].str.replace(",", ".").cast(pl.Float64, strict=False).to_numpy(), np.float64)
            for name in ("1", "2", "3")
        )
        t = 3600.0 * hours + 60.0 * minutes + np.nan_to_num(seconds)
        known = np.flatnonzero(np.isfinite(t))
        back = np.diff(np.append(self._last, t[known])) < -43_200.0
        if len(known):
            self._last = float(t[known[-1]])
        t[known] += 86_400.0 * (self._days + np.cumsum(back))
        self._days += int(back.sum())
        return np.asarray(t)

    def _find(self, text: Any, decimal_comma: bool) -> None:
        """The form of the first rows."""
        pl = polars()
        sample = text.filter(text.str.len_chars() > 0).head(_SAMPLE)
        if not len(sample):
            raise InvalidDataError(self._where, expected="time stamps", actual="empty cells")
        number = sample.str.replace(",", ".", literal=True) if decimal_comma else sample
        if self._form is None and number.cast(pl.Float64, strict=False).is_not_null().mean() >= _ENOUGH:
            self._kind = "number"
            return
        if self._form is None and sample.str.contains(_OF_DAY).mean() >= _ENOUGH:
            self._kind, self.said = "clock", "time of day, from day to day"
            return
        self.absolute, self._kind = True, "text"
        ends = r"([+-]\d{2}:?\d{2}|Z|UTC|GMT)$"
        self.zoned = bool(sample.str.contains(ends).mean() >= _ENOUGH and sample.str.contains(":").all())
        sample = _plain(sample, self.zoned)
        suffix = "%#z" if self.zoned else ""
        tried = [self._form] if self._form else [f"{d} {c}{suffix}" for d, c in product(_DATES, _CLOCKS)] + [*_DATES]
        fitting: dict[str, Any] = {}
        for form in tried:
            try:
                parsed = sample.str.to_datetime(form, time_unit="us", strict=False)
            except Exception as error:  # polars on a form that is none
                if self._form:
                    raise InvalidArgumentError("time_format", expected="a form", actual=repr(form)) from error
                continue
            years = parsed.dt.year()
            if (years.is_between(*_YEARS)).fill_null(value=False).mean() >= _ENOUGH:
                fitting[form] = _epoch(parsed)
        if not fitting:
            shown = f"{sample[0]!r:.60}"
            digits = sample.str.replace_all(r"\d", "0").str.replace_all(r"[A-Za-z]+", "a")
            other = sample.filter(digits != digits[0])
            if len(other) and not self._form:
                shown += f", and further on {other[0]!r:.60}"
            hint = "time_format= says how they are written, as in '%d.%m.%Y %H:%M:%S'."
            if sample.str.contains(r" [A-Z]{3,4}$").mean() >= _ENOUGH:
                hint = "Leave out the zone's name, and give timezone= as 'Europe/Berlin'."
            raise InvalidDataError(self._where, expected="time stamps of a usual form", actual=shown, hint=hint)
        self._form = _likeliest(fitting)
        self.said = f"time stamps as {self._form.replace('%#z', '%z').replace('%.f', '')}"


def _likeliest(fitting: dict[str, Any]) -> str:
    """Of forms that fit alike, day first and month first, the one in which the log spans less."""

    def spread(form: str) -> float:
        steps = np.abs(np.diff(fitting[form]))
        return float(np.nansum(steps))

    return min(fitting, key=lambda form: (round(spread(form)), list(fitting).index(form)))


def _plain(text: Any, zoned: bool) -> Any:
    """Stamps with a blank before the time, a point before parts of a second, and an offset without colon."""
    text = text.str.replace(r"(\d)T(\d)", "${1} ${2}").str.replace(r", (\d)", " ${1}")
    text = text.str.replace(r":(\d{2}),(\d+)", ":${1}.${2}")
    text = text.str.replace(r"\s+", " ")
    if zoned:
        text = text.str.replace(r"\s*(Z|UTC|GMT)$", "+0000").str.replace(r"\s*([+-]\d{2}):?(\d{2})$", "${1}${2}")
    return text


def _epoch(stamps: Any) -> Array:
    micro = stamps.dt.epoch("us")
    return np.asarray(micro.cast(polars().Float64).to_numpy(), dtype=np.float64) * 1e-6


def in_zone(seconds: Array, zone: str) -> Array:
    """Seconds since 1970 of local ones, NaN where the clock was put forward; a repeated hour is told by the order.

    Raises:
        InvalidArgumentError: For a zone that is none.
    """
    pl = polars()
    if not re.fullmatch(r"[A-Za-z]+(/[A-Za-z_+\-0-9]+)*", zone):
        raise InvalidArgumentError("timezone", expected="a name as 'Europe/Berlin'", actual=repr(zone)[:80])
    known = np.where(np.isfinite(seconds), seconds, -np.inf)
    latest = known <= np.append(-np.inf, np.maximum.accumulate(known)[:-1])
    micro = pl.Series(np.round(seconds * 1e6)).cast(pl.Int64, strict=False)
    frame = pl.DataFrame({"t": micro.cast(pl.Datetime("us")), "a": np.where(latest, "latest", "earliest")})
    try:
        local = frame.select(pl.col("t").dt.replace_time_zone(zone, ambiguous=pl.col("a"), non_existent="null"))["t"]
    except pl.exceptions.PolarsError as error:
        expected = "a time zone, as 'Europe/Berlin'"
        raise InvalidArgumentError("timezone", expected=expected, actual=repr(zone)[:80]) from error
    return _epoch(local)


def without_set_back(seconds: Array) -> tuple[Array, int]:
    """Stamps whose clock was put back by an hour once or twice go on; how often. Rows that are merely mixed stay.

    Args:
        seconds: In the order of the file.
    """
    steps = np.diff(seconds)
    back = np.flatnonzero(steps < 0.0)
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    if not 0 < len(back) <= 2 or (np.abs(steps[back] + 3600.0 - usual) > 2.5 * usual).any():
        return seconds, 0
    moved = seconds.copy()
    for i in back:
        moved[i + 1 :] += 3600.0
    return moved, len(back)
