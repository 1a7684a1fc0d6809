"""What a plant is: one description, from which environment, nominal MPC, references, labels and data sets come.

The functions in it are arithmetic on lists of entries and know neither numpy nor CasADi. An entry is a float in the
environment, an array ``(n, 1)`` in its vector twin, and a scalar expression in an MPC; so is what they return.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import Array

Entries = Sequence[Any]
Values = Mapping[str, Any]
#: Draws an initial state ``(nx,)``.
Draw = Callable[[np.random.Generator], Array]

# Hanging is in the middle, so that a swing-up starts there and no curve leaves on one side to come back on the other.
_TURN = (-0.9, 2.0 * np.pi + 0.9)


def square(x: Any) -> Any:
    """``x * x``: as ``x**2``, but with the same bits for a single number as for one among many."""
    return x * x


@dataclass(frozen=True)
class Parameter:
    """A number or matrix of the plant; an argument of the environment, and of MPC_1's model if it is learned.

    Attributes:
        name: As in the equations.
        value: The plant's.
        low: The least that the environment takes; of a number, not of a matrix.
        high: The largest, or a function of the other parameters that gives it.
        unit: Physical unit.
        spread: Half-width of its error in MPC_1 at alpha = 1; learning may move it from 1/100 to 100 times the plant's
            value. Zero: MPC_1 has ``value``, and learning may move it anywhere. None: known, and no parameter of MPC_1.
        meaning: What it is, for the documentation; with its range where ``high`` is a function.
    """

    name: str
    value: ArrayLike
    low: float = -math.inf
    high: float | Callable[[Values], float] = math.inf
    unit: str = ""
    spread: float | None = None
    meaning: str = ""


@dataclass(frozen=True)
class State:
    r"""One entry of the state s; its target is zero.

    Attributes:
        name: As in the equations.
        symbol: In LaTeX, ``"\\dot\\varphi"``.
        unit: Physical unit.
        limit: Its largest absolute value in the simulation; an angle has none.
        start: The largest that ``reset`` accepts; by default ``limit``, of an angle pi.
        quantity: What it is, in a word.
        angle: Whether it is an angle in rad that wraps, and so two entries of the observation, its cosine and sine.
        band: Half-width around zero that counts as success; None where it does not matter.
        span: What is drawn of it in a plane.
        index: Its place in s; set by the plant.
    """

    name: str
    symbol: str
    unit: str
    limit: float = math.inf
    start: float | None = None
    quantity: str = ""
    angle: bool = False
    band: float | None = None
    span: tuple[float, float] = (-1.0, 1.0)
    index: int = 0

    @property
    def largest_start(self) -> float:
        """The largest absolute value that ``reset`` accepts."""
        return (math.pi if self.angle else self.limit) if self.start is None else self.start

    @property
    def label(self) -> str:
        """Quantity, symbol and unit, for an axis."""
        return _label(self.quantity, self.symbol, self.unit)


@dataclass(frozen=True)
class Input:
    """One entry of the action.

    Attributes:
        name: As in the equations.
        symbol: In LaTeX.
        unit: Physical unit.
        low: Lower bound.
        high: Upper bound.
        quantity: What it is, in a word.
        index: Its place in the action; set by the plant.
    """

    name: str
    symbol: str
    unit: str
    low: float
    high: float
    quantity: str = ""
    index: int = 0

    @property
    def label(self) -> str:
        """Quantity, symbol and unit, for an axis."""
        return _label(self.quantity, self.symbol, self.unit)


@dataclass(frozen=True)
class Uniform:
    """A distribution of initial states: ``around + U(low, high)``; an angle beyond half a turn is wrapped.

    Attributes:
        low: Lower bounds, ``(nx,)``.
        high: Upper bounds.
        around: What the draw is added to.
    """

    low: Sequence[float]
    high: Sequence[float]
    around: Sequence[float] | float = 0.0

    def __call__(self, rng: np.random.Generator) -> Array:
        """Draws a state ``(nx,)``."""
        return np.asarray(self.around) + rng.uniform(self.low, self.high)


@dataclass(frozen=True)
class Nominal:
    """The cost of MPC_1 in observation and input: ``|y - y(0)|^2_W + |u - input_target|^2_R``, W and R diagonal.

    Attributes:
        weights: Diagonal of W, ``(ny,)``.
        input_weights: Diagonal of R, ``(nu,)``.
        horizon: Steps that MPC_1 looks ahead.
        input_target: Input at rest, ``(nu,)``; zero by default.
    """

    weights: Sequence[float]
    input_weights: Sequence[float]
    horizon: int
    input_target: Sequence[float] | None = None


@dataclass(frozen=True, kw_only=True)
class Plant:
    """A plant with everything that the package knows of it.

    The observation y is the state s with the cosine and sine of its angle, if it has one, in place of that angle.

    Attributes:
        id: Gymnasium id.
        name: Short name, on the command line and of files.
        dt: Sampling time in s.
        states: The state s; at most one angle.
        inputs: The action.
        parameters: The plant's parameters, those of MPC_1 in the order in which its errors are drawn.
        dynamics: ``(y, u, p) -> ds/dt`` from the entries of y and u and the parameters by name: the entries of ds/dt,
            or columns of some of them. With ``discrete`` it is the next s instead.
        cost: ``(s, u) -> L``, the stage cost.
        starts: Distributions of initial states, the default first.
        nominal: Cost and horizon of MPC_1.
        discrete: Whether ``dynamics`` is a discrete-time map of a plant without angle.
        success: Whether states ``(..., nx)`` are a success, ``(...)``; by default within the band of each.
        max_alpha: Where alpha is an argument of the environment and changes the plant, its largest value; None where it
            is the error of MPC_1's model.
        shown: Names of the states that figures draw over time.
        plane: Names of the two of phase portraits and level sets.
        coverage: Pairs of names, states or inputs, whose histograms say what a data set covers.
        seconds: What figures show of an episode whose end is dull; None for all.
        catalog: Package that holds the recipe ``NAME.toml`` of its data set and what it makes; None without one.
        reference: The controller of a comparison's unit: ``"true model"``, MPC_1 without model error, or ``"riccati"``,
            the closed-loop optimum of a plant with matrices A, B and the nominal cost.
        mismatch: A parameter that a study holds at a wrong value, which no model can then make up for.
        published: Whether it is a task of arXiv:2301.01667, which a reproduction of its study runs.

    Raises:
        ValueError: For names that are taken twice or unknown, more than one angle, or numbers that do not fit.
    """

    id: str
    name: str
    dt: float
    states: tuple[State, ...]
    inputs: tuple[Input, ...]
    dynamics: Callable[[Entries, Entries, Values], Entries]
    cost: Callable[[Entries, Entries], Any]
    starts: Mapping[str, Draw]
    nominal: Nominal
    shown: tuple[str, ...]
    plane: tuple[str, str]
    coverage: tuple[tuple[str, str], ...]
    parameters: tuple[Parameter, ...] = ()
    discrete: bool = False
    success: Callable[[Array], NDArray[np.bool_]] | None = None
    max_alpha: float | None = None
    seconds: float | None = None
    catalog: str | None = None
    reference: Literal["true model", "riccati"] = "true model"
    mismatch: tuple[str, float] | None = None
    published: bool = False

    def __post_init__(self) -> None:
        for field in ("states", "inputs"):
            object.__setattr__(self, field, tuple(replace(c, index=i) for i, c in enumerate(getattr(self, field))))
        turning = (replace(c, span=_TURN) if c.angle and c.span == (-1.0, 1.0) else c for c in self.states)
        object.__setattr__(self, "states", tuple(turning))
        coordinates = [c.name for c in self.states] + [c.name for c in self.inputs]
        names = coordinates + [p.name for p in self.parameters]
        self._check("names", "different ones", sorted({name for name in names if names.count(name) > 1}))
        drawn = {*self.shown, *self.plane, *(name for pair in self.coverage for name in pair)}
        self._check("shown, plane, coverage", f"names out of {coordinates}", sorted(drawn - set(coordinates)))
        angles = [c.name for c in self.states if c.angle]
        self._check("angles", "at most one, and none of a discrete plant", angles[0 if self.discrete else 1 :])
        sizes = [len(self.nominal.weights), len(self.nominal.input_weights)]
        expected = [len(self.observations), len(self.inputs)]
        self._check("nominal weights", f"{expected} of them", sizes if sizes != expected else [])
        self._check("dt", "a positive number", [] if self.dt > 0.0 else [self.dt])
        self._check("starts", "at least one", [] if self.starts else ["none"])

    def _check(self, what: str, expected: str, wrong: Sequence[object]) -> None:
        if wrong:
            raise ValueError(f"plant {self.name!r}, {what}: expected {expected}, got {', '.join(map(str, wrong))}.")

    @property
    def angle(self) -> int | None:
        """The place in s of its angle."""
        return next((c.index for c in self.states if c.angle), None)

    @property
    def observations(self) -> tuple[str, ...]:
        """Symbols of the entries of y, for figures."""
        symbols = ([f"\\cos{c.symbol}", f"\\sin{c.symbol}"] if c.angle else [c.symbol] for c in self.states)
        return tuple(f"${symbol}$" for pair in symbols for symbol in pair)

    @property
    def entries(self) -> tuple[tuple[str, str], ...]:
        """Names and units of the entries of y, as text; an angle has a cosine and a sine."""
        pairs = ([(f"cos {c.name}", ""), (f"sin {c.name}", "")] if c.angle else [(c.name, c.unit)] for c in self.states)
        return tuple(entry for pair in pairs for entry in pair)

    def coordinate(self, name: str) -> State | Input:
        """The state or input of that name."""
        inputs = [c for c in self.inputs if c.name == name]
        return inputs[0] if inputs else self.state(name)

    def state(self, name: str) -> State:
        """The state of that name."""
        return next(c for c in self.states if c.name == name)

    def lift(self, s: Entries, cos: Callable[[Any], Any], sin: Callable[[Any], Any]) -> list[Any]:
        """The entries of y from those of s, with a library's cosine and sine."""
        y: list[Any] = []
        for coordinate, value in zip(self.states, s, strict=True):
            if coordinate.angle:
                y += (cos(value), sin(value))
            else:
                y.append(value)
        return y

    def lifted_rates(self, y: Entries, rates: Entries) -> list[Any]:
        """dy/dt from the entries of y and of ds/dt: (cos phi)' = -phi' sin phi, (sin phi)' = phi' cos phi."""
        i = self.angle
        if i is None:
            return list(rates)
        return [*rates[:i], -rates[i] * y[i + 1], rates[i] * y[i], *rates[i + 1 :]]


def _label(quantity: str, symbol: str, unit: str) -> str:
    return f"{quantity} ${symbol}$ ({unit})".lstrip()
