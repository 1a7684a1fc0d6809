"""A plant as its engineer describes it: one description, from which MPC, simulation and the reading of logs come."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.core.limits import HEADER
from mpcoffline.core.text import check_name
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC, Signal
from mpcoffline.mpc.labels import Label, Labels

from .calling import arguments_of, called, column, number
from .outputs import checked_outputs, identified, outputs_function
from .quantities import Input, Limit, State, Values, checked_parameter, with_usual

if TYPE_CHECKING:
    import gymnasium as gym

    from mpcoffline.datasets.logs.reading import LoggedTable
    from mpcoffline.datasets.logs.wanted import Wanted
    from mpcoffline.datasets.table.transitions import TransitionTable
    from mpcoffline.estimation import OutputIdentification

Function = Callable[..., Any]


@dataclass(frozen=True, eq=False)
class Plant:
    """A plant: what is measured, what can be set, what comes from outside, how it moves, and what that costs.

    Functions call quantities by name, with the arguments that they need out of ``x`` (states), ``u`` (inputs), ``d``
    (signals) and ``p`` (parameters); a cost may also take ``du``, the changes of the inputs. They are traced with
    CasADi once, when the plant is described; what is wrong in them is told with file and line.

    Example:
        >>> plant = Plant(
        ...     "two tanks",
        ...     dt=10.0,
        ...     states=[State("h1", "cm", 0, 40), State("h2", "cm", 0, 40)],
        ...     inputs=[Input("valve", "%", 0, 100, rate=20, delay=2)],
        ...     signals=[Signal("set_point", "cm", low=5, high=30)],
        ...     parameters={"a1": Parameter(0.3, unit="cm^0.5/s", spread=0.3), "k": 0.02},
        ...     dynamics=lambda x, u, p: [p.k * u.valve - p.a1 * ca.sqrt(x.h1 + 0.01), p.a1 * (x.h1 - x.h2) / 10],
        ...     cost=lambda x, u, d: (x.h2 - d.set_point) ** 2 + 1e-3 * u.valve**2,
        ...     limits=[Limit("overflow", "h1", high=35, soft=10)],
        ... )

    Args:
        name: What it is called.
        dt: Control interval in s.
        states: What the equations move; measured, where there are no outputs.
        inputs: What the controller sets.
        dynamics: The time derivatives of the states (per second), a list in their order or a mapping by name; with
            ``discrete`` their values one control interval later.
        cost: What a step costs: a function, or weights of squares by name, ``{"h2": 1.0, "valve": 1e-3}``.
        signals: What comes from outside and is known when the controller acts: set-points, measured disturbances,
            prices. Their columns stand in the observation after the states.
        parameters: Numbers of the equations that a log may correct; a plain number may become a hundredth to a hundred
            times its value, as may a :class:`~mpcoffline.Parameter` without bounds. What is not to be corrected is
            written into the equations.
        references: With weights, where states and inputs belong: a number, or of a state the name of a signal; 0 by
            default.
        changes: With weights, what squares of changes of inputs from step to step cost; nothing by default.
        limits: What the controller has to keep besides the bounds and rates of inputs; nothing by default.
        outputs: What is measured in place of all states: names of these, and :class:`~mpcoffline.Output` with functions
            of them, and of inputs. Logs and environments hold outputs then; :meth:`identify` estimates the states.
        columns: What logs call what is measured, inputs and signals where that is not their name: headers, or their
            first words as ``{"h1": "LI-101"}``.
        discrete: Whether ``dynamics`` gives the next state.
        integrator: How it is integrated otherwise, see :class:`~mpcoffline.Model`.
        horizon: Steps that its MPC looks ahead.
        discount: The weight of a cost one step later, in (0, 1].
        steps: Control intervals of a simulated episode.

    Raises:
        InvalidArgumentError: For whatever does not fit together; names the quantity, and file and line of a function.
    """

    name: str
    dt: float = field(kw_only=True)
    states: Sequence[State] = field(kw_only=True)
    inputs: Sequence[Input] = field(kw_only=True)
    dynamics: Function = field(kw_only=True, repr=False)
    cost: Function | Mapping[str, float] = field(kw_only=True, repr=False)
    signals: Sequence[Signal] = field(kw_only=True, default=())
    parameters: Mapping[str, Any] = field(kw_only=True, default_factory=dict)
    references: Mapping[str, float | str] = field(kw_only=True, default_factory=dict)
    changes: Mapping[str, float] = field(kw_only=True, default_factory=dict)
    limits: Sequence[Limit] = field(kw_only=True, default=())
    outputs: Sequence[Any] = field(kw_only=True, default=())
    columns: Mapping[str, str] = field(kw_only=True, default_factory=dict)
    discrete: bool = field(kw_only=True, default=False)
    integrator: str = field(kw_only=True, default="auto")
    horizon: int = field(kw_only=True, default=30)
    discount: float = field(kw_only=True, default=0.95)
    steps: int = field(kw_only=True, default=200)

    def __post_init__(self) -> None:
        check_name("name of a plant", self.name)
        check_number("dt", self.dt, 0.0)
        check_number("discount", self.discount, 0.0, 1.0)
        check_integers(1, horizon=self.horizon, steps=self.steps)
        for kind, cls in (("states", State), ("inputs", Input), ("signals", Signal), ("limits", Limit)):
            object.__setattr__(self, kind, _listed(kind, getattr(self, kind), cls))
        for kind in ("states", "inputs"):
            if not getattr(self, kind):
                raise InvalidArgumentError(kind, expected="one or more", actual="none")
        object.__setattr__(self, "parameters", {n: checked_parameter(n, p) for n, p in dict(self.parameters).items()})
        object.__setattr__(self, "signals", tuple(with_usual(signal) for signal in self.signals))
        object.__setattr__(self, "outputs", checked_outputs(self, self.outputs))
        quantities: tuple[Any, ...] = (*self.states, *self.inputs, *self.signals)
        names = [each.name for each in quantities] + list(self.parameters)
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InvalidArgumentError("names", expected="different ones", actual=f"{twice[0]!r} twice")
        self._check_columns()
        self._check_cost()
        for limit in self.limits:
            if isinstance(limit.of, str) and limit.of not in (known := self.names("states") + self.names("inputs")):
                raise _unknown(f"limit {limit.name!r}: of", limit.of, known)
        _ = self.rates_function, self.cost_function, self.outputs_function  # what is wrong in them is told now
        self.mpc()

    def names(self, kind: str) -> list[str]:
        """The names of its ``"states"``, ``"inputs"`` or ``"signals"``."""
        return [each.name for each in getattr(self, kind)]

    @property
    def measured(self) -> tuple[Any, ...]:
        """What sensors show: its outputs, or its states where it has none."""
        return tuple(self.outputs or self.states)

    def _check_columns(self) -> None:
        known = [q.name for q in self.measured] + self.names("inputs") + self.names("signals")
        for name, header in dict(self.columns).items():
            if name not in known:
                raise _unknown("columns", name, known)
            if not isinstance(header, str) or not 0 < len(header.strip()) <= HEADER:
                expected = f"a header of up to {HEADER} characters"
                raise InvalidArgumentError(f"columns: {name}", expected=expected, actual=repr(header)[:100])

    def _check_cost(self) -> None:
        if not isinstance(self.cost, Mapping):
            for argument in ("references", "changes"):
                if getattr(self, argument):
                    expected = "none beside a cost that is a function: write them into it"
                    raise InvalidArgumentError(argument, expected=expected, actual=repr(getattr(self, argument)))
            return
        known = self.names("states") + self.names("inputs")
        for argument, given, allowed in (
            ("cost", self.cost, known),
            ("changes", self.changes, self.names("inputs")),
            ("references", self.references, known),
        ):
            for name, value in given.items():
                if name not in allowed:
                    raise _unknown(argument, name, allowed)
                if argument != "references":
                    check_number(f"{argument}: {name}", value, 0.0, open_low=False)
                elif isinstance(value, str):
                    signals = self.names("signals") if name in self.names("states") else []
                    if value not in signals:
                        raise _unknown(f"references: {name}", value, signals)
                else:
                    check_number(f"references: {name}", value, -math.inf, open_low=False)

    def values(self, x: Any = None, u: Any = None, d: Any = None, p: Any = None, du: Any = None) -> dict[str, Values]:
        """What functions get, by the names of their arguments; those that are not given are left out.

        Args:
            x: As many values as states.
            u: As many as inputs.
            d: As many as signals.
            p: By name.
            du: As many as inputs.
        """
        parts = {"x": ("state", x, "states"), "u": ("input", u, "inputs"), "d": ("signal", d, "signals")}
        found = {k: Values(kind, k, self.names(n), list(v)) for k, (kind, v, n) in parts.items() if v is not None}
        if p is not None:
            found["p"] = Values("parameter", "p", list(p), list(p.values()))
        if du is not None:
            found["du"] = Values("input", "du", self.names("inputs"), list(du))
        return found

    def rates(self, x: Sequence[Any], u: Sequence[Any], d: Sequence[Any], p: Mapping[str, Any]) -> ca.SX:
        """What ``dynamics`` says of CasADi expressions, as a column ``(nx, 1)``."""
        result = called("dynamics", self.dynamics, self.values(x, u, d, p))
        return column("dynamics", self.dynamics, result, self.names("states"))

    def price(self, x: Sequence[Any], u: Sequence[Any], d: Sequence[Any], du: Sequence[Any]) -> ca.SX:
        """What ``cost`` says of CasADi expressions."""
        if not isinstance(self.cost, Mapping):
            return number("cost", called("cost", self.cost, self.values(x, u, d, du=du)))
        values, total = self.values(x, u, d), ca.SX(0)
        by_name = dict(zip(self.names("states") + self.names("inputs"), [*values["x"], *values["u"]], strict=True))
        for name, weight in self.cost.items():
            reference = self.references.get(name, 0.0)
            total += (
                weight * (by_name[name] - (values["d"][reference] if isinstance(reference, str) else reference)) ** 2
            )
        for name, change in zip(self.names("inputs"), du, strict=True):
            total += self.changes.get(name, 0.0) * change**2
        return total

    @property
    def prices_changes(self) -> bool:
        """Whether changes of inputs have a price."""
        if isinstance(self.cost, Mapping):
            return any(weight > 0.0 for weight in self.changes.values())
        return "du" in arguments_of("cost", self.cost, ("x", "u", "d", "du"))

    @cached_property
    def rates_function(self) -> ca.Function:
        """``dynamics`` as CasADi function ``(x, u, d, p)``, p the scalars of the parameters in their order."""
        x, u, d = (
            ca.SX.sym(k, len(each)) for k, each in zip("xud", (self.states, self.inputs, self.signals), strict=True)
        )
        p = ca.SX.sym("p", len(self.parameters))
        by_name = dict(zip(self.parameters, _split(p), strict=True))
        rates = self.rates(_split(x), _split(u), _split(d), by_name)
        return ca.Function("dynamics", [x, u, d, p], [rates])

    @cached_property
    def cost_function(self) -> ca.Function:
        """``cost`` as CasADi function ``(x, u, d, before)``, with the inputs of the step before."""
        sizes = (self.states, self.inputs, self.signals, self.inputs)
        x, u, d, before = (ca.SX.sym(k, len(each)) for k, each in zip("xudb", sizes, strict=True))
        price = self.price(_split(x), _split(u), _split(d), _split(u - before))
        return ca.Function("cost", [x, u, d, before], [price])

    @cached_property
    def outputs_function(self) -> ca.Function:
        """What sensors show without noise, a CasADi function ``x -> y``, or ``(x, u) -> y`` if it depends on inputs."""
        return outputs_function(self)

    def costs(self, x: Array, u: Array, d: Array, before: Array) -> Array:
        """The stage cost of many steps ``(n,)``.

        Args:
            x: States, ``(n, nx)``.
            u: Inputs, ``(n, nu)``.
            d: Present signals, ``(n, n_signals)``.
            before: Inputs of the step before, ``(n, nu)``.
        """
        return np.asarray(self.cost_function(x.T, u.T, d.T, before.T).full().ravel())

    @property
    def labels(self) -> Labels:
        """Names and units of states and inputs."""
        return Labels(*(tuple(Label(q.name, q.unit) for q in each) for each in (self.states, self.inputs)))

    @property
    def action_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the inputs, ``(nu,)`` each."""
        low, high = ([getattr(each, end) for each in self.inputs] for end in ("low", "high"))
        return np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)

    def mpc(self, horizon: int | None = None, discount: float | None = None) -> MPC:
        """The MPC that an engineer would start from: this description, taken at its word (MPC_1).

        A cost that is a quadratic becomes a :class:`~mpcoffline.QuadraticCost`, any other stays the expression that it
        is; the terminal cost is the stage cost with inputs as usual. Limits and rates are constraints.

        Args:
            horizon: Steps that it looks ahead; the plant's by default.
            discount: The weight of a cost one step later; the plant's by default.
        """
        from .control_problem import control_problem

        return control_problem(
            self, self.horizon if horizon is None else horizon, self.discount if discount is None else discount
        )

    def read(
        self,
        log: Any,
        *,
        columns: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        time: str | Sequence[str] | None = None,
        time_format: str | None = None,
        timezone: str | None = None,
        episode: str | None = None,
        where: Mapping[str, Any] | None = None,
        max_gap: float | None = None,
    ) -> LoggedTable:
        """Reads a log of this plant; needs ``pip install "mpcoffline[logs]"``.

        Columns are found by name, whatever the case and signs between letters, with the unit in the header, as
        ``h1 [mm]``, ``h1 (mm)`` or ``h1_mm``, and converted to the plant's. Rows may be at any times: states are taken
        linearly between them, signals as last known, inputs by their mean over the control interval. What cannot be
        is left out, and gaps begin new episodes; ``table.report`` says what and why. Costs are the plant's own; of a
        plant with outputs they are zero until :meth:`identify` has found the states.

        Args:
            log: A file (CSV and other text, Parquet, Arrow), a frame (polars, pandas, pyarrow), or a list of them.
            columns: Headers, or their first words, by the plant's names; those of the description by default.
            units: Units of the log by the plant's names, where headers do not say them.
            time: Header of the time, or of date and time; looked for by default, and without one rows are taken to be
                ``dt`` apart.
            time_format: How stamps are written, as ``"%d.%m.%Y %H:%M"``; found out by default.
            timezone: Of stamps without offset, as ``"Europe/Berlin"``, for its daylight saving.
            episode: Header of a column that tells episodes apart.
            where: Values of further columns that rows must have, as ``{"mode": ["AUTO", "CASCADE"]}``.
            max_gap: Seconds between rows beyond which a new episode begins; by default one and a half
                control intervals. Logs that hold changes only need more.

        Raises:
            InvalidDataError: For a log that cannot be understood; names row and column.
            InvalidArgumentError: For options that do not fit.
            StorageError: For a file that cannot be read.
        """
        from mpcoffline.datasets.logs.collecting import Options
        from mpcoffline.datasets.logs.reading import read_log

        options = Options(columns or {}, units or {}, time, time_format, timezone, episode, where or {}, max_gap)
        return read_log(log, self.wanted, options)

    @property
    def wanted(self) -> Wanted:
        """What a log of it should hold."""
        from mpcoffline.datasets.logs.columns import Quantity
        from mpcoffline.datasets.logs.wanted import Wanted

        measured, inputs, signals = (
            [Quantity(q.name, q.unit, q.low, q.high, self.columns.get(q.name, "")) for q in each]
            for each in (self.measured, self.inputs, self.signals)
        )
        previews, periods = [s.preview for s in self.signals], [s.period for s in self.signals]
        # Outputs do not tell what a step cost: that is known when the states are.
        costs = (lambda y, *_: np.zeros(len(y))) if self.outputs else self.costs
        return Wanted(self.dt, measured, inputs, signals, previews, periods, costs)

    def identify(self, log: TransitionTable, *, seed: int = 0) -> OutputIdentification:
        """Model, noise and states from a log of its outputs, with what the plant's cost says of these states.

        Where episodes begin, states are taken to be anywhere in their ``start``.

        Example:
            >>> found = plant.identify(plant.read("log.csv"))
            >>> learner = OfflineMPCLearner(plant.mpc())
            >>> learner.fit(found)
            >>> action, state = learner.output_policy.predict(outputs)

        Args:
            log: Transitions of its outputs, as :meth:`read` or a data set of its environment gives them.
            seed: Of the search.

        Raises:
            InvalidArgumentError: For a plant without outputs, or a state that nobody measures and whose ``start`` is
                one number.
            InvalidDataError: For a log of other columns, inputs beyond their bounds, or as
                :func:`~mpcoffline.estimation.identify_from_outputs`.
        """
        return identified(self, log, seed)

    def env(self, **options: Any) -> gym.Env[Any, Any]:
        """A Gymnasium environment that simulates this plant.

        Args:
            **options: As :class:`~mpcoffline.plants.PlantEnv` takes them, and those of ``gymnasium.make``.
        """
        from .environment import made

        return made(self, **options)


def _listed(kind: str, given: object, cls: type[Any]) -> tuple[Any, ...]:
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise InvalidArgumentError(kind, expected=f"a list of {cls.__name__}", actual=repr(given)[:200])
    for each in given:
        if not isinstance(each, cls):
            raise InvalidArgumentError(kind, expected=f"a list of {cls.__name__}", actual=f"one with {each!r}"[:200])
    return tuple(given)


def _unknown(what: str, given: str, known: Sequence[str]) -> InvalidArgumentError:
    error = UnknownIdError.of(what, given, known)
    return InvalidArgumentError(what, expected=error.expected, actual=error.actual, hint=error.hint)


def _split(column_of: ca.SX) -> list[ca.SX]:
    return list(ca.vertsplit(column_of)) if column_of.numel() else []
