"""Signals: what comes from outside and is known when an MPC is solved, as set-points, prices, measured disturbances."""

from __future__ import annotations

import inspect
import keyword
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np

from mpcoffline.core import limits
from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.limits import check_limit
from mpcoffline.core.text import check_name, check_unit


@dataclass(frozen=True)
class Signal:
    """A number from outside, in the observation: its value now and, with a preview, those of the steps to come.

    The columns stand after the plant's states. Along the horizon the MPC takes what was previewed, step by step, and
    holds the last value that it knows; without a preview it holds the present one.

    With ``period`` it is a clock, of two columns: cosine and sine of the phase, which moves on by one turn in so many
    sampling steps. A signal that ``follows`` a clock goes on after the last value that is known by a profile m over the
    phase, from which it deviates less and less; a learner finds both in the log::

        d[k+1] = m(k+1) + persistence (d[k] - m(k)),      m = c_0 + sum_j c_j cos(j phase) + s_j sin(j phase)

    Example:
        >>> Model(ode, nx=1, nu=1, dt=3600.0, signals=[Signal("price", "EUR/kWh", preview=24), Signal("outside", "K")])
        >>> Model(ode, nx=1, nu=1, dt=3600.0, signals=[Signal("day", period=24), Signal("price", follows="day")])

    Args:
        name: As dynamics and costs call it, ``d.price``: a Python identifier.
        unit: Its unit.
        preview: How many values of the steps to come the observation holds after the present one.
        usual: A value that it may have, for where none is known yet, as in the choice of integration steps.
        period: Sampling steps of a turn, of a clock; more than two. ``d.day`` is its cosine.
        follows: The name of the clock whose profile it follows.
        profile: c_0, c_1, s_1, c_2, s_2 ... of m, once learned or where they are known.
        persistence: Of a deviation from m, 0 to 1, likewise.
        low: The least value that it takes, where that is known: for simulations and checks, not for the MPC.
        high: The largest, likewise.

    Raises:
        InvalidArgumentError: For a name that is no identifier, a preview that is negative or longer than a horizon may
            be, numbers that are not finite or out of range, or a clock that is previewed or follows another one.
    """

    name: str
    unit: str = ""
    preview: int = 0
    usual: float = 0.0
    period: float | None = None
    follows: str | None = None
    profile: tuple[float, ...] = ()
    persistence: float = 1.0
    low: float = -np.inf
    high: float = np.inf

    def __post_init__(self) -> None:
        check_name("name of a signal", self.name)
        if not self.name.isidentifier() or keyword.iskeyword(self.name) or self.name.startswith("_"):
            raise InvalidArgumentError("name of a signal", expected="a Python identifier", actual=repr(self.name))
        check_unit("unit of a signal", self.unit)
        check_integers(0, preview=self.preview)
        check_limit("preview", "steps", int(self.preview), limits.HORIZON, error=InvalidArgumentError)
        check_number("usual", self.usual, -np.inf, open_low=False)
        if not self.low < self.high:
            actual = f"{self.low:g} to {self.high:g}"
            raise InvalidArgumentError(f"range of signal {self.name}", expected="low < high", actual=actual)
        check_number("persistence", self.persistence, 0.0, 1.0, open_low=False)
        if self.period is not None:
            check_number("period", self.period, 2.0)
            if self.preview or self.follows is not None:
                raise InvalidArgumentError(f"clock {self.name}", expected="no preview, no follows", actual=repr(self))
        coefficients = np.asarray(self.profile, dtype=np.float64)
        if self.profile and (self.follows is None or len(coefficients) % 2 == 0 or not np.isfinite(coefficients).all()):
            raise InvalidArgumentError(
                f"profile of {self.name}", expected="c_0, c_1, s_1, ... over a clock", actual=repr(self.profile)[:200]
            )
        object.__setattr__(self, "profile", tuple(coefficients.tolist()))

    @property
    def size(self) -> int:
        """Number of its columns in an observation."""
        return 1 + self.preview if self.period is None else 2

    @property
    def columns(self) -> tuple[str, ...]:
        """What its columns are called, ``(size,)``."""
        if self.period is not None:
            return f"cos {self.name}", f"sin {self.name}"
        return (self.name, *(f"{self.name} in {k} steps" for k in range(1, 1 + self.preview)))

    @property
    def usual_values(self) -> list[float]:
        """A value of each column, ``(size,)``."""
        return [self.usual] * self.size if self.period is None else [1.0, 0.0]

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description."""
        numbers: dict[str, Any] = {"usual": float(self.usual), "persistence": float(self.persistence)}
        numbers["profile"] = list(self.profile)
        period = None if self.period is None else float(self.period)
        numbers |= {key: float(v) for key, v in (("low", self.low), ("high", self.high)) if np.isfinite(v)}
        known = {"name": self.name, "unit": self.unit, "preview": int(self.preview), "follows": self.follows}
        return known | numbers | {"period": period}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`."""
        return cls(**dict(data) | {"profile": tuple(map(float, data["profile"]))})


def turned(c: Any, s: Any, angle: float) -> tuple[Any, Any]:
    """Cosine and sine of a phase, moved on by an angle."""
    return np.cos(angle) * c - np.sin(angle) * s, np.sin(angle) * c + np.cos(angle) * s


def harmonics(c: Any, s: Any, count: int) -> list[Any]:
    """Cosine and sine of 1 to ``count`` times a phase, one after the other."""
    parts, now = [], (c, s)
    for _ in range(count):
        parts += [*now]
        now = now[0] * c - now[1] * s, now[1] * c + now[0] * s
    return parts


def after_the_last(signal: Signal, last: Any, phase: tuple[Any, Any], step: float) -> Any:
    """The value after the last one that is known of a signal with a profile.

    Args:
        signal: The signal.
        last: Its last value that is known.
        phase: Cosine and sine of the clock at that time.
        step: By what the phase moves on in a step.
    """

    def mean(c: Any, s: Any) -> Any:
        parts = [1.0, *harmonics(c, s, len(signal.profile) // 2)]
        return sum(weight * part for weight, part in zip(signal.profile, parts, strict=True))

    return mean(*turned(*phase, step)) + signal.persistence * (last - mean(*phase))


class Named:
    """Values of signals by name, as dynamics and costs get them: ``d.price`` or ``d["price"]``.

    Args:
        names: The names.
        values: CasADi column of as many.
    """

    def __init__(self, names: Sequence[str], values: ca.SX) -> None:
        self._values = dict(zip(names, ca.vertsplit(values) if len(names) else [], strict=True))

    def __getitem__(self, name: str) -> ca.SX:
        try:
            return self._values[name]
        except KeyError:
            raise InvalidArgumentError(
                f"signal {name!r}",
                expected=f"one of {', '.join(self._values) or '(none)'}",
                actual=f"d.{name}",
                hint="Give the model its signals: Model(..., signals=[Signal(...)]).",
            ) from None

    def __getattr__(self, name: str) -> ca.SX:
        if name.startswith("_"):
            raise AttributeError(name)
        return self[name]


def takes_signals(function: Callable[..., Any], count: int = 4) -> bool:
    """Whether a function of the user takes signals as its last of so many arguments, ``(x, u, p, d)``."""
    return takes(function, count)


def takes(function: Callable[..., Any], count: int) -> bool:
    """Whether a function of the user takes so many arguments, or more."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of what is built in
        return False
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(parameter.kind in kinds and parameter.default is parameter.empty for parameter in parameters) >= count
