"""Units of columns: how headers say them, and what they are in the plant's."""

from __future__ import annotations

import re
from functools import cache
from typing import Any, NamedTuple

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError

EXTRA = 'pip install "mpcoffline[logs]"'

_BRACKETS = re.compile(r"^(?P<name>.*?\S)\s*[\[({<](?P<unit>[^\])}>]*)[\])}>]\s*$")
_IN = re.compile(r"^(?P<name>.*?\S)\s+in\s+(?P<unit>\S+)$", re.IGNORECASE)


class Column(NamedTuple):
    """What a header says: name and unit, None where it says none."""

    name: str
    unit: str | None


def readings(header: str) -> list[Column]:
    """How a header may be meant, the likeliest first: ``h1 [cm]``, ``h1 (cm)``, ``h1 in cm``, ``h1_cm``, ``h1/cm``."""
    text = header.strip()
    found = [Column(text, None)]
    for pattern in (_BRACKETS, _IN):
        if match := pattern.match(text):
            found.insert(0, Column(match["name"], match["unit"].strip()))
    for sign in "_/,.":
        name, _, unit = text.rpartition(sign)
        if name and unit and is_unit(unit.strip()):
            found.append(Column(name.strip(), unit.strip()))
    return found


@cache
def _registry() -> Any:
    try:
        import pint
    except ImportError as error:
        raise InvalidArgumentError("units", expected="the package pint", actual="not installed", hint=EXTRA) from error
    return pint.UnitRegistry(autoconvert_offset_to_baseunit=True)


@cache
def _unit(text: str) -> Any:
    """Pint's unit of a text; None where it knows none. ``cm2`` and ``cm^2`` are ``cm**2``."""
    plain = re.sub(r"(?<=[A-Za-zµ])(-?\d)", r"**\1", text.replace("^", "**").replace("·", "*").replace("Ω", "ohm"))
    try:
        return _registry().Unit(plain)
    except InvalidArgumentError:
        raise
    except Exception:  # whatever pint's parser raises
        return None


def is_unit(text: str) -> bool:
    """Whether a text is a unit."""
    return _unit(text) is not None


def conversion(where: str, given: str | None, wanted: str) -> tuple[float, float]:
    """Factor and offset that take numbers from one unit into another; (1, 0) where a side says none.

    Args:
        where: The column, for messages.
        given: The column's unit.
        wanted: The plant's.

    Raises:
        InvalidDataError: For units of different kinds, or one that is not known.
    """
    if not given or not wanted or given == wanted:
        return 1.0, 0.0
    units = []
    for text in (given, wanted):
        unit = _unit(text)
        if unit is None:
            hint = "Give it in another spelling: units={...}."
            raise InvalidDataError(f"{where}: unit", expected="one that is known", actual=repr(text), hint=hint)
        units.append(unit)
    quantity = _registry().Quantity
    try:
        zero, one = (float(quantity(number, units[0]).to(units[1]).magnitude) for number in (0.0, 1.0))
    except Exception as error:
        expected = f"a unit that can become {wanted}"
        hint = "Is it the right column? units={...} says what its numbers are in."
        raise InvalidDataError(f"{where}: unit", expected=expected, actual=given, hint=hint) from error
    return one - zero, zero
