"""What arguments and configurations refuse."""

from __future__ import annotations

import math
from numbers import Integral, Real

from mpcoffline.errors import InvalidArgumentError


def check_integers(low: int, **values: object) -> None:
    """Refuses anything but integers >= low, by name.

    Raises:
        InvalidArgumentError: For the first other value.
    """
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < low:
            expected = "a positive integer" if low == 1 else f"an integer >= {low}"
            raise InvalidArgumentError(name, expected=expected, actual=repr(value))


def check_number(name: str, value: object, low: float, high: float = math.inf, *, open_low: bool = True) -> None:
    """Refuses anything but a finite number in (low, high], or [low, high] with ``open_low=False``.

    Raises:
        InvalidArgumentError: For another value.
    """
    number = math.nan if isinstance(value, bool) or not isinstance(value, Real) else float(value)
    if not (math.isfinite(number) and (low < number if open_low else low <= number) and number <= high):
        limits = f"{'above' if open_low else 'from'} {low:g}" + (f" to {high:g}" if high < math.inf else "")
        raise InvalidArgumentError(name, expected=f"a finite number {limits}", actual=repr(value))
