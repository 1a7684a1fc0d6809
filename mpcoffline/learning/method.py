"""Learning methods: their options, by stage, and the door through which others add theirs."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from typing import Any, Self, cast

import numpy as np

from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.core.registry import Registry
from mpcoffline.mpc import MPC, QuadraticCost

from .linear_quadratic import is_linear_quadratic
from .stages import Change, Known, Stage

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Method(ABC):
    """How an MPC is learned: everything that a fit depends on besides data and seed, and the stages that do it.

    A subclass is a frozen dataclass, of which an instance without arguments exists. Its fields that are dataclasses
    themselves are the options of the stage of that name.

    Example:
        >>> @METHODS.register("mine")
        ... @dataclass(frozen=True)
        ... class Mine(Method):
        ...     fit: MyConfig = field(default_factory=MyConfig)
        ...
        ...     def stages(self) -> dict[str, Stage | Change]:
        ...         return {"fit": MyStage(self.fit)}
        >>> OfflineMPCLearner(mpc, method="mine")

    Attributes:
        trim: Share of the transitions that is learned from; the farthest out are left out.
        discount: gamma of V and of the learned MPC; None keeps the given MPC's.
        least_discount: Where ``discount`` is None and the given MPC's is smaller, this is taken: a small discount hides
            goals that are far. A linear-quadratic MPC, which sees any distance, keeps its own.
        horizon: N of the learned MPC; None keeps the given one's, or what ``least_horizon`` makes of it.
        least_horizon: Where ``horizon`` is None, a horizon that leaves more to V, and is faster: this one at
            ``least_discount``, and where the discount is larger as many steps as it takes for gamma^N to fall as low,
            but no more than the given MPC has.
        cross_term: Whether the quadratic stage cost gets a cross term S.
    """

    trim: float = 0.9
    discount: float | None = None
    least_discount: float = 0.0
    horizon: int | None = None
    least_horizon: int | None = None
    cross_term: bool = False

    def __post_init__(self) -> None:
        check_number("trim", self.trim, 0.0, 1.0)
        if self.discount is not None:
            check_number("discount", self.discount, 0.0, 1.0)
        check_number("least_discount", self.least_discount, 0.0, 1.0, open_low=False)
        if self.horizon is not None:
            check_integers(1, horizon=self.horizon)
        if self.least_horizon is not None:
            check_integers(1, least_horizon=self.least_horizon)

    @abstractmethod
    def stages(self) -> dict[str, Stage | Change]:
        """The stages by name, in their order; one without steps is a function from ``Known`` to ``Known``."""

    def prepared(self, known: Known) -> Known:
        """What the stages begin with, found from all transitions; by default what is known already."""
        return known

    def foreseen(self, known: Known) -> list[MPC]:
        """MPCs of the form that what is tried at the end will have, whatever its numbers; by default none.

        Their solvers are compiled while the regressions run.

        Args:
            known: What is known before the first stage that takes steps.
        """
        return []

    def candidates(self, known: Known) -> dict[str, MPC]:
        """MPCs that the fit knows by the way and that may do better than the whole of it; by default none.

        Args:
            known: What is known at the end of the fit.
        """
        return {}

    def variants(self, known: Known, mpcs: Mapping[str, MPC], turn: int) -> dict[str, MPC]:
        """What may be better than some of the candidates and is tried where these are good; by default nothing.

        Args:
            known: What is known at the end of the fit.
            mpcs: The good ones, by name: after few starts the three best (turn 0), after more the best (turn 1).
            turn: Which of the two it is.
        """
        return {}

    @property
    def name(self) -> str:
        """What it is called in calls and files.

        Raises:
            InvalidArgumentError: If it is not registered.
        """
        name = next((name for name, method in METHODS.items() if method is type(self)), None)
        if name is None:
            hint = "Register it: METHODS.register(name) before the class."
            raise InvalidArgumentError("learning method", expected="one with a name", actual=repr(self), hint=hint)
        return name

    @property
    def options(self) -> dict[str, Any]:
        """All options by the names that :meth:`replaced` takes."""
        return {
            name: getattr(getattr(self, stage) if stage else self, field)
            for name, (stage, field) in self._homes().items()
        }

    def replaced(self, options: Mapping[str, Any]) -> Self:
        """The method with options replaced by name, of which each has one.

        A stage's ``method`` goes by the name of the stage (``value="td"``), a field that two stages have by that of
        stage and field (``fit_n_steps=300``), any other by its own (``tau=0.1``).

        Args:
            options: Values by name, e.g. ``{"trim": 1.0, "tau": 0.1}``.

        Raises:
            UnknownIdError: For a name that is none of these.
            InvalidArgumentError: For a value out of range.
        """
        homes = self._homes()
        changes: dict[str, dict[str, Any]] = {stage: {} for stage, _ in homes.values()}
        for given, value in options.items():
            if given not in homes:
                where = " or ".join(repr(name) for name, other in METHODS.items() if given in other()._homes())
                hint = f"The learning method {where} has it." if where else ""
                raise UnknownIdError.of(f"option of the learning method {type(self).__name__}", given, homes, hint)
            stage, field = homes[given]
            changes[stage][field] = value.item() if isinstance(value, np.generic) else value  # JSON has no numpy
        own = changes.pop("", {})
        return replace(self, **own, **{stage: replace(getattr(self, stage), **part) for stage, part in changes.items()})

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description, by stage; its options may have a ``to_json`` and ``from_json`` of their own."""
        return {field.name: _described(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`; raises what the options raise.

        Raises:
            TypeError: For options of other names.
        """
        kinds = {field.name: type(getattr(cls(), field.name)) for field in fields(cls)}
        return cls(**{name: _rebuilt(kinds.get(name), value) for name, value in data.items()})

    def _homes(self) -> dict[str, tuple[str, str]]:
        """Stage (``""`` for none) and field of each option."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        found = [("", name) for name, part in parts.items() if not is_dataclass(part)]
        found += [(stage, field.name) for stage, part in parts.items() if is_dataclass(part) for field in fields(part)]
        shared = Counter(field for _, field in found)

        def spelled(stage: str, field: str) -> str:
            if stage and field == "method":
                return stage
            return f"{stage}_{field}" if stage and shared[field] > 1 else field

        return {spelled(stage, field): (stage, field) for stage, field in found}

    def restructured(self, nominal: MPC) -> MPC:
        """The MPC with the discount, the horizon and the form of stage cost that the options ask for."""
        least = 0.0 if is_linear_quadratic(nominal) else self.least_discount
        discount = max(nominal.discount, least) if self.discount is None else self.discount
        mpc = nominal.replace(discount=discount, horizon=self._horizon(nominal.horizon, discount))
        cost = nominal.stage_cost
        if self.cross_term and type(cost) is QuadraticCost and cost.nu and "H" not in cost.values:
            values, cross = cost.values, np.zeros((cost.nx, cost.nu))
            constant = float(values["constant"])
            references = values["x_ref"], values["u_ref"]
            D = values.get("D")
            crossed = QuadraticCost(cost.W, cost.R, cross, *references, constant, D=D, tracks=cost.tracks)
            return mpc.replace(stage_cost=crossed)
        if self.cross_term:
            _log.warning("cross_term has no effect on a stage cost that is not quadratic or has one already")
        return mpc

    def _horizon(self, given: int, discount: float) -> int:
        """N of the learned MPC."""
        if self.horizon is not None or self.least_horizon is None:
            return given if self.horizon is None else self.horizon
        if not 0.0 < self.least_discount < discount < 1.0:
            return self.least_horizon if discount < 1.0 else max(given, self.least_horizon)
        alike = self.least_horizon * math.log(self.least_discount) / math.log(discount)
        return max(self.least_horizon, min(given, math.ceil(alike)))


def _described(option: Any) -> Any:
    """An option, or the options of a stage, as JSON."""
    if not is_dataclass(option):
        return option
    to_json = getattr(option, "to_json", None)
    return asdict(cast("Any", option)) if to_json is None else to_json()


def _rebuilt(kind: Any, data: Any) -> Any:
    """The inverse of :func:`_described`."""
    if not isinstance(data, dict):
        return data
    if hasattr(kind, "from_json"):
        return kind.from_json(data)
    return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in data.items()})


#: Add a method of your own by ``@METHODS.register("name")`` before its class; files name it.
METHODS: Registry[type[Method]] = Registry("learning method", Method)
