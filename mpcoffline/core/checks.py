"""What arguments and configurations refuse."""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Integral, Real
from typing import SupportsInt, cast

from .errors import InvalidArgumentError, UnknownIdError


def check_integers(low: int, **values: object) -> None:
    """Refuses anything but integers >= low, by name.

    Raises:
        InvalidArgumentError: For the first other value.
    """
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < low:
            expected = "a positive integer" if low == 1 else f"an integer >= {low}"
            raise InvalidArgumentError(name, expected=expected, actual=repr(value))


def check_known(kind: str, given: object, known: Iterable[str], hint: str = "") -> None:
    """Refuses anything but one of the known names, whatever its type.

    Args:
        kind: What the name stands for.
        given: The name.
        known: All names that would be right.
        hint: What to do next; by default the nearest names are proposed.

    Raises:
        UnknownIdError: For another one.
    """
    names = tuple(known)
    if not isinstance(given, str) or given not in names:
        raise UnknownIdError.of(kind, given, names, hint)


def checked_seed(name: str, value: object) -> int:
    """A seed as Python's int, as which not everything takes numpy's integers.

    Raises:
        InvalidArgumentError: For anything but an integer >= 0.
    """
    check_integers(0, **{name: value})
    return int(cast("SupportsInt", value))


def check_number(name: str, value: object, low: float, high: float = math.inf, *, open_low: bool = True) -> None:
    """Refuses anything but a finite number in (low, high], or [low, high] with ``open_low=False``.

    Raises:
        InvalidArgumentError: For another value.
    """
    number = math.nan if isinstance(value, bool) or not isinstance(value, Real) else float(value)
    if not (math.isfinite(number) and (low < number if open_low else low <= number) and number <= high):
        limits = f"{'above' if open_low else 'from'} {low:g}" + (f" to {high:g}" if high < math.inf else "")
        raise InvalidArgumentError(name, expected=f"a finite number {limits}", actual=repr(value))
