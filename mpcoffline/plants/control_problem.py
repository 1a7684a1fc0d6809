"""MPC_1 of a described plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import (
    MPC,
    Constraint,
    ExpressionCost,
    Model,
    ParameterSpace,
    Penalty,
    QuadraticCost,
    StateBounds,
)
from mpcoffline.mpc.constraints import AnyConstraint
from mpcoffline.mpc.layout import Layout
from mpcoffline.mpc.signals import Named

from .calling import called, number
from .quadratic import quadratic_form
from .quantities import Limit

if TYPE_CHECKING:
    from .description import Plant

Symbols = Mapping[str, ca.SX]


def control_problem(plant: Plant, horizon: int, discount: float) -> MPC:
    """The MPC of a plant's description, see :meth:`mpcoffline.Plant.mpc`."""
    model, low_high = _model(plant), plant.action_bounds
    stage, terminal = _costs(plant, model.layout)
    constraints = [_constraint(plant, limit) for limit in plant.limits] + _rates(plant)
    return MPC(model, stage, terminal, horizon, discount, *low_high, constraints=constraints or None)


def _model(plant: Plant) -> Model:
    def dynamics(x: ca.SX, u: ca.SX, p: Symbols, d: Named) -> ca.SX:
        return plant.rates(ca.vertsplit(x), ca.vertsplit(u), _present(plant, d), p)

    delays = [each.delay for each in plant.inputs]
    return Model(
        dynamics,
        nx=len(plant.states),
        nu=len(plant.inputs),
        dt=plant.dt,
        parameters=dict(plant.parameters),
        discrete=plant.discrete,
        integrator=plant.integrator,
        delay=None if all(delay is None for delay in delays) else [delay or 0 for delay in delays],
        signals=plant.signals,
        labels=plant.labels,
    )


def _costs(plant: Plant, layout: Layout) -> tuple[Any, Any]:
    """Stage and terminal cost."""
    rest = np.array([each.at_rest for each in plant.inputs])
    found = quadratic_form(plant.cost_function, plant.names("signals"), rest)
    if found is not None:
        end = QuadraticCost(found.W, x_ref=found.values["x_ref"], tracks=found.tracks)
        return found, end
    y, u, before, none = (ca.SX.sym(k, n) for k, n in zip("yubp", (layout.ny, layout.nu, layout.nu, 0), strict=True))
    x, d, cost = y[: layout.n_states], y[layout.present.tolist()], plant.cost_function
    inputs = [y, u, before, none] if plant.prices_changes else [y, u, none]
    stage = ca.Function("cost", inputs, [cost(x, u, d, before if plant.prices_changes else u)])
    end_cost = ca.Function("cost", [y, none], [cost(x, rest, d, rest)])
    return ExpressionCost(stage, ParameterSpace([])), ExpressionCost(end_cost, ParameterSpace([]))


def _constraint(plant: Plant, limit: Limit) -> AnyConstraint:
    soft = None
    if limit.soft is not None:
        soft = Penalty(*limit.soft) if isinstance(limit.soft, Sequence) else Penalty(float(limit.soft))
    states, inputs = plant.names("states"), plant.names("inputs")
    if isinstance(limit.of, str) and limit.of in states:
        own = np.array([name == limit.of for name in states])
        return StateBounds(np.where(own, limit.low, -np.inf), np.where(own, limit.high, np.inf), limit.name, soft)
    of: Any = limit.of

    def excess(x: ca.SX, u: ca.SX, p: Symbols, d: Named) -> ca.SX:
        what = f"limit {limit.name!r}"
        if isinstance(of, str):
            value = u[inputs.index(of)]
        else:
            values = plant.values(ca.vertsplit(x)[: len(states)], ca.vertsplit(u), _present(plant, d), p)
            value = number(what, called(what, of, values))
        above = [value - limit.high] if np.isfinite(limit.high) else []
        below = [limit.low - value] if np.isfinite(limit.low) else []
        return ca.vertcat(*above, *below)

    if not plant.signals:
        return Constraint(lambda x, u, p: excess(x, u, p, Named([], ca.SX(0, 1))), limit.name, soft)
    return Constraint(excess, limit.name, soft)


def _rates(plant: Plant) -> list[AnyConstraint]:
    """What inputs may change by in a step, as one hard constraint."""
    limited = [i for i, each in enumerate(plant.inputs) if each.rate is not None]
    most = [float(plant.inputs[i].rate or 0.0) for i in limited]
    if not limited:
        return []

    def excess(x: ca.SX, u: ca.SX, before: ca.SX, p: Symbols) -> ca.SX:
        change = u[limited] - before[limited]
        return ca.vertcat(change - ca.DM(most), -change - ca.DM(most))

    name = "input rates"
    if any(limit.name == name for limit in plant.limits):
        raise InvalidArgumentError("name of a limit", expected="another one than that of the rates", actual=repr(name))
    return [Constraint(excess, name, uses_previous=True)]


def _present(plant: Plant, d: Named) -> list[ca.SX]:
    return [d[signal.name] for signal in plant.signals]
