"""What a plant's description is made of: states, inputs, limits, and their values by name."""

from __future__ import annotations

import keyword
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.core.text import check_name, check_unit
from mpcoffline.mpc import Parameter, Signal

_NOISE = 0.005  # of a state's range
_WIDE = 100.0  # times and parts of its value that a parameter may become where nothing is said


@dataclass(frozen=True)
class State:
    """A state of a plant, which is measured.

    Args:
        name: As dynamics and cost call it, ``x.h1``: a Python identifier.
        unit: Its unit.
        low: The least that the plant or its sensor gives; a simulated plant stays there. No limit of the controller's.
        high: The largest, likewise.
        start: Where simulated episodes begin: a number, or a range ``(low, high)`` that it is drawn from; by default
            the whole range, and 0 without one.
        noise: Standard deviation of the simulated measurement; by default 0.5 % of the range, and none without one.

    Raises:
        InvalidArgumentError: For a name that is no identifier, or numbers that do not fit together.
    """

    name: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    start: float | tuple[float, float] | None = None
    noise: float | None = None

    def __post_init__(self) -> None:
        check_quantity("state", self)
        if self.noise is not None:
            check_number(f"state {self.name}: noise", self.noise, 0.0, open_low=False)
        low, high = self.starts
        if not (math.isfinite(low) and math.isfinite(high) and self.low <= low <= high <= self.high):
            expected = f"a number, or two in order, from {self.low:g} to {self.high:g}"
            raise InvalidArgumentError(f"state {self.name}: start", expected=expected, actual=repr(self.start))

    @property
    def starts(self) -> tuple[float, float]:
        """The range that simulated episodes begin in."""
        if self.start is None:
            known = math.isfinite(self.low) and math.isfinite(self.high)
            rest = min(max(0.0, self.low), self.high)
            return (self.low, self.high) if known else (rest, rest)
        low, high = self.start if isinstance(self.start, Sequence) else (self.start, self.start)
        return float(low), float(high)

    @property
    def deviation(self) -> float:
        """The standard deviation of the simulated measurement."""
        if self.noise is not None:
            return self.noise
        span = self.high - self.low
        return _NOISE * span if math.isfinite(span) else 0.0


@dataclass(frozen=True)
class Input:
    """An input of a plant.

    Args:
        name: As dynamics and cost call it, ``u.valve``: a Python identifier.
        unit: Its unit.
        low: The least that may be asked for.
        high: The largest.
        rate: By how much it may change from one sampling step to the next; as much as it likes by default.
        delay: After how many sampling steps it acts; not known by default, and looked for in the log.
        usual: What it is before anything is known; by default 0, within the bounds.

    Raises:
        InvalidArgumentError: For a name that is no identifier, or numbers that do not fit together.
    """

    name: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    rate: float | None = None
    delay: int | None = None
    usual: float | None = None

    def __post_init__(self) -> None:
        check_quantity("input", self)
        if self.rate is not None:
            check_number(f"input {self.name}: rate", self.rate, 0.0)
        if self.delay is not None:
            check_integers(0, **{f"input {self.name}: delay": self.delay})
        if self.usual is not None:
            check_number(f"input {self.name}: usual", self.usual, self.low, self.high, open_low=False)

    @property
    def at_rest(self) -> float:
        """What it is before anything is known."""
        return min(max(0.0, self.low), self.high) if self.usual is None else self.usual


@dataclass(frozen=True)
class Limit:
    """What a controller has to keep: a quantity, or an expression, within bounds.

    Example:
        >>> Limit("overflow", "h1", high=35.0, soft=10.0)
        >>> Limit("power", lambda x, u: u.pump * x.h1, high=200.0)

    Args:
        name: What messages call it.
        of: The name of a state or input, or a function of ``x``, ``u``, ``d``, ``p`` (those that it names).
        low: The least that it may be.
        high: The largest.
        soft: What a unit of violation costs, in units of the cost (an exact penalty: where the limit can be kept at a
            lower price, it is); by default the limit is hard. A pair is the price of the violation and of its square.

    Raises:
        InvalidArgumentError: For a limit without bounds, bounds that cross or are no numbers, or more than two prices.
    """

    name: str
    of: str | Callable[..., Any]
    low: float = -math.inf
    high: float = math.inf
    soft: float | tuple[float, float] | None = None

    def __post_init__(self) -> None:
        check_name("name of a limit", self.name)
        what = f"limit {self.name!r}"
        of: object = self.of
        if not isinstance(of, str) and not callable(of):
            expected = "the name of a state or input, or a function of x, u, d, p"
            raise InvalidArgumentError(what, expected=expected, actual=repr(self.of)[:200])
        for bound in (self.low, self.high):
            if isinstance(bound, bool) or not isinstance(bound, int | float | np.number):
                raise InvalidArgumentError(f"{what}: bounds", expected="two numbers", actual=repr(bound)[:200])
        prices: object = self.soft
        if isinstance(prices, Sequence) and not isinstance(prices, str) and len(prices) != 2:
            raise InvalidArgumentError(f"{what}: soft", expected="a price, or a pair", actual=repr(prices)[:200])
        if math.isinf(self.low) and math.isinf(self.high):
            hint = "For an expression that must not become positive, write high=0."
            raise InvalidArgumentError(what, expected="low=, high= or both", actual="no bound", hint=hint)
        if not self.low <= self.high:
            raise InvalidArgumentError(what, expected="low <= high", actual=f"{self.low:g} and {self.high:g}")


class Described(Protocol):
    """A quantity with a name, a unit and a range."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def unit(self) -> str:
        """Its unit."""

    @property
    def low(self) -> float:
        """The least that it may be."""

    @property
    def high(self) -> float:
        """The largest."""


def check_quantity(kind: str, quantity: Described) -> None:
    """Refuses a name, unit or range that is none.

    Raises:
        InvalidArgumentError: For these.
    """
    check_identifier(f"name of {'a' if kind == 'state' else 'an'} {kind}", quantity.name)
    check_unit(f"{kind} {quantity.name}: unit", quantity.unit)
    for bound in (quantity.low, quantity.high):
        if isinstance(bound, bool) or not isinstance(bound, int | float | np.number) or math.isnan(bound):
            raise InvalidArgumentError(f"{kind} {quantity.name}: range", expected="two numbers", actual=repr(bound))
    if not quantity.low < quantity.high:
        actual = f"{quantity.low:g} to {quantity.high:g}"
        raise InvalidArgumentError(f"{kind} {quantity.name}: range", expected="low < high", actual=actual)


def check_identifier(what: str, name: object) -> None:
    """Refuses what dynamics cannot call ``x.name``.

    Raises:
        InvalidArgumentError: For anything but a Python identifier that does not begin with an underscore.
    """
    check_name(what, name)
    if not str(name).isidentifier() or keyword.iskeyword(str(name)) or str(name).startswith("_"):
        hint = "Dynamics and cost call it by this name, as x.level or u.valve."
        raise InvalidArgumentError(what, expected="a Python identifier", actual=repr(name), hint=hint)


def checked_parameter(name: str, given: Parameter | ArrayLike) -> Parameter:
    """A parameter with bounds, of its own sign where nothing else is said.

    Raises:
        InvalidArgumentError: For what is no number.
    """
    check_identifier("name of a parameter", name)
    try:
        found = given if isinstance(given, Parameter) else Parameter(given)
        value, bounds = np.asarray(found.value, dtype=np.float64), np.array([found.low, found.high], dtype=np.float64)
    except (InvalidArgumentError, TypeError, ValueError) as error:
        raise InvalidArgumentError(f"parameter {name}", expected="a number", actual=repr(given)[:200]) from error
    if value.shape or bounds.shape != (2,):
        raise InvalidArgumentError(f"parameter {name}", expected="one number", actual=f"shape {value.shape}")
    if np.isinf(bounds).all() and value != 0.0:
        low, high = sorted((float(value) / _WIDE, float(value) * _WIDE))
        return replace(found, low=low, high=high)
    return found


def with_usual(signal: Signal) -> Signal:
    """A signal whose usual value is one that it may have."""
    if signal.low <= signal.usual <= signal.high:
        return signal
    ends = [end for end in (signal.low, signal.high) if math.isfinite(end)]
    return replace(signal, usual=sum(ends) / len(ends))


class Values:
    """Values by name, as dynamics, cost and limits get them: ``x.h1``, ``x["h1"]``, or in order ``h1, h2 = x``.

    Args:
        kind: What one of them is, for messages: ``"state"``.
        letter: What functions call them: ``"x"``.
        names: Their names.
        values: As many numbers or CasADi expressions.
    """

    __slots__ = ("_kind", "_letter", "_values")

    def __init__(self, kind: str, letter: str, names: Sequence[str], values: Sequence[Any]) -> None:
        object.__setattr__(self, "_kind", kind)
        object.__setattr__(self, "_letter", letter)
        object.__setattr__(self, "_values", dict(zip(names, values, strict=True)))

    def __getitem__(self, key: str | int) -> Any:
        if isinstance(key, int):
            return list(self._values.values())[key]
        if key not in self._values:
            raise UnknownIdError.of(f"{self._letter}.{key}: {self._kind}", key, self._values)
        return self._values[key]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self[name]

    def __setattr__(self, name: str, value: object) -> None:
        raise InvalidArgumentError(f"{self._letter}.{name}", expected="to be read only", actual="an assignment")

    def __iter__(self) -> Iterator[Any]:
        return iter(self._values.values())

    def __len__(self) -> int:
        return len(self._values)
