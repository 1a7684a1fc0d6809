"""MPC_1 of each registered task: the nominal controller that learning starts from (arXiv:2301.01667)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import casadi as ca
import numpy as np

from mpcoffline.core.checks import check_integers, check_known
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.envs import cartpole_swing_up as cartpole
from mpcoffline.envs import linear_tracking as linear
from mpcoffline.envs import pendulum_swing_up as pendulum
from mpcoffline.envs.episode import DISCOUNT
from mpcoffline.mpc import MPC, Model, NormCost, Parameter, QuadraticCost


class PhysicalParameter(NamedTuple):
    """A parameter of a swing-up model: the plant's value, and the half-width of its error at alpha = 1."""

    name: str
    true: float
    spread: float
    unit: str


PENDULUM_PARAMETERS = (
    PhysicalParameter("m", pendulum.MASS, 0.5, "kg"),
    PhysicalParameter("l", pendulum.LENGTH, 0.5, "m"),
)
CARTPOLE_PARAMETERS = (
    PhysicalParameter("m_c", cartpole.CART_MASS, 0.1, "kg"),
    PhysicalParameter("mu", cartpole.FRICTION, 0.25, "N s/m"),
    PhysicalParameter("m_p", cartpole.POLE_MASS, 0.1, "kg"),
    PhysicalParameter("l", cartpole.HALF_LENGTH, 0.25, "m"),
)


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
        env_id: ``"mpcoffline/LinearTracking-v0"``, ``"mpcoffline/PendulumSwingUp-v0"`` or
            ``"mpcoffline/CartPoleSwingUp-v0"``.
        alpha: Size of the model error in the swing-up tasks: each parameter is off by alpha times a uniform draw.
            The linear task takes none: there alpha changes the plant, and the model is that of alpha = 0.
        seed: Seeds the draws; one draw a parameter, so that the same seed scales with alpha.

    Returns:
        The nominal MPC with the paper's horizon (100 linear, 50 otherwise), discount 0.9 and terminal cost (TERM).

    Raises:
        UnknownIdError: For an environment that is none of the three.
        InvalidArgumentError: For an alpha that can make a mass or length non-positive, an alpha for the linear task,
            or a negative seed.
    """
    builders: dict[str, Callable[[float, int | None], MPC]] = {
        "mpcoffline/LinearTracking-v0": _linear,
        "mpcoffline/PendulumSwingUp-v0": _pendulum,
        "mpcoffline/CartPoleSwingUp-v0": _cartpole,
    }
    name = env_id.removeprefix("mpcoffline:") if isinstance(env_id, str) else env_id
    check_known("environment id", name, builders)
    if seed is not None:
        check_integers(0, seed=seed)
    return builders[name](alpha, seed)


def _linear(alpha: float, seed: int | None) -> MPC:
    if alpha != 0.0:
        raise InvalidArgumentError(
            "alpha",
            expected="none for the linear task, whose nominal model is fixed",
            actual=str(alpha),
            hint="Give alpha to the environment: gym.make('mpcoffline/LinearTracking-v0', alpha=...).",
        )
    model = Model(
        lambda x, u, p: p["A"] @ x + p["B"] @ u,
        nx=4,
        nu=2,
        dt=linear.LinearTrackingEnv.dt,
        parameters={"A": linear.A0, "B": linear.B0},
        discrete=True,
    )
    return MPC(
        model=model,
        stage_cost=QuadraticCost(linear.STATE_WEIGHT, linear.ACTION_WEIGHT),
        terminal_cost=NormCost(np.zeros(4)),
        horizon=100,
        discount=DISCOUNT,
        action_low=[-linear.MAX_FORCE] * 2,
        action_high=[linear.MAX_FORCE] * 2,
    )


def _pendulum(alpha: float, seed: int | None) -> MPC:
    def ode(y: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        cos, sin, phid = y[0], y[1], y[2]
        phidd = 1.5 * pendulum.GRAVITY / p["l"] * sin + 3.0 / (p["m"] * p["l"] ** 2) * u
        return ca.vertcat(-phid * sin, phid * cos, phidd)

    reference = [1.0, 0.0, 0.0]
    return MPC(
        model=Model(ode, 3, 1, pendulum.PendulumSwingUpEnv.dt, _perturbed(PENDULUM_PARAMETERS, alpha, seed)),
        stage_cost=QuadraticCost(np.diag([1.0, 1.0, 0.1]), [[0.1]], x_ref=reference),
        terminal_cost=NormCost(reference),
        horizon=50,
        discount=DISCOUNT,
        action_low=[-pendulum.MAX_TORQUE],
        action_high=[pendulum.MAX_TORQUE],
    )


def _cartpole(alpha: float, seed: int | None) -> MPC:
    def ode(y: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        xd, cos, sin, phid = y[1], y[2], y[3], y[4]
        mass, moment = p["m_c"] + p["m_p"], p["m_p"] * p["l"]
        drive = p["mu"] * xd - u - moment * phid**2 * sin
        # Dividing by |(cos, sin)|^2 changes nothing on the unit circle and keeps the inertia positive off it, where the
        # iterates of an NLP solver wander.
        inertia = p["l"] * (4.0 / 3.0 - p["m_p"] / mass * cos**2 / (cos**2 + sin**2))
        phidd = (cartpole.GRAVITY * sin + cos * drive / mass) / inertia
        xdd = (u - p["mu"] * xd + moment * (phid**2 * sin - phidd * cos)) / mass
        return ca.vertcat(xd, xdd, -phid * sin, phid * cos, phidd)

    reference = [0.0, 0.0, 1.0, 0.0, 0.0]
    return MPC(
        model=Model(ode, 5, 1, cartpole.CartPoleSwingUpEnv.dt, _perturbed(CARTPOLE_PARAMETERS, alpha, seed)),
        stage_cost=QuadraticCost(np.diag([3.0, 0.01, 3.0, 1.0, 0.01]), [[0.001]], x_ref=reference),
        terminal_cost=NormCost(reference),
        horizon=50,
        discount=DISCOUNT,
        action_low=[-cartpole.MAX_FORCE],
        action_high=[cartpole.MAX_FORCE],
    )


def _perturbed(parameters: tuple[PhysicalParameter, ...], alpha: float, seed: int | None) -> dict[str, Parameter]:
    """The parameters with their errors; learning may move each from 1/100 to 100 times the plant's value."""
    limit = min(parameter.true / parameter.spread for parameter in parameters)
    if not 0.0 <= alpha < limit:
        raise InvalidArgumentError(
            "alpha",
            expected=f"a number from 0 to below {limit:g}, so that no mass or length can vanish",
            actual=str(alpha),
        )
    draws = np.random.default_rng(seed).uniform(-1.0, 1.0, size=len(parameters))
    values = [p.true + alpha * p.spread * draw for p, draw in zip(parameters, draws, strict=True)]
    return {
        p.name: Parameter(value, low=min(0.01 * p.true, value), high=100.0 * p.true, unit=p.unit)
        for p, value in zip(parameters, values, strict=True)
    }
