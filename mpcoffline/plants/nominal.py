"""MPC_1 of each registered plant: the nominal controller that learning starts from (arXiv:2301.01667)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from mpcoffline.core.checks import check_integers, check_known
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.envs import PLANTS, Plant
from mpcoffline.envs.episode import DISCOUNT
from mpcoffline.mpc import MPC, Label, Labels, Model, NormCost, Parameter, QuadraticCost


def nominal_mpc(env_id: str, alpha: float = 0.0, seed: int | None = None) -> MPC:
    """The MPC that an engineer would start from: an inaccurate model and the nominal cost (MPC_1).

    The MPC's state is the environment's observation y, so that no angle wraps. The swing-up models integrate the
    equations of motion in y = [..., cos phi, sin phi, ...] (cos' = -phid sin, sin' = phid cos) with RK4, which needs no
    trigonometry and stays smooth off the unit circle. With true parameters one step differs from the environment's,
    which integrates the angle, by no more than this in any entry of y (rotation: about (phid dt)^5/120; phid: more)::

        |phid| up to            5        10        14  rad/s
        pendulum           0.0001     0.001     0.003
        cart-pole          0.0005     0.005     0.03   (cart speeds up to 5 m/s)

    The linear model of alpha = 0 is the plant's up to rounding.

    Args:
        env_id: Gymnasium id of a registered plant, e.g. ``"mpcoffline/PendulumSwingUp-v0"``.
        alpha: Size of the model error: each parameter that has a spread is off by alpha times a uniform draw. Plants
            without take none; there alpha changes the plant, and the model is that of alpha = 0.
        seed: Seeds the draws; one draw a parameter, so that the same seed scales with alpha.

    Returns:
        The nominal MPC with the plant's horizon, discount 0.9 and terminal cost (TERM).

    Raises:
        UnknownIdError: For an environment of no registered plant.
        InvalidArgumentError: For an alpha with which a parameter could vanish, an alpha for a plant that takes none,
            or a negative seed.
    """
    by_id = {plant.id: plant for plant in PLANTS.values()}
    name = env_id.removeprefix("mpcoffline:") if isinstance(env_id, str) else env_id
    check_known("environment id", name, by_id)
    plant = by_id[name]
    if seed is not None:
        check_integers(0, seed=seed)
    cost = plant.nominal
    target = np.array(plant.lift([0.0] * len(plant.states), np.cos, np.sin))
    return MPC(
        model=Model(
            _dynamics(plant),
            nx=len(plant.observations),
            nu=len(plant.inputs),
            dt=plant.dt,
            parameters=_parameters(plant, alpha, seed),
            discrete=plant.discrete,
            integrator="auto" if plant.discrete else "rk4",  # the plant's own step
            labels=Labels(
                tuple(Label(*entry) for entry in plant.entries), tuple(Label(c.name, c.unit) for c in plant.inputs)
            ),
        ),
        stage_cost=QuadraticCost(
            np.diag(cost.weights), np.diag(cost.input_weights), x_ref=target, u_ref=cost.input_target
        ),
        terminal_cost=NormCost(target),
        horizon=cost.horizon,
        discount=DISCOUNT,
        action_low=[c.low for c in plant.inputs],
        action_high=[c.high for c in plant.inputs],
    )


def _dynamics(plant: Plant) -> Callable[[ca.SX, ca.SX, dict[str, ca.SX]], ca.SX]:
    """The plant's equations in the observation y, with the parameters that MPC_1 knows as numbers."""
    known = {p.name: p.value for p in plant.parameters if p.spread is None}

    def ode(y: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        entries = ca.vertsplit(y)
        rates = plant.dynamics(entries, ca.vertsplit(u), known | p)
        column: ca.SX = ca.vertcat(*plant.lifted_rates(entries, rates))
        return column

    return ode


def _parameters(plant: Plant, alpha: float, seed: int | None) -> dict[str, Parameter]:
    """The parameters with their errors; learning may move each from 1/100 to 100 times the plant's value."""
    learned = [(p, np.asarray(p.value, np.float64)) for p in plant.parameters if p.spread is not None]
    spread = [(p.spread, np.abs(value[value != 0.0])) for p, value in learned if p.spread]
    limit = min((float(size.min(initial=np.inf)) / width for width, size in spread), default=0.0)
    if not spread and alpha != 0.0:
        hint = f"Give alpha to the environment: gym.make({plant.id!r}, alpha=...)." if plant.max_alpha else ""
        expected = f"none for the {plant.name} task, whose nominal model is fixed"
        raise InvalidArgumentError("alpha", expected=expected, actual=str(alpha), hint=hint)
    if spread and not 0.0 <= alpha < limit:
        raise InvalidArgumentError(
            "alpha",
            expected=f"a number from 0 to below {limit:g}, so that no parameter can vanish",
            actual=str(alpha),
        )
    draws = np.random.default_rng(seed).uniform(-1.0, 1.0, size=len(learned))
    parameters = {}
    for (p, true), draw in zip(learned, draws, strict=True):
        value = true + alpha * p.spread * draw if p.spread else true
        parameters[p.name] = Parameter(value, unit=p.unit, **(_bounds(true, value) if p.spread else {}))
    return parameters


def _bounds(true: Array, value: Array) -> dict[str, Any]:
    """From 1/100 to 100 times a number of either sign, and to where MPC_1 begins; a zero has no size, and no bounds."""
    ends = 0.01 * true, 100.0 * true
    low, high = np.minimum(np.minimum(*ends), value), np.maximum(np.maximum(*ends), value)
    return {"low": np.where(true == 0.0, -np.inf, low), "high": np.where(true == 0.0, np.inf, high)}
