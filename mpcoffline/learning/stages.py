"""The parts of a learning method: what is known, and the stages that add to it, one after another."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.shards import Change as RowChange, ShardedTable
from mpcoffline.datasets.table.transitions import Columns, TransitionTable
from mpcoffline.estimation import Identification
from mpcoffline.mpc import MPC, TerminalCost

from .limit_costs import LimitCosts
from .potential import Potential
from .value.function import ValueFunction

#: Share of the variance of costs that rounding may leave open.
ROUNDING = 1e-6

T = TypeVar("T")
Arrays = dict[str, NDArray[Any]]
Metrics = dict[str, float]


@dataclass(frozen=True)
class FitResult:
    """What a fit found.

    Attributes:
        theta: The learned parameters, ``(size,)``.
        loss_before: The loss of the method where it began; for (FIT) the regression error in units of the cost's
            variance.
        loss_after: The same at theta.
        at_bounds: Names of the learned parameters that ended on a bound.
        potential: The potential that was fitted with the cost, if one was.
        residual_share: The share of what the identified model missed that a learned residual explains; None where the
            model has none.
        cost: How the logged costs follow from the MPC's stage cost, where that was kept; None where it was learned.
        limits: What a unit of the prices of soft limits is in logged costs, and whether these contain them; None where
            nothing is soft.
    """

    theta: NDArray[np.float64]
    loss_before: float
    loss_after: float
    at_bounds: tuple[str, ...] = ()
    potential: Potential | None = None
    residual_share: float | None = None
    cost: KnownCost | None = None
    limits: tuple[float, bool] | None = None

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description, without theta."""
        return {
            "loss_before": self.loss_before,
            "loss_after": self.loss_after,
            "at_bounds": list(self.at_bounds),
            "potential": None if self.potential is None else self.potential.to_json(),
            "residual_share": self.residual_share,
            "cost": None if self.cost is None else asdict(self.cost),
            "limits": None if self.limits is None else list(self.limits),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any], theta: NDArray[np.float64]) -> FitResult:
        """The inverse of :meth:`to_json`."""
        potential = None if data["potential"] is None else Potential.from_json(data["potential"])
        at_bounds = tuple(map(str, data["at_bounds"]))
        share = None if data["residual_share"] is None else float(data["residual_share"])
        cost = None if data["cost"] is None else KnownCost.from_json(data["cost"])
        limits = None if data["limits"] is None else (float(data["limits"][0]), data["limits"][1] is True)
        losses = float(data["loss_before"]), float(data["loss_after"])
        return cls(theta, *losses, at_bounds, potential, share, cost, limits)


@dataclass(frozen=True)
class KnownCost:
    """How the logged costs L follow from the MPC's stage cost: ``L = scale Lhat(s,a) + offset``, or of s+.

    Attributes:
        scale: Positive.
        offset: In the unit of the logged costs.
        missed: Share of the variance of the logged costs that is not explained.
        agreeing: Share of the transitions that it holds for.
        tolerance: Where that is not all: up to this, in the unit of the logged costs, it holds for one.
        constant: Whether all logged costs are one number, so that they say nothing about Lhat.
        reached: Whether they are of the state that a step reaches, ``L = scale Lhat(s+,a) + offset``, as most rewards
            of simulators.
        regressed: Whether Lhat is not what was given, but a regression of the logged costs, exact to rounding.
    """

    scale: float = 1.0
    offset: float = 0.0
    missed: float = 0.0
    agreeing: float = 1.0
    tolerance: float = 0.0
    constant: bool = False
    reached: bool = False
    regressed: bool = False

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> KnownCost:
        """The inverse of ``dataclasses.asdict``."""
        numbers, flags = ("scale", "offset", "missed", "agreeing", "tolerance"), ("constant", "reached", "regressed")
        own: dict[str, Any] = {name: float(data[name]) for name in numbers}
        return cls(**own, **{name: data[name] is True for name in flags})

    def stage_costs(self, mpc: MPC, columns: Columns) -> Array:
        """Lhat of transitions, ``(n,)``: of the states that the logged costs are of."""
        s = columns.next_observations if self.reached else columns.observations
        return mpc.stage_costs(s, columns.actions)

    def of_state(self, mpc: MPC, s: Array) -> Array:
        """What T has to hold besides V at states ``(n, nx)``, ``(n,)``; zero where costs are of s.

        Costs of s+ are, along a plan, those of s but for the first, which no input changes, and the last, which is
        missing: ``sum_k Lhat(x_k+1,u_k) = sum_k Lhat(x_k,u_k) + Lx(x_N) - Lx(x_0)`` with Lx the part of Lhat that
        depends on the state, its value at inputs of zero: exact where states and inputs are not multiplied in Lhat.
        """
        if not self.reached:
            return np.zeros(len(s))
        return mpc.stage_costs(s, np.zeros((len(s), mpc.nu)))

    def __str__(self) -> str:
        """The relation, in words."""
        if self.constant:
            return "L is the same in all transitions that do not end an episode"
        relation = "Lhat" if self.scale == 1.0 else f"{self.scale:.4g} Lhat"
        if self.regressed:
            relation = "a quadratic with norms"
        of = " of the state reached" if self.reached else ""
        offset = f" {self.offset:+.3g}" if self.offset else ""
        where = "" if self.agreeing == 1.0 else f" in {self.agreeing:.0%} of the transitions"
        return f"L = {relation}{of}{offset}{where}, up to {self.missed:.1g} of Var[L]"


@dataclass(frozen=True)
class Known:
    """What is known between two stages of a fit.

    Attributes:
        mpc: The MPC with what is learned of it so far.
        table: The transitions, without what was taken out of them so far.
        groups: The parameter groups that are learned, ``("cost",)`` or ``("cost", "model")``.
        seed: Seeds everything.
        device: Torch device for what is large.
        value_function: V_phi, given or learned; None before.
        cost: How the logged costs follow from the MPC's stage cost, which then is not learned; None where it is.
        limits: What the soft limits cost in logged costs, of which the table's do not contain it; None where nothing is
            soft.
        model_error: What the model misses in one step, as share of an increment (root mean square); None where it was
            not identified.
        residual_share: The share of what the identified model missed that a learned residual explains; None where the
            model has none.
        result: What the fit found; the last stage leaves one.
        given: MPC_1, of which the method may have changed horizon and discount.
        found: What identification found; None where the model was not identified.
        start: An MPC that was learned before, where searches begin, too; None without.
        begun: The first transitions of episodes as they were logged; None where no past inputs are in the state.
        shards: All transitions, where the table is an excerpt of them: what minibatches are drawn from.
        distilled: Where the terminal cost is V and nothing else: where its quadratic has its minimum, and itself.
    """

    mpc: MPC
    table: TransitionTable
    groups: tuple[str, ...] = ("cost", "model")
    seed: int = 0
    device: str = "cpu"
    value_function: ValueFunction | None = None
    cost: KnownCost | None = None
    limits: LimitCosts | None = None
    model_error: float | None = None
    residual_share: float | None = None
    result: FitResult | None = None
    given: MPC | None = None
    found: Identification | None = None
    start: MPC | None = None
    begun: TransitionTable | None = None
    shards: ShardedTable | None = None
    distilled: tuple[Array, TerminalCost] | None = None

    def with_rows(self, change: RowChange) -> Known:
        """The same with something done to the transitions, in memory and in shards.

        Args:
            change: From some consecutive rows to what is learned of them.
        """
        shards = None if self.shards is None else self.shards.mapped(change)
        return replace(self, table=change(self.table), shards=shards)

    def once(self, name: str, find: Callable[[], T]) -> T:
        """What is found from this alone, when it is first asked for; kept with it, not with what replaces it.

        Args:
            name: The same for the same thing.
            find: Finds it.
        """
        kept: dict[str, T] = self.__dict__.setdefault("_kept", {})
        if name not in kept:
            kept[name] = find()
        return kept[name]

    @property
    def constant_value(self) -> ValueFunction:
        """V_phi as a constant on the CPU, a copy.

        Raises:
            InvalidArgumentError: If no stage before has learned one.
        """
        if self.value_function is None:
            raise InvalidArgumentError("stages", expected="one that learns V before this one", actual="none")
        return copy.deepcopy(self.value_function).cpu().eval().requires_grad_(False)


class Training(Protocol):
    """Something learned in steps, which can stop between any two of them, be saved, and go on.

    Attributes:
        step: Steps made; it may fall where a training starts again.
        n_steps: Steps in all.
    """

    step: int
    n_steps: int

    @property
    def done(self) -> bool:
        """Whether no step is left to make."""

    @property
    def result(self) -> Any:
        """What is learned, if it ends now."""

    def advance(self, n: int) -> Metrics:
        """Makes n more steps, fewer at the end; returns means over them, by name."""

    def to_arrays(self) -> Arrays:
        """What :meth:`restore` needs to go on bit for bit."""

    def restore(self, arrays: Arrays) -> None:
        """Goes on from a state of :meth:`to_arrays` of a training with the same arguments.

        Raises:
            FileFormatError: If arrays are missing or of another problem.
        """


class Stage(ABC):
    """A stretch of a fit that takes steps: a training that begins with what is known, and what becomes of its result.

    Attributes:
        phase: What it does, for people.
        epoch: Steps between two entries of the history.
    """

    phase: str = ""
    epoch: int = 100

    @abstractmethod
    def begin(self, known: Known) -> Training | None:
        """The training; None where nothing is left to learn."""

    @abstractmethod
    def outcome(self, known: Known, training: Training) -> Known:
        """What is known if the training ends now; ``known`` is what it began with."""


#: A stretch of a fit without steps: from what is known to what is known then. Where no later stage takes steps, it is
#: also taken at the end of an epoch, to find the MPC that would be handed out if the fit ended there.
Change = Callable[[Known], Known]
