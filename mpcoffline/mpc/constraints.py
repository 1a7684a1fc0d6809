"""Constraints of (MPC) besides input bounds: named, hard or soft, along the horizon or at its end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self, cast

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.registry import Registry
from mpcoffline.core.text import check_name
from mpcoffline.core.types import Array

from .expressions import function_from_json, function_to_json, instructions, traced
from .layout import Layout
from .parameters import ParameterSpace
from .signals import takes_signals

ConstraintFunction = Callable[..., ca.SX]  # (x, u, p) -> h; (x, p) -> h at the end of the horizon; with signals d last


class Penalty(NamedTuple):
    """What it costs to violate a soft constraint by s = max(h, 0): ``l1 sum(s) + l2 sum(s^2)``, discounted like L.

    An ``l1`` above the largest multiplier of the hard constraint is exact: where the hard problem is feasible, the soft
    one has the same solution. ``l2`` alone is smooth, and always violates a little.

    Attributes:
        l1: Weight of the violation.
        l2: Weight of its square.
    """

    l1: float = 0.0
    l2: float = 0.0


class Sizes(NamedTuple):
    """What a constraint must fit: numbers of states and inputs, and the parameters of the model.

    Attributes:
        nx: Size of the observation: the plant's states and signals.
        nu: Number of inputs.
        parameters: Those of the model.
        n_states: Number of the plant's states.
        layout: Where the signals stand in the observation; None where there are none.
    """

    nx: int
    nu: int
    parameters: ParameterSpace
    n_states: int
    layout: Layout | None = None


class AnyConstraint(ABC):
    """What an MPC takes as a constraint: something that gives the two forms that solvers know.

    An own one subclasses this, or one of the two forms.
    """

    @abstractmethod
    def fitted(self, sizes: Sizes) -> Constraint | StateBounds:
        """This constraint for an MPC of these sizes, in one of the forms that solvers know.

        Raises:
            InvalidArgumentError: If it does not fit them.
        """


#: Constraints whose kind files name. One that is not here is saved by its expression, as the form that solvers know.
CONSTRAINTS: Registry[type[Any]] = Registry("constraint", AnyConstraint, ("to_json", "from_json"))


@CONSTRAINTS.register("Constraint")
@dataclass(frozen=True, eq=False)
class Constraint(AnyConstraint):
    """h_theta(x, u) <= 0 of (MPC) at the stages 0 ... N - 1, or h_theta(x_N) <= 0.

    At stage 0 the elements of a hard one that do not depend on u are not imposed: no plan can change what is given.

    Args:
        function: ``(x, u, p) -> h``, with ``terminal=True`` ``(x, p) -> h``: a CasADi column whose elements must not
            be positive; ``p`` holds the model's parameters. One more argument, ``(x, u, p, d)`` or ``(x, p, d)``, gets
            the signals of that stage by name, as ``d.limit``.
        name: What a violated constraint is called in a solution's status.
        soft: None for a hard constraint, else the price of violating it.
        terminal: Whether it holds at the end of the horizon.
        uses_previous: Whether the function is given the inputs of the step before, too, ``(x, u, before, p)``: a limit
            on how fast inputs may change. The MPC then carries them in its state.

    Raises:
        InvalidArgumentError: For a name that is empty or not of the alphabet of names, or a penalty that is negative or
            zero altogether.
    """

    function: ConstraintFunction | ca.Function
    name: str = "constraints"
    soft: Penalty | None = None
    terminal: bool = False
    uses_previous: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        check_name("name of a constraint", self.name)
        object.__setattr__(self, "soft", _checked_penalty(self.name, self.soft))

    def fitted(self, sizes: Sizes) -> Constraint:
        """The constraint with its function traced by CasADi.

        Raises:
            InvalidArgumentError: For a function that is not one of CasADi SX expressions, is not a column, or does not
                depend on the plant's states or inputs.
        """
        symbols = [ca.SX.sym("x", sizes.nx), ca.SX.sym("u", sizes.nu), ca.SX.sym("p", sizes.parameters.size)]
        if self.uses_previous:
            symbols.insert(2, ca.SX.sym("before", sizes.nu))
        arguments = symbols[:: len(symbols) - 1] if self.terminal else symbols
        expected = [symbol.numel() for symbol in arguments]
        if isinstance(self.function, ca.Function):
            found = [self.function.numel_in(i) for i in range(self.function.n_in())]
            if found != expected or self.function.n_out() != 1 or self.function.size2_out(0) != 1:
                raise InvalidArgumentError(
                    self.name, expected=f"a function of inputs of sizes {expected} to a column", actual=str(found)
                )
            return self
        outside = []
        if sizes.layout is not None and sizes.layout.signals and takes_signals(self.function, len(arguments) + 1):
            outside = [sizes.layout.named(symbols[0][sizes.layout.present.tolist()])]
        try:
            h = ca.densify(ca.SX(self.function(*arguments[:-1], sizes.parameters.symbols(arguments[-1]), *outside)))
        except (TypeError, KeyError, NotImplementedError, RuntimeError) as error:
            raise InvalidArgumentError(
                self.name, expected="a function of CasADi SX expressions", actual=f"{type(error).__name__}: {error}"
            ) from error
        if h.shape[1] != 1 or h.shape[0] == 0:
            raise InvalidArgumentError(self.name, expected="a column", actual=f"shape {h.shape}")
        _check_changeable(self.name, h, ca.vertcat(symbols[0][: sizes.n_states], *arguments[1:-1]))
        function = traced(self.name, ca.Function("h", arguments, [h]))
        if any(np.isinf(instruction.constant) for instruction in instructions(function)):
            hint = "Leave out the elements that bound nothing."
            raise InvalidArgumentError(self.name, expected="finite numbers", actual="an infinite one", hint=hint)
        return replace(self, function=function)

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description of a fitted constraint."""
        return {
            "kind": "Constraint",
            "name": self.name,
            "soft": None if self.soft is None else list(self.soft),
            "terminal": self.terminal,
            "uses_previous": self.uses_previous,
            "function": function_to_json(cast(ca.Function, self.function)),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any], sizes: Sizes) -> Self:
        """The inverse of ``to_json``.

        Raises:
            FileFormatError: If the data are damaged.
        """
        if not isinstance(data["terminal"], bool):
            raise FileFormatError("constraint", expected="terminal true or false", actual=repr(data["terminal"])[:80])
        size = sizes.parameters.size
        if not isinstance(previous := data["uses_previous"], bool):
            raise FileFormatError("constraint: uses_previous", expected="true or false", actual=repr(previous)[:200])
        along = (sizes.nx, *((sizes.nu,) * (1 + previous)), size)
        inputs = (sizes.nx, size) if data["terminal"] else along
        # Not by its own name: CasADi takes no blanks in it.
        function = function_from_json(data["function"], "constraint", inputs=inputs)
        return cls(function, data["name"], _penalty_from_json(data["soft"]), data["terminal"], uses_previous=previous)


@CONSTRAINTS.register("StateBounds")
@dataclass(frozen=True, eq=False)
class StateBounds(AnyConstraint):
    """Bounds low <= x_k <= high for k = 1 ... N; the initial state is given, so it is not asked.

    Args:
        low: Lower bounds of the observation, or of the plant's states alone, ``(nx,)``; ``-inf`` where there are none.
        high: Upper bounds, ``(nx,)``.
        name: What it is called in a solution's status.
        soft: None for hard bounds, else the price of violating them.
        at_end: Without it soft bounds hold at k = 0 ... N - 1, as other limits of a stage: where the terminal cost is a
            value that knows their price at x_N. What x_0 costs is then a part of the MPC's value.

    Raises:
        InvalidArgumentError: For bounds that cross, are NaN or of different shapes, or that no number can keep; for
            hard ones without ``at_end``.
    """

    low: ArrayLike
    high: ArrayLike
    name: str = "state bounds"
    soft: Penalty | None = None
    at_end: bool = True

    def __post_init__(self) -> None:
        check_name("name of a constraint", self.name)
        object.__setattr__(self, "soft", _checked_penalty(self.name, self.soft))
        if not self.at_end and self.soft is None:
            raise InvalidArgumentError(f"{self.name}.at_end", expected="True for hard bounds", actual="False")
        try:
            low, high = (np.atleast_1d(np.array(bound, dtype=np.float64)) for bound in (self.low, self.high))
        except (TypeError, ValueError) as error:
            raise InvalidArgumentError(
                self.name, expected="numbers", actual=f"{self.low!r} and {self.high!r}"
            ) from error
        if low.shape != high.shape or low.ndim != 1 or not (low <= high).all():
            raise InvalidArgumentError(self.name, expected="low <= high of one shape", actual=f"{low} and {high}")
        if (low == np.inf).any() or (high == -np.inf).any():
            raise InvalidArgumentError(self.name, expected="low < inf and high > -inf", actual=f"{low} and {high}")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def fitted(self, sizes: Sizes) -> StateBounds:
        """The bounds, if they are as many as the plant's states, or with signals.

        Raises:
            InvalidArgumentError: If they are not.
        """
        if np.size(self.low) not in (sizes.n_states, sizes.nx):
            more = f", or {sizes.nx} with signals" if sizes.nx > sizes.n_states else ""
            raise InvalidArgumentError(
                self.name, expected=f"{sizes.n_states} numbers, one a state{more}", actual=f"shape {np.shape(self.low)}"
            )
        return self

    def padded(self, n: int) -> StateBounds:
        """The bounds with n further coordinates that have none."""
        free, (low, high) = np.full(n, np.inf), map(np.asarray, (self.low, self.high))
        return replace(self, low=np.append(low, -free), high=np.append(high, free)) if n else self

    def expression(self, x: ca.SX) -> ca.SX:
        """The bounds that exist as a column h <= 0."""
        low, high = np.asarray(self.low), np.asarray(self.high)
        above = [x[i] - float(high[i]) for i in np.flatnonzero(np.isfinite(high)).tolist()]
        return ca.vertcat(*above, *(float(low[i]) - x[i] for i in np.flatnonzero(np.isfinite(low)).tolist()))

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description; infinite bounds become null."""
        return {
            "kind": "StateBounds",
            "name": self.name,
            "soft": None if self.soft is None else list(self.soft),
            "low": finite_or_none(np.asarray(self.low)),
            "high": finite_or_none(np.asarray(self.high)),
            "at_end": self.at_end,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any], sizes: Sizes) -> Self:
        """The inverse of ``to_json``.

        Raises:
            FileFormatError: If the data are damaged.
        """
        if not isinstance(at_end := data["at_end"], bool):
            raise FileFormatError("constraint: at_end", expected="true or false", actual=repr(at_end)[:200])
        low = [-np.inf if v is None else float(v) for v in data["low"]]
        high = [np.inf if v is None else float(v) for v in data["high"]]
        return cls(low, high, data["name"], _penalty_from_json(data["soft"]), at_end)


Constraints = ConstraintFunction | AnyConstraint | Sequence[AnyConstraint]


def fitted_constraints(given: Constraints | None, sizes: Sizes) -> tuple[Constraint | StateBounds, ...] | None:
    """The constraints of an MPC as a tuple, checked against its sizes; None where there are none that bound anything.

    Raises:
        InvalidArgumentError: For something else than constraints, names that occur twice, sizes that do not fit, or
            hard state bounds that contradict each other.
    """
    if given is None:
        return None
    if isinstance(given, AnyConstraint):
        given = (given,)
    elif callable(given):
        given = (Constraint(given),)
    elif not isinstance(given, Sequence):
        raise InvalidArgumentError("constraints", expected="constraints", actual=repr(given))
    for constraint in given:
        if not isinstance(constraint, AnyConstraint):
            raise InvalidArgumentError(
                "constraints",
                expected="a function (x, u, p) -> h, or a list of Constraint and StateBounds",
                actual=f"a list with {constraint!r}",
            )
    fitted = tuple(constraint.fitted(sizes) for constraint in given)
    if others := [form for form in fitted if not isinstance(form, Constraint | StateBounds)]:
        raise InvalidArgumentError("fitted", expected="a Constraint or StateBounds", actual=repr(others[0])[:200])
    names = [constraint.name for constraint in fitted]
    if len(set(names)) < len(names):
        raise InvalidArgumentError("names of constraints", expected="unique names", actual=str(names))
    _refuse_contradicting([form for form in fitted if isinstance(form, StateBounds) and form.soft is None], sizes)
    return tuple(form for form in fitted if not _is_empty(form)) or None


def _check_changeable(name: str, h: ca.SX, z: ca.SX) -> None:
    """Refuses a limit that no plan can change, which consists of z, and one of whose change solvers see nothing."""
    if not ca.depends_on(h, z):
        raise InvalidArgumentError(
            name,
            expected="a limit of the plant's states or inputs, which a plan can change",
            actual="one of signals, parameters or numbers alone",
        )
    slopes = ca.jacobian(h, z)
    if any(slopes[j, :].is_zero() and ca.depends_on(h[j], z) for j in range(h.numel())):
        raise InvalidArgumentError(
            name, expected="h <= 0 that grows with what is limited, as x[0] - 1", actual="a step, as x[0] <= 1"
        )


def _is_empty(form: Constraint | StateBounds) -> bool:
    """Whether it bounds nothing."""
    return isinstance(form, StateBounds) and not np.isfinite(np.array([form.low, form.high])).any()


def _refuse_contradicting(bounds: Sequence[StateBounds], sizes: Sizes) -> None:
    """Refuses hard bounds of which no state can keep all."""
    full = [form.padded(sizes.nx - np.size(form.low)) for form in bounds]
    for first in full:
        for second in full:
            crossed = np.flatnonzero(np.asarray(first.low) > np.asarray(second.high))
            if len(crossed):
                i = int(crossed[0])
                low, high = np.asarray(first.low)[i], np.asarray(second.high)[i]
                raise InvalidArgumentError(
                    f"state bounds {first.name!r} and {second.name!r}",
                    expected="some value of each state that both allow",
                    actual=f"at least {low:g} and at most {high:g} of state {i}",
                )


def constraints_to_json(
    constraints: Sequence[Constraint | StateBounds], *, portable: bool = False
) -> list[dict[str, Any]]:
    """Fitted constraints as their classes write them, or, where files cannot name a class, in the form of solvers.

    Args:
        constraints: What :func:`fitted_constraints` returned.
        portable: Whether classes from outside this package are written in that form, too.
    """
    found = []
    for constraint in constraints:
        own: Any = constraint
        name = CONSTRAINTS.name_of(type(constraint), shared=portable)
        form = Constraint if isinstance(constraint, Constraint) else StateBounds
        found.append(dict(own.to_json()) | {"kind": name} if name else form.to_json(own))
    return found


def constraints_from_json(
    data: Sequence[Mapping[str, Any]] | None, sizes: Sizes
) -> tuple[Constraint | StateBounds, ...] | None:
    """The inverse of ``to_json`` of each.

    Raises:
        FileFormatError: If the data are damaged.
    """
    if data is None:
        return None
    if not isinstance(data, list) or not data:
        raise FileFormatError("constraints", expected="a list of constraints, or null", actual=repr(data)[:200])
    return tuple(CONSTRAINTS.of_file(entry["kind"], "constraint").from_json(entry, sizes) for entry in data)


def _penalty_from_json(data: Sequence[float] | None) -> Penalty | None:
    return None if data is None else Penalty(*map(float, data))


def _checked_penalty(name: str, penalty: Penalty | None) -> Penalty | None:
    if penalty is None:
        return None
    try:
        weights = Penalty(*map(float, penalty))
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(f"{name}.soft", expected="Penalty(l1, l2), or None", actual=repr(penalty)) from error
    if not all(np.isfinite(w) and w >= 0.0 for w in weights) or sum(weights) == 0.0:
        raise InvalidArgumentError(f"{name}.soft", expected="weights >= 0, one of them positive", actual=str(penalty))
    return weights


def finite_or_none(values: Array) -> list[float | None]:
    """Numbers as JSON has them, which knows no infinity."""
    return [float(v) if np.isfinite(v) else None for v in values]
