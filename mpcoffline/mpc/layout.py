"""What the state of an MPC is made of: the plant's states, signals from outside, and the inputs of past steps.

An observation y is what a plant's log holds: its states, then its signals. The MPC's own state is z = [y, memory],
where the memory holds as many past values of each input as it needs: those that have not acted yet, where an input acts
with dead time, and the one before, where its changes have a price. Solvers, V and regressions see a model z+ = f(z, u)
like any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core import limits
from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.limits import check_limit
from mpcoffline.core.types import Array

from .labels import Label, Labels
from .signals import Named, Signal, after_the_last, turned


@dataclass(frozen=True)
class Layout:
    """Where everything stands in z, and how what the plant's map does not predict moves.

    ::

        z = [x, signals, u_0[k-1], u_0[k-2], ..., u_1[k-1], ...]     as many of each input as ``carried`` says

    Signals move along a horizon as they were previewed, and stay at the last value that is known; clocks turn, and what
    follows one goes on by its profile (:meth:`ahead`).

    Attributes:
        n_states: Number of the plant's states.
        nu: Number of inputs.
        delay: Dead time of each input in sampling steps, ``(nu,)``: the input of step k acts from step k + delay on.
        carried: Past values of each input in the memory, ``(nu,)``, at least ``delay``.
        signals: What comes from outside.
        labels: What states and inputs are called, for people.

    Raises:
        InvalidArgumentError: For two signals of one name, a delay of another length or a negative one, or more states
            than can be solved with.
    """

    n_states: int
    nu: int
    delay: tuple[int, ...]
    carried: tuple[int, ...]
    signals: tuple[Signal, ...] = ()
    labels: Labels = field(default_factory=Labels)

    def __post_init__(self) -> None:
        if len(self.delay) != self.nu or len(self.carried) != self.nu:
            raise InvalidArgumentError(
                "delay", expected=f"one number, or {self.nu}, one an input", actual=f"{len(self.delay)} numbers"
            )
        if any(m < d for m, d in zip(self.carried, self.delay, strict=True)):
            raise InvalidArgumentError("carried", expected=f"at least {self.delay}", actual=str(self.carried))
        self.labels.fitted(self.n_states, self.nu)
        names = [signal.name for signal in self.signals]
        if len(set(names)) < len(names):
            raise InvalidArgumentError("names of signals", expected="unique names", actual=str(names))
        clocks = [signal.name for signal in self.signals if signal.period is not None]
        if lost := [signal.follows for signal in self.signals if signal.follows not in (None, *clocks)]:
            raise InvalidArgumentError("follows", expected=f"a clock among {clocks}", actual=repr(lost[0])[:100])
        what = "of them, with signals and past inputs" if self.nx > self.n_states else "of them"
        check_limit("nx", what, self.nx, limits.STATES, error=InvalidArgumentError)

    @classmethod
    def of(
        cls, n_states: int, nu: int, delay: int | Sequence[int] | None = None, signals: Sequence[Signal] = ()
    ) -> Layout:
        """The layout of a plant; a delay of one number is that of all inputs, None is none.

        Raises:
            InvalidArgumentError: As the class.
        """
        check_integers(1, nx=n_states, nu=nu)
        check_limit("nu", "of them", int(nu), limits.INPUTS, error=InvalidArgumentError)
        known: Any = 0 if delay is None else delay
        given = (known,) * int(nu) if np.ndim(known) == 0 else tuple(known)
        check_integers(0, **{f"delay[{i}]": d for i, d in enumerate(given)})
        delays = tuple(int(d) for d in given)
        for signal in signals:
            if not isinstance(signal, Signal):
                raise InvalidArgumentError("signals", expected="a list of Signal", actual=repr(signal)[:200])
        return cls(int(n_states), int(nu), delays, delays, tuple(signals))

    def with_delay(self, delay: int | Sequence[int] | None) -> Layout:
        """The same with another dead time, and no more memory than that and prices on changes need."""
        other = replace(Layout.of(self.n_states, self.nu, delay, self.signals), labels=self.labels)
        return other.with_previous() if self.has_previous else other

    def with_previous(self) -> Layout:
        """The same with at least the last value of each input in the memory."""
        return replace(self, carried=tuple(max(1, m) for m in self.carried))

    @property
    def ny(self) -> int:
        """Size of an observation."""
        return self.n_states + sum(signal.size for signal in self.signals)

    @cached_property
    def present(self) -> NDArray[np.intp]:
        """Where in y the present value of each signal stands, ``(n_signals,)``."""
        sizes = [signal.size for signal in self.signals]
        return np.array([self.n_states + sum(sizes[:i]) for i in range(len(sizes))], dtype=np.intp)

    def named(self, values: ca.SX) -> Named:
        """Present values of the signals, a CasADi column, by name."""
        return Named([signal.name for signal in self.signals], values)

    @property
    def usual_signals(self) -> Array:
        """The columns of the signals where none is known, ``(ny - n_states,)``."""
        return np.array([value for signal in self.signals for value in signal.usual_values], dtype=np.float64)

    @property
    def y_labels(self) -> tuple[Label, ...]:
        """What the coordinates of an observation are called, ``(ny,)``; ``observation 0`` where nothing was said."""
        states = self.labels.states or tuple(Label(f"observation {i}") for i in range(self.n_states))
        signals = (Label(name, s.unit) for s in self.signals for name in s.columns)
        return (*states, *signals)

    @property
    def u_labels(self) -> tuple[Label, ...]:
        """What the inputs are called, ``(nu,)``; ``action 0`` where nothing was said."""
        return self.labels.inputs or tuple(Label(f"action {j}") for j in range(self.nu))

    @property
    def n_memory(self) -> int:
        """Number of past inputs in z."""
        return sum(self.carried)

    @property
    def nx(self) -> int:
        """Size of z."""
        return self.ny + self.n_memory

    @property
    def is_plain(self) -> bool:
        """Whether z is the plant's state and nothing else."""
        return self.nx == self.n_states

    @property
    def has_previous(self) -> bool:
        """Whether more is in the memory than dead time needs."""
        return self.carried != self.delay

    @property
    def steps(self) -> int:
        """How many steps back the memory reaches."""
        return max(self.carried)

    @cached_property
    def ages(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Input and age in steps of each entry of the memory, ``(n_memory,)`` both."""
        inputs = np.repeat(np.arange(self.nu), self.carried)
        ages = [age for m in self.carried for age in range(1, m + 1)]
        return inputs, np.array(ages, dtype=np.intp)

    def places(self, other: Layout) -> NDArray[np.intp]:
        """Where in z what another layout's z holds stands, ``(other.nx,)``.

        Raises:
            InvalidArgumentError: For one of other observations or inputs, or of more past values of an input.
        """
        fits = (other.ny, other.nu) == (self.ny, self.nu) and np.all(np.less_equal(other.carried, self.carried))
        if not fits:
            expected, actual = (f"{each.ny} observations, past inputs {each.carried}" for each in (self, other))
            raise InvalidArgumentError("layout", expected=f"{expected} at most", actual=actual)
        memory = [self._place(int(i), int(age)) for i, age in zip(*other.ages, strict=True)]
        return np.array([*range(self.ny), *memory], dtype=np.intp)

    def _place(self, i: int, age: int) -> int:
        """Where the value of input i of that many steps ago stands in [z, u]."""
        return self.nx + i if age == 0 else self.ny + sum(self.carried[:i]) + age - 1

    @cached_property
    def acting(self) -> NDArray[np.intp]:
        """Where in [z, u] the inputs stand that the plant's map is given: ``(nu,)`` and the present signals."""
        inputs = [self._place(i, d) for i, d in enumerate(self.delay)]
        return np.concatenate([np.array(inputs, dtype=np.intp), self.present])

    @cached_property
    def previous(self) -> NDArray[np.intp]:
        """Where in z the inputs of the step before stand, ``(nu,)``.

        Raises:
            InvalidArgumentError: If the memory lacks some.
        """
        if min(self.carried) < 1:
            raise InvalidArgumentError("memory", expected="the input of the step before", actual=f"{self.carried}")
        return np.array([self._place(i, 1) for i in range(self.nu)], dtype=np.intp)

    @cached_property
    def sources(self) -> NDArray[np.intp]:
        """Where in [z, u] the next value of each entry of z beyond the plant's states stands, ``(nx - n_states,)``."""
        ends = np.append(self.present, self.ny)[1:]
        shown = [min(j + 1, end - 1) for start, end in zip(self.present, ends, strict=True) for j in range(start, end)]
        past = [self._place(i, age - 1) for i, age in zip(*self.ages, strict=True)]
        return np.array([*shown, *past], dtype=np.intp)

    @cached_property
    def memory_sources(self) -> NDArray[np.intp]:
        """Where in [memory, u] the next value of each entry of the memory stands, ``(n_memory,)``."""
        return self.sources[self.ny - self.n_states :] - self.ny

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of the memory, as ``"u0[k-2]"``."""
        return tuple(f"u{i}[k-{age}]" for i, age in zip(*self.ages, strict=True))

    def ahead(self, y: Any) -> dict[int, Any]:
        """The next values of the entries of y that go on by a law of their own, by their place.

        Args:
            y: Observations, entries along the first axis: a CasADi column, or an array ``(ny, ...)``.
        """
        found: dict[int, Any] = {}
        clocks: dict[str | None, tuple[tuple[Any, Any], float]] = {}
        for signal, at in zip(self.signals, self.present.tolist(), strict=True):
            if signal.period is not None:
                step = 2.0 * np.pi / signal.period
                clocks[signal.name] = (y[at], y[at + 1]), step
                found[at], found[at + 1] = turned(y[at], y[at + 1], step)
        for signal, at in zip(self.signals, self.present.tolist(), strict=True):
            if signal.profile:
                phase, step = clocks[signal.follows]
                end = at + signal.preview
                found[end] = after_the_last(signal, y[end], turned(*phase, signal.preview * step), step)
        return found

    def wrapped(self, plant: ca.Function) -> ca.Function:
        """The map (z, u, p) -> z+ around the plant's map (x, acting inputs, p) -> x+."""
        if self.is_plain:
            return plant
        z, u, p = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu), ca.SX.sym("p", plant.numel_in(2))
        every = ca.vertcat(z, u)
        reached = plant(z[: self.n_states], every[self.acting.tolist()], p)
        moved = ca.vertcat(reached, every[self.sources.tolist()])
        for place, value in self.ahead(z).items():
            moved[place] = value
        return ca.Function("model", [z, u, p], [moved], ["x", "u", "p"], ["x_next"])

    def split(self, z: Array, u: Array) -> tuple[Array, Array]:
        """What the plant's map is given of states z ``(..., nx)`` and inputs u ``(..., nu)``: x and what acts."""
        return z[..., : self.n_states], np.concatenate([z, u], axis=-1)[..., self.acting]

    def joined(self, reached: Array, z: Array, u: Array) -> Array:
        """z+ ``(..., nx)`` of the plant's next states ``(..., n_states)``, from z and u."""
        joined = np.concatenate([reached, np.concatenate([z, u], axis=-1)[..., self.sources]], axis=-1)
        for place, value in self.ahead(np.moveaxis(z, -1, 0)).items():
            joined[..., place] = value
        return joined

    def remembered(self, memory: Array, u: Array) -> Array:
        """The memory ``(..., n_memory)`` after inputs u ``(..., nu)`` were applied."""
        every = np.concatenate([memory, u], axis=-1)
        return every[..., self.memory_sources]

    def filled(self, past: ArrayLike) -> Array:
        """The memory ``(..., n_memory)`` where each input has been ``past`` ``(..., nu)`` for long."""
        return np.asarray(past, dtype=np.float64)[..., self.ages[0]]
