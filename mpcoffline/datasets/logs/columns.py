"""From the cells of a log to numbers: which column is which quantity, in which unit, and what is no number."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.core.types import Array

from .sources import Source, polars
from .units import conversion, readings

_MISSING = (
    "", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "?", "nil", "inf", "-inf", "+inf", "1.#qnan", "#value!",
    "#div/0!", "bad", "bad input", "no data", "missing", "error", "i/o timeout", "pt created", "calc failed",
    "shutdown",
)  # fmt: skip
_SWITCHES = {"true": 1.0, "false": 0.0, "on": 1.0, "off": 0.0, "yes": 1.0, "no": 0.0, "ein": 1.0, "aus": 0.0}
_SHOWN = 40  # characters of a header in a message
_ALIKE = 0.5  # of two names, from which one may be meant by the other
_MOST_TEXT = 0.2  # share of a column's cells that may be text


class Quantity(NamedTuple):
    """A number that a log should hold.

    Attributes:
        name: What it is called.
        unit: The unit that it is wanted in; empty where any will do.
        low: The least that it may be.
        high: The largest.
        header: What logs usually call its column, where that is not its name; a column of its name is it, too.
    """

    name: str
    unit: str = ""
    low: float = -np.inf
    high: float = np.inf
    header: str = ""


class Found(NamedTuple):
    """Where a quantity stands.

    Attributes:
        place: The column.
        header: What it is called there.
        factor: What takes its numbers into the wanted unit.
        offset: What is added then.
        said: What was converted, in words; empty where nothing was.
    """

    place: int
    header: str
    factor: float
    offset: float
    said: str


class MissingColumnError(InvalidDataError):
    """A log has no column of a name."""


def _plain(text: str) -> str:
    return re.sub(r"[\W_]+", "", text.casefold())


def _begins(header: str, given: str) -> bool:
    """Whether the first words of a header, such as its tag, are these."""
    whole, begin = header.strip().casefold(), given.strip().casefold()
    return bool(begin) and whole.startswith(begin) and not whole[len(begin) : len(begin) + 1].isalnum()


def _nearest(wanted: str, headers: Sequence[str]) -> str:
    """The header that may be meant by a text, as a whole, without its unit or by its tag; empty where none is near."""

    def alike(header: str) -> float:
        forms = {header, readings(header)[0].name, *header.split()[:1]}
        return max(difflib.SequenceMatcher(None, wanted, form).ratio() for form in forms)

    best = max(headers, key=alike, default="")
    return best if best and alike(best) >= _ALIKE else ""


def place_of(source: Source, name: str, given: str | None) -> tuple[int, str | None]:
    """The column of a name, and the unit that its header says.

    Args:
        source: The log.
        name: What is looked for.
        given: The header that the user says it has, or how it begins (its tag); None to look for the name.

    Raises:
        InvalidDataError: If there is none, or more than one.
    """
    wanted = name if given is None else given
    ranks: dict[int, tuple[int, str | None]] = {}
    for i, header in enumerate(source.header):
        for reading in readings(header):
            exact = 0 if header.strip() == wanted else 1 if reading.name == wanted else 2
            if exact == 2 and _plain(reading.name) != _plain(wanted):
                if given is None or not _begins(header, given):
                    continue
                exact = 3
            if i not in ranks or exact < ranks[i][0]:
                ranks[i] = exact, readings(header)[0].unit if reading.unit is None else reading.unit
    best = min((rank for rank, _ in ranks.values()), default=0)
    chosen = [i for i, (rank, _) in ranks.items() if rank == best]
    if len(chosen) == 1:
        unit = ranks[chosen[0]][1]
        return chosen[0], unit or (source.units[chosen[0]] if source.units and chosen[0] < len(source.units) else None)
    where = f"{source.name}: column of {name!r}" if given is None else f"{source.name}: column {given!r}"
    listed = ", ".join(f"{each[:_SHOWN]!r}" for each in source.header[:30])
    if len(source.header) > 30:
        listed += f" and {len(source.header) - 30} more"
    if chosen:
        actual = ", ".join(repr(source.header[i]) for i in chosen)
        hint = f"columns={{{name!r}: ...}} says which (--column {name}=...)."
        raise InvalidDataError(where, expected="one column of that name", actual=f"{len(chosen)}: {actual}", hint=hint)
    near = _nearest(wanted, source.header)
    hint = f"Is it {near[:_SHOWN]!r}? " if near else ""
    raise MissingColumnError(
        where,
        expected=f"one among {listed}",
        actual="none",
        hint=f"{hint}columns={{{name!r}: ...}} says which (--column {name}=...).",
    )


def found(
    source: Source, quantities: Sequence[Quantity], columns: Mapping[str, str], units: Mapping[str, str]
) -> dict[str, Found]:
    """Where each quantity stands, and how it is converted.

    Raises:
        InvalidArgumentError: For names in ``columns`` or ``units`` that are no quantity's.
        InvalidDataError: For a column that is missing, there twice, or of another kind of unit.
    """
    known = [each.name for each in quantities]
    for argument, given in (("columns", columns), ("units", units)):
        if other := [name for name in given if name not in known]:
            raise InvalidArgumentError(argument, expected=f"names among {', '.join(known)}", actual=repr(other[0]))
    result: dict[str, Found] = {}
    places = _places(source, quantities, columns)
    for each in quantities:
        place, unit = places[each.name]
        unit, header = units.get(each.name, unit), source.header[place]
        twice = [name for name, other in result.items() if other.place == place]
        if twice:
            where = f"{source.name}: column {header!r}"
            raise InvalidDataError(where, expected="one quantity", actual=f"{twice[0]!r} and {each.name!r}")
        factor, offset = conversion(f"{source.name}: column {header!r}", unit, each.unit)
        changed = (factor, offset) != (1.0, 0.0)
        said = f"{each.name}: {unit} to {each.unit}" if changed else ""
        result[each.name] = Found(place, header, factor, offset, said)
    return result


def _placed(source: Source, each: Quantity, given: str | None) -> tuple[int, str | None]:
    """The column of a quantity: as the user says, as its description says, or by its name."""
    if given is not None or not each.header:
        return place_of(source, each.name, given)
    try:
        return place_of(source, each.name, each.header)
    except MissingColumnError as error:
        try:
            return place_of(source, each.name, None)
        except MissingColumnError:
            raise error from None


def _places(
    source: Source, quantities: Sequence[Quantity], columns: Mapping[str, str]
) -> dict[str, tuple[int, str | None]]:
    """The column of each name and its unit; all names that have none are told at once.

    Raises:
        InvalidDataError: If some have none, or more than one.
    """
    result, missing, said_so = {}, {}, {each.name: each.header or each.name for each in quantities} | dict(columns)
    for each in quantities:
        try:
            result[each.name] = _placed(source, each, columns.get(each.name))
        except MissingColumnError as error:
            missing[each.name] = error
    if not missing:
        return result
    first = next(iter(missing.values()))
    if len(missing) == 1:
        raise first
    guesses = [f"{name}: {error.hint.partition('?')[0]}?" for name, error in missing.items() if "?" in error.hint]
    said = f"{' '.join(guesses)} " if guesses else ""
    raise MissingColumnError(
        f"{source.name}: columns of {', '.join(repr(said_so[name]) for name in missing)}",
        expected=first.expected,
        actual="none of them",
        hint=f"{said}columns={{{next(iter(missing))!r}: ..., ...}} says which (--column {next(iter(missing))}=...).",
    )


@dataclass
class Column:
    """The numbers of one quantity, collected batch by batch.

    Attributes:
        found: Where it stands.
        parts: Its numbers, NaN where there is none.
        texts: How many cells held text that is no number.
        first: Row and text of the first of them.
        rows: Rows so far.
    """

    found: Found
    parts: list[Array] = field(default_factory=list)
    texts: int = 0
    first: tuple[int, str] = (0, "")
    rows: int = 0

    def add(self, series: Any, decimal_comma: bool) -> None:
        """Takes a batch."""
        numbers, bad = cells(series, decimal_comma)
        if bad is not None:
            if not self.texts:
                row = int(np.flatnonzero(bad)[0])
                self.first = self.rows + row, str(series[row])
            self.texts += int(bad.sum())
        self.rows += len(numbers)
        self.parts.append(self.found.factor * numbers + self.found.offset)

    def check(self, source: Source) -> None:
        """Refuses a column that is mostly text.

        Raises:
            InvalidDataError: It names the first such row.
        """
        if self.texts > _MOST_TEXT * self.rows:
            row, text = self.first
            actual = f"{text!r:.80} ({self.texts} of {self.rows} rows)"
            where = f"{source.place(row)}: column {self.found.header!r}"
            raise InvalidDataError(where, expected="a number", actual=actual)


def cells(series: Any, decimal_comma: bool) -> tuple[Array, NDArray[np.bool_] | None]:
    """Numbers ``(n,)``, NaN where a cell holds none, and where it holds text that means nothing; None for nowhere."""
    pl = polars()
    if series.dtype != pl.String:
        if series.dtype in (pl.Date, pl.Datetime, pl.Duration, pl.Time) or series.dtype.is_nested():
            return np.full(len(series), np.nan), np.ones(len(series), dtype=bool)
        return _finite(series.cast(pl.Float64, strict=False)), None
    text = series.str.strip_chars()
    number = text.str.replace_all(r"(\d)[ '\u00a0\u202f](\d{3})", "${1}${2}")
    if decimal_comma:
        number = number.str.replace_all(r"(\d)\.(\d{3})(\D|$)", "${1}${2}${3}").str.replace(",", ".", literal=True)
    else:
        number = number.str.replace_all(r"(\d),(\d{3})", "${1}${2}")
    parsed = number.cast(pl.Float64, strict=False)
    unknown = parsed.is_null() & text.is_not_null()
    if not unknown.any():
        return _finite(parsed), None
    lower = text.filter(unknown).str.to_lowercase()
    numbers = _finite(parsed)
    where = np.flatnonzero(unknown.to_numpy())
    switches = np.array([_SWITCHES.get(str(each), np.nan) for each in lower.to_list()])
    numbers[where] = switches
    bad = np.zeros(len(numbers), dtype=bool)
    bad[where] = np.isnan(switches) & ~lower.is_in(list(_MISSING)).to_numpy()
    return numbers, bad if bad.any() else None


def _finite(series: Any) -> Array:
    numbers = np.array(series.to_numpy(), dtype=np.float64)
    numbers[~np.isfinite(numbers)] = np.nan
    return numbers


def allowed(series: Any, values: Sequence[object]) -> NDArray[np.bool_]:
    """Whether a cell is one of some values, text without its case."""
    pl = polars()
    texts = {str(value).strip().casefold() for value in values}
    own = series.cast(pl.String).str.strip_chars().str.to_lowercase()
    kept = own.is_in(list(texts)).fill_null(value=False).to_numpy()
    numbers = [float(value) for value in values if isinstance(value, int | float)]
    if numbers:
        kept |= series.cast(pl.Float64, strict=False).is_in(numbers).fill_null(value=False).to_numpy()
    return np.asarray(kept)
