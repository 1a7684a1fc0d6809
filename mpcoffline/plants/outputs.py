"""Plants of which sensors show something else than the states."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import casadi as ca
import numpy as np

from mpcoffline.core.checks import check_number
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, UnknownIdError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC
from mpcoffline.mpc.expressions import function_from_json, function_to_json
from mpcoffline.mpc.labels import Label
from mpcoffline.mpc.outputs import output_function, outputs_from_json

from .calling import called, number
from .quantities import State, check_quantity

if TYPE_CHECKING:
    from mpcoffline.estimation import OutputIdentification

    from .description import Plant


@dataclass(frozen=True)
class Output:
    """What a sensor shows.

    Example:
        >>> Output("pressure", lambda x: 0.0981 * x.level + 1.0, "bar", low=0.0, noise=0.01)
        >>> Output("acceleration", lambda x, u: 0.5 * u.force - 0.2 * x.speed, "m/s^2", noise=0.05)

    A sensor is read before the next input is chosen: ``u`` are the inputs that acted in the step that ends there, dead
    time past. Where an episode begins nobody knows these, so that such an output is not used there; simulations take
    the inputs to have been at rest.

    Args:
        name: What logs call it: a Python identifier.
        of: A function of the states ``x``, and of the inputs ``u`` where it depends on these; or the name of a state,
            its own by default.
        unit: Its unit.
        low: The least that the sensor gives.
        high: The largest.
        noise: Standard deviation of the simulated measurement; by default as a :class:`State` has it.

    Raises:
        InvalidArgumentError: For a name that is no identifier, or numbers that do not fit together.
    """

    name: str
    of: str | Callable[..., Any] | None = None
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    noise: float | None = None

    def __post_init__(self) -> None:
        check_quantity("output", self)
        of: object = self.of
        if not (of is None or isinstance(of, str) or callable(of)):
            expected = "a function of x and u, or the name of a state"
            raise InvalidArgumentError(f"output {self.name}: of", expected=expected, actual=repr(of)[:200])
        if self.noise is not None:
            check_number(f"output {self.name}: noise", self.noise, 0.0, open_low=False)

    @property
    def deviation(self) -> float:
        """The standard deviation of the simulated measurement."""
        return State(self.name, self.unit, self.low, self.high, noise=self.noise).deviation


def checked_outputs(plant: Plant, given: object) -> tuple[Output, ...]:
    """Outputs as they were described; the name of a state stands for that, as its sensor shows it.

    Raises:
        InvalidArgumentError: For anything else, or names that are taken.
    """
    if not isinstance(given, Sequence) or isinstance(given, str):
        expected = "a list of names of states and Output(...)"
        raise InvalidArgumentError("outputs", expected=expected, actual=repr(given)[:200])
    states: dict[str, State] = {state.name: state for state in plant.states}
    found: list[Output] = []
    for each in given:
        output = _of_state(states[each]) if isinstance(each, str) and each in states else each
        if not isinstance(output, Output):
            raise _unknown("outputs", str(output), states)
        output = output if output.of is not None else replace(output, of=output.name)
        if isinstance(output.of, str) and output.of not in states:
            of, is_input = output.of, output.of in plant.names("inputs")
            hint = f"Of an input, as it acted: lambda x, u: u.{of}." if is_input else ""
            raise _unknown(f"output {output.name}: of", of, states, hint)
        found.append(output)
    names = [q.name for q in found]
    taken = names + plant.names("inputs") + plant.names("signals")
    taken += [name for name in states if not any(q.name == q.of == name for q in found)]
    if twice := sorted({name for name in names if taken.count(name) > 1}):
        name = twice[0]
        shown = f"A state that is measured as it is stands by its name, {name!r}, or as Output({name!r}, ...) without a"
        hint = f"{shown} function." if name in states and names.count(name) == 1 else ""
        raise InvalidArgumentError("outputs", expected="names of their own", actual=f"{name!r} twice", hint=hint)
    return tuple(found)


def _of_state(state: State) -> Output:
    return Output(state.name, state.name, state.unit, state.low, state.high, state.deviation)


def _unknown(what: str, given: str, states: Mapping[str, State], hint: str = "") -> InvalidArgumentError:
    error = UnknownIdError.of(what, given, list(states))
    return InvalidArgumentError(what, expected=error.expected, actual=error.actual, hint=hint or error.hint)


def outputs_function(plant: Plant) -> ca.Function:
    """What sensors show of states ``(nx, 1)``, and inputs ``(nu, 1)`` where some depend on these, as a column."""
    x, u = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", len(plant.inputs))
    values, names = ca.vertsplit(x), plant.names("states")
    rows = []
    for output in plant.outputs:
        of = output.of
        if callable(of):
            what = f"output {output.name}"
            rows.append(number(what, called(what, of, plant.values(values, ca.vertsplit(u)))))
        else:
            rows.append(values[names.index(of or output.name)])
    return output_function(x, u, ca.vertcat(*rows))


def identified(plant: Plant, log: TransitionTable, seed: int) -> OutputIdentification:
    """See :meth:`mpcoffline.Plant.identify`."""
    if not plant.outputs:
        hint = "Where the states themselves are measured, a learner takes the log as it is."
        raise InvalidArgumentError("outputs", expected="a plant with outputs", actual="none", hint=hint)
    return OutputReader.of(plant).identify(plant.mpc(), log, seed)


@dataclass(frozen=True)
class OutputReader:
    """How a log of outputs becomes one of states: all that it takes of a plant, as a file has it, too.

    Attributes:
        outputs: h, states ``(n_states, 1)`` -> outputs, with the inputs of the step before where some depend on these.
        cost: Of a step: states, inputs, present signals and the inputs before -> cost.
        labels: What the outputs are called, ``(n_outputs,)``.
        starts: Between which values states are where an episode begins, ``(n_states, 2)``.
        places: Which output each state is, ``(n_states,)``; None for one that nobody measures.
        late: Which inputs may act later than the MPC says, ``(nu,)``.
    """

    outputs: ca.Function
    cost: ca.Function
    labels: tuple[Label, ...]
    starts: tuple[tuple[float, float], ...]
    places: tuple[int | None, ...]
    late: tuple[bool, ...]

    @classmethod
    def of(cls, plant: Plant) -> Self:
        """That of a plant with outputs."""
        own = {output.of: k for k, output in reversed(list(enumerate(plant.outputs))) if isinstance(output.of, str)}
        labels = tuple(Label(output.name, output.unit) for output in plant.outputs)
        starts = tuple((float(low), float(high)) for low, high in (state.starts for state in plant.states))
        places = tuple(own.get(state.name) for state in plant.states)
        late = tuple(each.delay is None for each in plant.inputs)
        return cls(plant.outputs_function, plant.cost_function, labels, starts, places, late)

    def identify(self, mpc: MPC, log: TransitionTable, seed: int) -> OutputIdentification:
        """Model, noise and states, with what a step costs of these; ``mpc`` is MPC_1."""
        from mpcoffline.estimation import identify_from_outputs  # a second, which reading a log need not wait for

        layout = mpc.layout
        bounds = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
        log.check_fits(mpc.ny - layout.n_states + len(self.labels), mpc.nu, *bounds)
        low, high = np.array(self.starts).T
        spread = (high - low) / np.sqrt(12.0)
        for i in np.flatnonzero(spread == 0.0).tolist():
            place = self.places[i]
            if place is None:
                expected = (
                    "a range (low, high): how far it may be from there when an episode begins, as nobody measures it"
                )
                name = f"state {layout.y_labels[i].name}: start"
                raise InvalidArgumentError(name, expected=expected, actual=repr(self.starts[i][0]))
            spread[i] = np.std(log.values().observations[:, place])
        known = {"start": 0.5 * (low + high), "start_spread": spread, "labels": self.labels, "late": self.late}
        found = identify_from_outputs(mpc, log, self.outputs, **known, seed=seed)
        return replace(found, table=self._with_costs(found, log.names[len(self.labels) :]))

    def _with_costs(self, found: OutputIdentification, names: tuple[str, ...]) -> TransitionTable:
        """Transitions with what a step costs of their states, as the log of outputs could not tell it."""
        columns, layout = found.table.values(), found.mpc.layout
        first = np.zeros(len(found.table), dtype=bool)
        first[found.table.episodes.firsts] = True
        inputs: Array = columns.actions
        before = np.where(first[:, None], inputs, np.roll(inputs, 1, axis=0))
        s = columns.observations[:, : layout.n_states], inputs, columns.observations[:, layout.present.tolist()], before
        costs = self.cost(*(each.T for each in s)).full().ravel()
        table = TransitionTable.from_arrays(
            columns.observations,
            inputs,
            costs,
            columns.next_observations,
            columns.terminations,
            found.table.episode_ids,
        )
        if names:
            table.names = (*(str(label) for label in layout.y_labels[: layout.n_states]), *names)
        return table

    def to_json(self) -> dict[str, Any]:
        """For a file.

        Raises:
            InvalidArgumentError: For outputs or a cost that are no plain arithmetic.
        """
        functions = {"outputs": function_to_json(self.outputs), "cost": function_to_json(self.cost)}
        rest = {name: list(getattr(self, name)) for name in ("places", "late")}
        pairs = {name: [list(each) for each in getattr(self, name)] for name in ("labels", "starts")}
        return functions | rest | pairs

    @classmethod
    def from_json(cls, data: Mapping[str, Any], mpc: MPC) -> Self:
        """The inverse, for an MPC of the plant.

        Raises:
            FileFormatError: For parts that do not fit together.
            KeyError: For a part that is missing.
            TypeError: For a part of another kind.
            ValueError: Likewise.
        """
        layout = mpc.layout
        n, nu = layout.n_states, layout.nu
        labels = tuple(Label(str(name), str(unit)) for name, unit in data["labels"])
        starts = tuple((float(low), float(high)) for low, high in data["starts"])
        places = tuple(None if k is None else range(len(labels))[int(k)] for k in data["places"])
        late = tuple(bool(each) for each in data["late"])
        if (len(starts), len(places), len(late)) != (n, n, nu):
            sizes = f"{len(starts)} starts, {len(places)} places, {len(late)} inputs"
            raise FileFormatError("outputs", expected=f"those of {n} states and {nu} inputs", actual=sizes)
        outputs = outputs_from_json(data["outputs"], n, nu, len(labels))
        cost = function_from_json(data["cost"], "cost", inputs=(n, nu, len(layout.signals), nu), output=1)
        return cls(outputs, cost, labels, starts, places, late)


def check_measured(plant: Plant, what: str) -> None:
    """Refuses a plant of which the states are not measured, where they have to be.

    Raises:
        InvalidArgumentError: For one with outputs; says what can be done.
    """
    if plant.outputs:
        hint = "`mpcoffline tune` estimates these; in Python: learner.fit(plant.identify(plant.read(log)))."
        actual = f"outputs {', '.join(output.name for output in plant.outputs)}"
        expected = f"states that are measured, for {what}"
        raise InvalidArgumentError(plant.name, expected=expected, actual=actual, hint=hint)
