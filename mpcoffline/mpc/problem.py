"""(MPC): the optimal control problem as data. How it is solved is the business of ``mpcoffline.solvers``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from typing import Any, Literal, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core import limits
from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.limits import check_limit
from mpcoffline.core.types import Array

from .component import StageCost, TerminalCost, cost_from_json, vector
from .constraints import (
    Constraint,
    Constraints,
    Sizes,
    StateBounds,
    constraints_from_json,
    constraints_to_json,
    finite_or_none,
    fitted_constraints,
)
from .expression_cost import cost_to_json
from .expressions import scalar, traced
from .layout import Layout
from .model import Model
from .parameters import Group, ParameterSpace
from .rest import at_rest, extreme_inputs
from .row_twin import row_function
from .seen import stage_expression, terminal_expression
from .shown import html_of_mpc, text_of_mpc


@dataclass(frozen=True, eq=False)
class MPC:
    """The problem (MPC) of arXiv:2301.01667, whose minimum is V_theta and whose first input is the policy.

    ::

        V_th(s) = min_{x,u}  gamma^N T_th(x_N) + sum_{k<N} gamma^k Lhat_th(x_k, u_k)
                  s.t.  x_0 = s,   x_{k+1} = f_th(x_k, u_k),   h_th(x_k, u_k) <= 0,   low <= u_k <= high

    An MPC is immutable; :meth:`with_theta` and :meth:`replace` make new ones.

    Where inputs act with dead time, or their changes have a price, the state x of this problem is z = [y, past inputs],
    see :class:`~mpcoffline.mpc.layout.Layout` and :meth:`state`; else it is the observation y. Costs and constraints
    are functions of y all the same; only a cost whose ``nx`` is the size of z gets z.

    Args:
        model: The prediction model f_theta; it gets the inputs of the step before into its state where the stage cost
            asks for them.
        stage_cost: Lhat_theta, e.g. :class:`QuadraticCost`.
        terminal_cost: T_theta, e.g. :class:`NormCost` or :class:`QuadraticCost`.
        horizon: N, in sampling steps.
        discount: gamma, in (0, 1].
        action_low: Lower bounds of the inputs, ``(nu,)``; ``-inf`` where there are none.
        action_high: Upper bounds, ``(nu,)``.
        constraints: ``(x, u, p) -> h`` with h <= 0 at every stage, a CasADi column, ``p`` as in the model; or a list of
            :class:`Constraint` and :class:`StateBounds`, which are named, may be soft, and may hold at the end only.
        applied_before: Inputs that count as applied before anything is known, ``(nu,)``, where the state holds past
            ones; by default the stage cost's ``u_ref``, else zero, and a learner takes them from the log.

    Raises:
        InvalidArgumentError: For a horizon that is not positive or above 10,000 steps, a discount outside (0, 1],
            bounds that cross or have the wrong shape, or costs and constraints that do not fit the model's dimensions.
    """

    model: Model
    stage_cost: StageCost
    terminal_cost: TerminalCost
    horizon: int
    discount: float
    action_low: ArrayLike
    action_high: ArrayLike
    constraints: Constraints | None = field(default=None, repr=False)
    applied_before: ArrayLike | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        given = self.constraints if isinstance(self.constraints, Sequence) else (self.constraints,)
        before = any(getattr(part, "uses_previous", False) for part in (self.stage_cost, *given))
        if before and min(self.model.layout.carried) < 1:
            object.__setattr__(self, "model", self.model.with_previous())
        check_integers(1, horizon=self.horizon)
        check_limit("horizon", "steps", self.horizon, limits.HORIZON, error=InvalidArgumentError)
        plan = self.horizon * (self.nx + self.nu)
        check_limit("horizon", "numbers in a plan", plan, limits.PLAN_NUMBERS, error=InvalidArgumentError)
        discount = _discount(self.discount)
        low, high = (self._bounds(name) for name in ("action_low", "action_high"))
        if not (low < high).all():
            raise InvalidArgumentError("action_low", expected=f"values below action_high = {high}", actual=str(low))
        checked = {"horizon": int(self.horizon), "discount": discount, "action_low": low, "action_high": high}
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.applied_before is not None:
            object.__setattr__(self, "applied_before", vector("applied_before", self.applied_before, self.nu))
        object.__setattr__(self, "constraints", fitted_constraints(self.constraints, _sizes(self.model)))
        _ = self.stage_function, self.terminal_function  # dimensions are refused here, not at the first solve
        rest, inputs = at_rest(self), extreme_inputs(self)
        inputs = np.hstack([inputs, np.tile(rest[self.layout.present], (len(inputs), 1))])
        object.__setattr__(self, "model", self.model.suited_to(rest[: self.layout.n_states], inputs))

    def _bounds(self, name: str) -> Array:
        bounds = np.atleast_1d(np.array(getattr(self, name), dtype=np.float64))
        if bounds.shape != (self.nu,) or np.isnan(bounds).any():
            raise InvalidArgumentError(name, expected=f"{self.nu} numbers, one an input", actual=str(bounds))
        return bounds

    __repr__ = text_of_mpc
    _repr_html_ = html_of_mpc

    @property
    def nx(self) -> int:
        """Number of states: the size of z."""
        return self.model.nx

    @property
    def ny(self) -> int:
        """Size of an observation."""
        return self.model.ny

    @property
    def layout(self) -> Layout:
        """What z is made of."""
        return self.model.layout

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.model.nu

    @cached_property
    def space(self) -> ParameterSpace:
        """All parameters: ``model.*``, ``stage_cost.*``, ``terminal_cost.*``, in this order."""
        blocks = []
        for prefix, component in self._components().items():
            for block in component.space:
                group: Group = block.group
                if prefix == "terminal_cost" and group == "cost":
                    group = "terminal"
                blocks.append(replace(block, name=f"{prefix}.{block.name}", group=group))
        return ParameterSpace(blocks)

    def _components(self) -> dict[str, Any]:
        return {"model": self.model, "stage_cost": self.stage_cost, "terminal_cost": self.terminal_cost}

    def _part(self, prefix: str, theta: Any) -> Any:
        """The slice of theta (numbers or symbols) that belongs to one component."""
        start = 0
        for name, component in self._components().items():
            if name == prefix:
                return theta[start : start + component.space.size]
            start += component.space.size
        raise KeyError(prefix)

    @property
    def theta(self) -> Array:
        """The current parameters, ``(space.size,)``."""
        return self.space.theta

    @property
    def values(self) -> dict[str, Array]:
        """The current parameters by name in their natural shapes, e.g. ``{"model.m": 1.0, "stage_cost.W": ...}``."""
        return {block.name: block.value for block in self.space}

    @property
    def reference(self) -> Array | None:
        """The plant's state that the stage cost, else the terminal cost, pulls to, ``(n_states,)``, or None.

        Where a cost tracks a signal, that is the distance from it.
        """
        values, n = self.values, self.layout.n_states
        for name in ("stage_cost.x_ref", "terminal_cost.x_ref"):
            if name in values and values[name].shape in ((n,), (self.ny,), (self.nx,)):
                return values[name][:n]
        return None

    @property
    def usual_input(self) -> Array:
        """What counts as applied before anything is known, ``(nu,)``, in bounds: see ``applied_before``."""
        known = self.applied_before
        given = self.values.get("stage_cost.u_ref", np.zeros(self.nu)) if known is None else np.asarray(known)
        return np.clip(given, np.asarray(self.action_low), np.asarray(self.action_high))

    def state(self, y: ArrayLike, past: ArrayLike | None = None) -> Array:
        """The states z ``(..., nx)`` of this problem for observations y ``(..., ny)``.

        Args:
            y: Observations; or the plant's states alone, ``(..., n_states)``, with usual signals.
            past: The memory ``(..., n_memory)`` in the order of ``layout.names``; :attr:`usual_input` by default.

        Raises:
            InvalidArgumentError: For another number of coordinates.
        """
        observations, layout = np.asarray(y, dtype=np.float64), self.layout
        memory = layout.filled(self.usual_input) if past is None else np.asarray(past, dtype=np.float64)
        if layout.signals and observations.shape[-1:] == (layout.n_states,):
            usual = np.broadcast_to(layout.usual_signals, (*observations.shape[:-1], layout.ny - layout.n_states))
            observations = np.concatenate([observations, usual], -1)
        for name, array, size in (("y", observations, layout.ny), ("past", memory, layout.n_memory)):
            if array.ndim < 1 or array.shape[-1] != size:
                raise InvalidArgumentError(name, expected=f"shape (..., {size})", actual=f"shape {array.shape}")
        return np.concatenate([observations, np.broadcast_to(memory, (*observations.shape[:-1], layout.n_memory))], -1)

    def with_theta(self, theta: ArrayLike) -> MPC:
        """The same problem with other parameters, theta ``(space.size,)``.

        Raises:
            InvalidArgumentError: If theta has the wrong shape, is not finite or out of bounds.
        """
        checked = self.space.checked(theta)
        parts = {
            name: component.with_theta(self._part(name, checked)) for name, component in self._components().items()
        }
        return replace(self, **parts)

    def with_values(self, values: Mapping[str, ArrayLike]) -> MPC:
        """The same problem with some parameters replaced by name, e.g. ``{"model.m": 1.2}``; see :attr:`values`.

        Raises:
            UnknownIdError: For a name that no parameter has.
            InvalidArgumentError: For a wrong shape, a matrix that is not PSD, or a value out of bounds.
        """
        return self.with_theta(self.space.pack(values))

    def theta_along(self, values: Mapping[str, ArrayLike]) -> Array:
        """One theta a stage, for time-varying references, prices, weights or models.

        Args:
            values: By parameter name, one value a stage in its natural shape: ``(N, *shape)``, or ``(N + 1, *shape)``.
                Stage N is the terminal cost's; where it is not given, the last value is held. A value without leading
                dimension is constant.

        Returns:
            Theta ``(1, N + 1, size)`` for ``solve(..., theta=...)``; all other parameters are those of this problem.

        Raises:
            UnknownIdError: For a name that no parameter has.
            InvalidArgumentError: For a wrong shape, a matrix that is not PSD, or a value out of bounds.
        """
        return self.space.along(values, self.horizon)[None]

    def with_delay(self, delay: int | Sequence[int] | None) -> Self:
        """The same problem with another dead time, see :class:`Model`.

        Raises:
            InvalidArgumentError: For a negative delay, one of another length, or costs of another state than then.
        """
        return replace(self, model=self.model.with_delay(delay))

    def replace(self, **changes: Any) -> Self:
        """The same problem with other fields, e.g. ``mpc.replace(horizon=20, discount=0.95)``."""
        return replace(self, **changes)

    @cached_property
    def dynamics_function(self) -> ca.Function:
        """f_theta as CasADi function ``(x, u, theta) -> x_next``."""
        x, u, theta = self._symbols()
        reached = self.model.expression(x, u, self._part("model", theta))
        return ca.Function("f", [x, u, theta], [reached], ["x", "u", "theta"], ["x_next"])

    @cached_property
    def plant_function(self) -> ca.Function:
        """The plant's map ``(x, u, theta) -> x_next`` without dead time; ``dynamics_function`` where z is x."""
        if self.layout.is_plain:
            return self.dynamics_function
        layout, theta = self.layout, self._symbols()[2]
        x, u = ca.SX.sym("x", layout.n_states), ca.SX.sym("u", len(layout.acting))
        reached = self.model.plant(x, u, self._part("model", theta))
        return ca.Function("plant", [x, u, theta], [reached], ["x", "u", "theta"], ["x_next"])

    @cached_property
    def stage_function(self) -> ca.Function:
        """Lhat_theta as CasADi function ``(x, u, theta) -> cost``."""
        x, u, theta = self._symbols()
        p = self.stage_cost.space.symbols(self._part("stage_cost", theta))
        cost = scalar("stage_cost", lambda: stage_expression(self.layout, self.stage_cost, x, u, p), self.ny, self.nu)
        return traced("stage_cost", ca.Function("stage_cost", [x, u, theta], [cost], ["x", "u", "theta"], ["cost"]))

    def stage_costs(self, x: Array, u: Array) -> Array:
        """Lhat at states ``(B, nx)`` and inputs ``(B, nu)``, ``(B,)``, undiscounted: faster than one by one."""
        return np.asarray(self._stage_rows(x, u, self.theta)[:, 0])

    @cached_property
    def _stage_rows(self) -> Callable[..., Array]:
        return row_function(self.stage_function)

    @cached_property
    def terminal_function(self) -> ca.Function:
        """T_theta as CasADi function ``(x, theta) -> cost``."""
        x, _, theta = self._symbols()
        p = self.terminal_cost.space.symbols(self._part("terminal_cost", theta))
        layout, own = self.layout, self.terminal_cost
        cost = scalar("terminal_cost", lambda: terminal_expression(layout, own, x, p), self.ny, self.nu)
        return traced("terminal_cost", ca.Function("terminal_cost", [x, theta], [cost], ["x", "theta"], ["cost"]))

    @cached_property
    def constraint_function(self) -> ca.Function | None:
        """h_theta, the hard constraints of the stages 0 ... N - 1, as CasADi ``(x, u, theta) -> h``, or None."""
        hard = [self.constraint_expression(c) for c in self.constraints_at("stages") if c.soft is None]
        if not hard:
            return None
        x, u, theta = self._symbols()
        h = ca.vertcat(*(expression(x, u, theta) for expression in hard))
        return ca.Function("h", [x, u, theta], [h], ["x", "u", "theta"], ["h"])

    def constraints_at(self, place: Literal["stages", "end"]) -> list[Constraint]:
        """The constraints of the stages 0 ... N - 1, or of the end; state bounds are in neither."""
        return [c for c in self._constraints if isinstance(c, Constraint) and c.terminal == (place == "end")]

    @property
    def state_bounds(self) -> list[StateBounds]:
        """The bounds of x_1 ... x_N, or without ``at_end`` of x_0 ... x_{N-1}, on z; what they are not of has none."""
        return [c.padded(self.nx - np.size(c.low)) for c in self._constraints if isinstance(c, StateBounds)]

    @property
    def _constraints(self) -> tuple[Constraint | StateBounds, ...]:
        return self.constraints if isinstance(self.constraints, tuple) else ()

    def constraint_expression(self, constraint: Constraint) -> Callable[..., ca.SX]:
        """One of the constraints as ``(x, u, theta) -> h``, or ``(x, theta) -> h`` at the end."""
        ny, before = self.ny, self.layout.previous.tolist() if constraint.uses_previous else []

        def expression(x: ca.SX, *others: ca.SX) -> ca.SX:
            previous = [x[before]] if constraint.uses_previous else []
            return constraint.function(x[:ny], *others[:-1], *previous, self._part("model", others[-1]))

        return expression

    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        size = sum(component.space.size for component in self._components().values())
        return ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu), ca.SX.sym("theta", size)

    def to_json(self, *, portable: bool = False) -> dict[str, Any]:
        """A JSON-able description from which :meth:`from_json` rebuilds the problem.

        Costs of a class in ``mpcoffline.mpc.COSTS`` are written as their class says, others by their expression;
        likewise constraints, in ``mpcoffline.mpc.CONSTRAINTS``.

        Args:
            portable: Whether classes from outside this package are written by their expression, too: then whoever
                reads it, as another process, need not import them.

        Raises:
            InvalidArgumentError: For a function that is no plain arithmetic.
        """
        return {
            "model": self.model.to_json(),
            "stage_cost": cost_to_json(self.stage_cost, self.layout, stage=True, portable=portable),
            "terminal_cost": cost_to_json(self.terminal_cost, self.layout, stage=False, portable=portable),
            "horizon": self.horizon,
            "discount": self.discount,
            "action_low": finite_or_none(np.asarray(self.action_low)),
            "action_high": finite_or_none(np.asarray(self.action_high)),
            "constraints": constraints_to_json(self._constraints, portable=portable) or None,
            **({} if self.applied_before is None else {"applied_before": np.asarray(self.applied_before).tolist()}),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> MPC:
        """The inverse of ``to_json``.

        Raises:
            FileFormatError: If something is missing or damaged.
        """
        try:
            model = Model.from_json(data["model"])
            return cls(
                model=model,
                stage_cost=cost_from_json(data["stage_cost"]),
                terminal_cost=cost_from_json(data["terminal_cost"]),
                horizon=data["horizon"],
                discount=data["discount"],
                action_low=[-np.inf if v is None else v for v in data["action_low"]],
                action_high=[np.inf if v is None else v for v in data["action_high"]],
                constraints=constraints_from_json(data["constraints"], _sizes(model)),
                applied_before=data.get("applied_before"),
            )
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError("MPC", expected="the JSON form of an MPC", actual=repr(error)) from error


def _sizes(model: Model) -> Sizes:
    return Sizes(model.ny, model.nu, model.space, model.layout.n_states, model.layout)


def _discount(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, Real) or not 0.0 < float(value) <= 1.0:
        raise InvalidArgumentError("discount", expected="a number in (0, 1]", actual=repr(value))
    return float(value)
