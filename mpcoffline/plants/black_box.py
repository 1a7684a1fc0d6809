"""Plants of which nobody has equations: a linear model of what a log shows takes their place."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import Parameter, Signal

from .calling import arguments_of
from .description import Function, Plant
from .outputs import Output
from .quantities import Input, Limit, State, Values

if TYPE_CHECKING:
    from mpcoffline.datasets.logs.reading import LoggedTable
    from mpcoffline.datasets.table.transitions import TransitionTable
    from mpcoffline.estimation import LinearModel

_GAIN = 0.1  # by what share the effect of an input may be off
_EXPECTED = 'a list of Output("name", unit=...), without functions, one or more'


@dataclass(frozen=True, eq=False)
class BlackBoxPlant:
    """A plant without equations: what sensors show, what can be set, and what that costs.

    A log gives it a model: :meth:`modelled` makes a :class:`~mpcoffline.Plant` of it, with a linear model of few states
    (:func:`~mpcoffline.estimation.linear_model`) that nobody measures, and the same outputs. Where you know equations,
    even rough ones, describe a :class:`~mpcoffline.Plant`: it needs less of a log, and knows more than that has seen.

    Example:
        >>> oven = BlackBoxPlant(
        ...     "oven",
        ...     dt=30.0,
        ...     outputs=[Output("T", unit="degC", low=0, high=400)],
        ...     inputs=[Input("power", "%", 0, 100)],
        ...     signals=[Signal("set_point", "degC", low=100, high=300)],
        ...     cost=lambda y, u, d: (y.T - d.set_point) ** 2 + 1e-3 * u.power**2,
        ... )
        >>> log = oven.read("log.csv")
        >>> plant = oven.modelled(log)
        >>> learner = OfflineMPCLearner(plant.mpc())
        >>> learner.fit(plant.identify(log))

    Functions take ``y`` (outputs), ``u``, ``d`` and ``du`` by these names, as those of a plant take ``x``.

    Args:
        name: What it is called.
        dt: Control interval in s.
        outputs: What sensors show, ``Output(name, unit=..., low=..., high=...)``.
        inputs: What the controller sets.
        cost: What a step costs: a function, or weights of squares by name.
        signals: What comes from outside. Which of them move the plant is found in the log.
        references: With weights, where outputs and inputs belong, as of a plant.
        changes: With weights, what squares of changes of inputs cost.
        limits: What the controller has to keep besides the bounds and rates of inputs.
        columns: What logs call outputs, inputs and signals, as of a plant.
        horizon: Steps that its MPC looks ahead.
        discount: The weight of a cost one step later, in (0, 1].
        steps: Control intervals of a simulated episode.

    Raises:
        InvalidArgumentError: For whatever does not fit together, as of a plant.
    """

    name: str
    dt: float = field(kw_only=True)
    outputs: Sequence[Output] = field(kw_only=True)
    inputs: Sequence[Input] = field(kw_only=True)
    cost: Function | Mapping[str, float] = field(kw_only=True, repr=False)
    signals: Sequence[Signal] = field(kw_only=True, default=())
    references: Mapping[str, float | str] = field(kw_only=True, default_factory=dict)
    changes: Mapping[str, float] = field(kw_only=True, default_factory=dict)
    limits: Sequence[Limit] = field(kw_only=True, default=())
    columns: Mapping[str, str] = field(kw_only=True, default_factory=dict)
    horizon: int = field(kw_only=True, default=30)
    discount: float = field(kw_only=True, default=0.95)
    steps: int = field(kw_only=True, default=200)

    def __post_init__(self) -> None:
        _ = self._measured  # what is wrong in the description is told now

    @cached_property
    def _measured(self) -> Plant:
        """The same as if its outputs were states that stay: it checks what was described, and reads logs."""
        given: object = self.outputs
        if not isinstance(given, Sequence) or isinstance(given, str) or not given:
            raise InvalidArgumentError("outputs", expected=_EXPECTED, actual=repr(given)[:200])
        states = []
        for output in self.outputs:
            own: object = output
            if not isinstance(own, Output) or own.of is not None:
                hint = "There are no states that it could be a function of."
                raise InvalidArgumentError("outputs", expected=_EXPECTED, actual=repr(own)[:200], hint=hint)
            states.append(State(own.name, own.unit, own.low, own.high, noise=own.noise))
        cost = self.cost if isinstance(self.cost, Mapping) else self._of_states("cost", self.cost)
        limits = [
            each if isinstance(each.of, str) else replace(each, of=self._of_states(f"limit {each.name!r}", each.of))
            for each in self.limits
        ]
        return Plant(
            self.name,
            dt=self.dt,
            states=states,
            inputs=self.inputs,
            dynamics=_staying,
            discrete=True,
            cost=cost,
            signals=self.signals,
            references=self.references,
            changes=self.changes,
            limits=limits,
            columns=self.columns,
            horizon=self.horizon,
            discount=self.discount,
            steps=self.steps,
        )

    def _of_states(self, what: str, function: Function) -> Function:
        """A function of y as one of x, whose values it calls y."""
        needed = arguments_of(what, function, ("y", "u", "d", "du"))
        names = [output.name for output in self.outputs]

        @wraps(function)  # errors name its file and line
        def of_states(**given: Any) -> Any:
            values = {name: given[name] for name in needed if name != "y"}
            if "y" in needed:
                values["y"] = Values("output", "y", names, list(given["x"]))
            return function(**values)

        arguments = [inspect.Parameter("x" if name == "y" else name, inspect.Parameter.KEYWORD_ONLY) for name in needed]
        of_states.__signature__ = inspect.Signature(arguments)  # type: ignore[attr-defined]
        return of_states

    def read(self, log: Any, **options: Any) -> LoggedTable:
        """Reads a log of this plant, with the options of :meth:`mpcoffline.Plant.read`; costs are the plant's own."""
        return self._measured.read(log, **options)

    def model(self, log: TransitionTable, *, seed: int = 0) -> LinearModel:
        """A linear model of a log of this plant; ``print`` says what it is worth.

        Args:
            log: As :meth:`read` gives it.
            seed: Chooses the episodes that judge.

        Raises:
            InvalidDataError: For a log of other columns, one that says too little, or inputs beyond their bounds.
        """
        from mpcoffline.estimation import linear_model  # a second, which reading a log need not wait for

        n = len(self.outputs)
        low, high = self._measured.action_bounds
        log.check_fits(n + sum(signal.size for signal in self.signals), len(self.inputs), low, high)
        sizes = [signal.size for signal in self.signals]
        columns = [n + sum(sizes[:k]) for k in self._moving]
        return linear_model(log, n, columns, [each.delay for each in self.inputs], seed)

    @property
    def _moving(self) -> list[int]:
        """Which signals may move the plant: all but clocks."""
        return [k for k, signal in enumerate(self.signals) if signal.period is None]

    def modelled(self, log: TransitionTable | LinearModel, *, seed: int = 0) -> Plant:
        """The plant with a linear model of a log in place of equations.

        Its parameters are what each input does, against what the log says of that on the whole.

        Args:
            log: A log, as :meth:`read` gives it; or what :meth:`model` found in one.
            seed: Chooses the episodes that judge.

        Raises:
            InvalidDataError: As :meth:`model`.
        """
        from mpcoffline.estimation import LinearModel

        found = log if isinstance(log, LinearModel) else self.model(log, seed=seed)
        measured, inputs, signals = self._measured, self.inputs, [self.signals[k].name for k in self._moving]
        gains = [f"gain_{each.name}" for each in inputs]
        y = ca.Function("y", [x := ca.SX.sym("x", found.order)], [ca.DM(found.C) @ x + ca.DM(found.c)])

        def dynamics(x: Values, u: Values, d: Values, p: Values) -> list[Any]:
            middle = found.inputs.tolist()
            acting = [m + p[g] * (each - m) for m, g, each in zip(middle, gains, u, strict=True)]
            after = ca.DM(found.A) @ ca.vertcat(*x) + ca.DM(found.B) @ ca.vertcat(*acting) + ca.DM(found.b)
            if signals:
                after += ca.DM(found.E) @ ca.vertcat(*(d[name] for name in signals))
            return list(ca.vertsplit(after))

        def seen(x: Values) -> Values:
            return Values("state", "x", measured.names("states"), list(ca.vertsplit(y(ca.vertcat(*x)))))

        return Plant(
            self.name,
            dt=self.dt,
            states=[_state(k, found) for k in range(found.order)],
            inputs=[replace(each, delay=late) for each, late in zip(inputs, found.delay, strict=True)],
            outputs=[self._output(k, found, seen) for k in range(len(self.outputs))],
            dynamics=dynamics,
            discrete=True,
            cost=_cost_of(measured, seen),
            signals=self.signals,
            parameters={name: Parameter(1.0, low=0.1, high=10.0, spread=_GAIN) for name in gains},
            limits=[self._limit(each, seen) for each in measured.limits],
            columns=self.columns,
            horizon=self.horizon,
            discount=self.discount,
            steps=self.steps,
        )

    def _output(self, k: int, found: LinearModel, seen: Callable[[Values], Values]) -> Output:
        noise = self.outputs[k].noise
        return replace(self.outputs[k], of=lambda x: seen(x)[k], noise=found.noise[k] if noise is None else noise)

    def _limit(self, limit: Limit, seen: Callable[[Values], Values]) -> Limit:
        """A limit of outputs as one of states; of an input as it is."""
        of = limit.of
        if isinstance(of, str):
            if of in (each.name for each in self.inputs):
                return limit
            return replace(limit, of=lambda x: seen(x)[of])
        needed = arguments_of(f"limit {limit.name!r}", of, ("x", "u", "d"))

        def of_states(x: Values, u: Values, d: Values) -> Any:
            values = {"x": seen(x), "u": u, "d": d}
            return of(**{name: values[name] for name in needed})

        return replace(limit, of=of_states)


def _staying(x: Values) -> list[Any]:
    return list(x)


def _state(k: int, found: LinearModel) -> State:
    far = np.sqrt(3.0) * found.start_spread[k]  # a range of that standard deviation
    return State(f"state_{k + 1}", start=(found.start[k] - far, found.start[k] + far), noise=0.0)


def _cost_of(measured: Plant, seen: Callable[[Values], Values]) -> Function:
    """What a step costs, as a function of the states."""

    def cost(x: Values, u: Values, d: Values, du: Values) -> Any:
        return measured.price(list(seen(x)), list(u), list(d), list(du))

    def without_changes(x: Values, u: Values, d: Values) -> Any:
        return measured.price(list(seen(x)), list(u), list(d), [0.0] * len(u))

    return cost if measured.prices_changes else without_changes
