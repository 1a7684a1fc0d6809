"""(MPC): the optimal control problem as data. How it is solved is the business of ``mpcoffline.solvers``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Integral, Real
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.errors import FileFormatError, InvalidArgumentError

from .component import StageCost, TerminalCost
from .cost import cost_from_json
from .expressions import function_from_json, function_to_json, traced
from .model import Model
from .parameters import Array, Group, ParameterSpace

Constraints = Callable[[ca.SX, ca.SX, dict[str, ca.SX]], ca.SX]


@dataclass(frozen=True, eq=False)
class MPC:
    """The problem (MPC) of arXiv:2301.01667, whose minimum is V_theta and whose first input is the policy.

    ::

        V_th(s) = min_{x,u}  gamma^N T_th(x_N) + sum_{k<N} gamma^k Lhat_th(x_k, u_k)
                  s.t.  x_0 = s,   x_{k+1} = f_th(x_k, u_k),   h_th(x_k, u_k) <= 0,   low <= u_k <= high

    An MPC is immutable; :meth:`with_theta` and :meth:`replace` make new ones.

    Args:
        model: The prediction model f_theta.
        stage_cost: Lhat_theta, e.g. :class:`QuadraticCost`.
        terminal_cost: T_theta, e.g. :class:`NormCost` or :class:`QuadraticCost`.
        horizon: N, in sampling steps.
        discount: gamma, in (0, 1].
        action_low: Lower bounds of the inputs, ``(nu,)``; ``-inf`` where there are none.
        action_high: Upper bounds, ``(nu,)``.
        constraints: ``(x, u, p) -> h`` with h <= 0 at every stage, a CasADi column; ``p`` as in the model.

    Raises:
        InvalidArgumentError: For a non-positive horizon, a discount outside (0, 1], bounds that cross or have the wrong
            shape, or costs that do not fit the model's dimensions.
    """

    model: Model
    stage_cost: StageCost
    terminal_cost: TerminalCost
    horizon: int
    discount: float
    action_low: ArrayLike
    action_high: ArrayLike
    constraints: Constraints | ca.Function | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        horizon, discount = _positive_integer("horizon", self.horizon), _discount(self.discount)
        low, high = (self._bounds(name) for name in ("action_low", "action_high"))
        if not (low < high).all():
            raise InvalidArgumentError("action_low", expected=f"values below action_high = {high}", actual=str(low))
        object.__setattr__(self, "horizon", horizon)
        object.__setattr__(self, "discount", discount)
        object.__setattr__(self, "action_low", low)
        object.__setattr__(self, "action_high", high)
        object.__setattr__(self, "constraints", self._constraint_function())
        _ = self.stage_function, self.terminal_function  # dimensions are refused here, not at the first solve

    def _bounds(self, name: str) -> Array:
        bounds = np.atleast_1d(np.array(getattr(self, name), dtype=np.float64))
        if bounds.shape != (self.nu,) or np.isnan(bounds).any():
            raise InvalidArgumentError(name, expected=f"{self.nu} numbers, one an input", actual=str(bounds))
        return bounds

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.model.nx

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
    def stage_function(self) -> ca.Function:
        """Lhat_theta as CasADi function ``(x, u, theta) -> cost``."""
        x, u, theta = self._symbols()
        p = self.stage_cost.space.symbols(self._part("stage_cost", theta))
        cost = _scalar("stage_cost", lambda: self.stage_cost.expression(x, u, p), self.nx, self.nu)
        return traced("stage_cost", ca.Function("stage_cost", [x, u, theta], [cost], ["x", "u", "theta"], ["cost"]))

    @cached_property
    def terminal_function(self) -> ca.Function:
        """T_theta as CasADi function ``(x, theta) -> cost``."""
        x, _, theta = self._symbols()
        p = self.terminal_cost.space.symbols(self._part("terminal_cost", theta))
        cost = _scalar("terminal_cost", lambda: self.terminal_cost.terminal_expression(x, p), self.nx, self.nu)
        return traced("terminal_cost", ca.Function("terminal_cost", [x, theta], [cost], ["x", "theta"], ["cost"]))

    @cached_property
    def constraint_function(self) -> ca.Function | None:
        """h_theta as CasADi function ``(x, u, theta) -> h``, or None."""
        if self.constraints is None:
            return None
        x, u, theta = self._symbols()
        h = self.constraints(x, u, self._part("model", theta))
        return ca.Function("h", [x, u, theta], [h], ["x", "u", "theta"], ["h"])

    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        size = sum(component.space.size for component in self._components().values())
        return ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu), ca.SX.sym("theta", size)

    def _constraint_function(self) -> ca.Function | None:
        """The user's callable as a CasADi function of (x, u, flat model parameters)."""
        if self.constraints is None or isinstance(self.constraints, ca.Function):
            return self.constraints
        x, u, p = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu), ca.SX.sym("p", self.model.space.size)
        try:
            h = ca.densify(ca.SX(self.constraints(x, u, self.model.space.symbols(p))))
        except (TypeError, NotImplementedError, RuntimeError) as error:
            raise InvalidArgumentError(
                "constraints",
                expected="a function of CasADi SX expressions",
                actual=f"{type(error).__name__}: {error}",
            ) from error
        if h.shape[1] != 1:
            raise InvalidArgumentError("constraints", expected="a column", actual=f"shape {h.shape}")
        return traced("constraints", ca.Function("constraints", [x, u, p], [h]))

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description from which :meth:`from_json` rebuilds the problem."""
        constraints = self.constraints
        return {name: component.to_json() for name, component in self._components().items()} | {
            "horizon": self.horizon,
            "discount": self.discount,
            "action_low": [_finite_or_none(v) for v in np.asarray(self.action_low)],
            "action_high": [_finite_or_none(v) for v in np.asarray(self.action_high)],
            "constraints": function_to_json(constraints) if isinstance(constraints, ca.Function) else None,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> MPC:
        """The inverse of :meth:`to_json`.

        Raises:
            FileFormatError: If something is missing or damaged.
        """
        try:
            model = Model.from_json(data["model"])
            constraints = None
            if data["constraints"] is not None:
                sizes = (model.nx, model.nu, model.space.size)
                constraints = function_from_json(data["constraints"], "constraints", inputs=sizes)
            return cls(
                model=model,
                stage_cost=cost_from_json(data["stage_cost"]),
                terminal_cost=cost_from_json(data["terminal_cost"]),
                horizon=data["horizon"],
                discount=data["discount"],
                action_low=[-np.inf if v is None else v for v in data["action_low"]],
                action_high=[np.inf if v is None else v for v in data["action_high"]],
                constraints=constraints,
            )
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError("MPC", expected="the JSON form of an MPC", actual=repr(error)) from error


def _positive_integer(name: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < 1:
        raise InvalidArgumentError(name, expected="a positive integer", actual=repr(value))
    return int(value)


def _discount(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, Real) or not 0.0 < float(value) <= 1.0:
        raise InvalidArgumentError("discount", expected="a number in (0, 1]", actual=repr(value))
    return float(value)


def _finite_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _scalar(name: str, expression: Callable[[], ca.SX], nx: int, nu: int) -> ca.SX:
    """Evaluates a cost expression, turning CasADi's dimension errors into one that says what is expected."""
    try:
        cost = ca.densify(ca.SX(expression()))
    except (InvalidArgumentError, RuntimeError) as error:
        raise InvalidArgumentError(
            name, expected=f"a cost for nx = {nx}, nu = {nu}", actual=str(error).splitlines()[-1]
        ) from error
    if cost.shape != (1, 1):
        raise InvalidArgumentError(name, expected="a scalar", actual=f"shape {cost.shape}")
    return cost
