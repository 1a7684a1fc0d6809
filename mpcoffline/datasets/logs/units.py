"""Units of columns: how headers say them, and what they are in the plant's."""

from __future__ import annotations

import re
from functools import cache
from typing import Any, NamedTuple

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError

EXTRA = 'pip install "mpcoffline[logs]"'

_BRACKETS = re.compile(r"^(?P<name>.*?\S)\s*[\[({<](?P<unit>[^\])}>]*)[\])}>]\s*$")
#: Currencies, each a kind of its own: none becomes another. The cent is a hundredth of whichever the other side has.
_CURRENCIES = (
    "EUR", "USD", "GBP", "CHF", "SEK", "NOK", "DKK", "PLN", "CZK", "HUF", "JPY", "CNY", "INR", "AUD", "CAD", "BRL",
    "ZAR",
)  # fmt: skip
_SIGNS = {"€": "EUR", "$": "USD", "£": "GBP", "¥": "JPY"}
_CENT = re.compile(r"(?<![A-Za-z])(?:ct|cents?|Cents?|¢)(?=\s*/|\s*$)")
#: As instruments and historians write what pint spells otherwise, as a whole and as words within.
_WHOLE = {
    "U/min": "rpm", "Upm": "rpm", "Grad C": "degC", "Grad F": "degF", "DegC": "degC", "DegF": "degF", "VDC": "V",
    "VAC": "V", "% r.H.": "%", "% rH": "%", "%rH": "%", "%RH": "%", "vol%": "%", "vol.%": "%", "Vol.-%": "%",
    "Vol%": "%", "wt%": "%", "wt.%": "%", "Gew.-%": "%", "Prozent": "%", "perc": "%",
}  # fmt: skip
_WORDS = {
    "RPM": "rpm",
    "gpm": "gallon/minute",
    "sccm": "cm**3/minute",
    "Std": "hour",
    "Sek": "second",
    "mmH2O": "millimeter_H2O",
}
_WORD = re.compile(r"((?<![A-Za-z])(RPM|gpm|sccm|mmH2O)|(?<=/)(Std|Sek))(?![A-Za-z])")  # T_Std is no time
_DEGREES = {"C": "degC", "F": "degF"}  # alone, they are units of charge and capacity
_PRESSURE = re.compile(r"^((?:[mk]|h)?(?:bar|Pa)|MPa|psi)\s*[_(]?([ga])\)?$")  # gauge or absolute
_ANGLE = re.compile(r"rad|deg|°|turn|rev|rp[ms]|U/|Upm", re.IGNORECASE)
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
    registry: Any = pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
    registry.define("millimeter_H2O = 0.1 * centimeter_H2O")
    for each in _CURRENCIES:
        registry.define(f"{each} = [{each}]")
        registry.define(f"cent_{each} = 0.01 {each}")
    return registry


@cache
def _unit(text: str) -> Any:
    """Pint's unit of a text; None where it knows none. ``cm2`` and ``cm^2`` are ``cm**2``."""
    text = _WORD.sub(lambda word: _WORDS[word[0]], _WHOLE.get(text, text))
    plain = re.sub(
        r"(?<=[A-Za-zµ])(-?\d)(?![A-Za-z\d])", r"**\1", text.replace("^", "**").replace("·", "*").replace("Ω", "ohm")
    )
    try:
        return _registry().Unit(plain)
    except InvalidArgumentError:
        raise
    except Exception:  # whatever pint's parser raises
        return None


def is_unit(text: str) -> bool:
    """Whether a text is a unit."""
    return _unit(text) is not None


def _meant(given: str, wanted: str) -> list[str]:
    """Two units, each as the other shows that it is meant: degrees, kinds of pressure, money."""
    texts = [given, wanted]
    for i, other in enumerate((wanted, given)):
        unit = _unit(other)
        if texts[i] in _DEGREES and unit is not None and unit.dimensionality == _registry().Unit("K").dimensionality:
            texts[i] = _DEGREES[texts[i]]
        if _WHOLE.get(texts[i], texts[i]).casefold() == "rpm" and not _ANGLE.search(other):
            texts[i] = "1/minute"  # pint's has 2 pi in it, which is right beside rad/s alone
    kinds = [_PRESSURE.match(text) for text in texts]
    return _money(*(kind[1] if kind else text for kind, text in zip(kinds, texts, strict=True)))


def _money(*texts: str) -> list[str]:
    """Units with their currencies by code; cents as hundredths of the currency that one of them names, else of EUR."""
    plain = [re.sub("[€$£¥]", lambda sign: _SIGNS[sign[0]], text) for text in texts]
    named = [each for each in _CURRENCIES if any(re.search(rf"(?<![A-Za-z_]){each}\b", text) for text in plain)]
    cent = f"cent_{named[0] if named else 'EUR'}"
    is_money = bool(named) or all(_CENT.search(text) for text in plain)  # "ct" alone may be carats
    return [_CENT.sub(cent, text) for text in plain] if is_money else plain


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
    kinds = {kind[2] for kind in map(_PRESSURE.match, (given, wanted)) if kind}
    if len(kinds) > 1:
        hint = "They differ by the pressure of the air: write the sum into the log or into the plant file's equations."
        raise InvalidDataError(f"{where}: unit", expected=f"{wanted}, as in the plant file", actual=given, hint=hint)
    units = []
    for text, worded in zip((given, wanted), _meant(given, wanted), strict=True):
        unit = _unit(worded)
        if unit is None:
            hint = (
                "Where both are the same unit, write it alike; else units={...} says the log's in another spelling, as"
                " 'm**3/h', 'degC', 'EUR/MWh' (--unit)."
            )
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
