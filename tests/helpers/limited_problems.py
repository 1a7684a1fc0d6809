"""Problems with limits, and states from which they can be kept: what the solvers are compared on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from mpc_problems import random_states
from numpy.typing import NDArray
from task_ids import CARTPOLE, PENDULUM

from mpcoffline.envs import PLANTS
from mpcoffline.mpc import MPC, Constraint, Model, ParameterSpace, Penalty, QuadraticCost, StateBounds
from mpcoffline.mpc.component import Component
from mpcoffline.plants.nominal import nominal_mpc

Array = NDArray[np.float64]
INF = np.inf


class Problem(NamedTuple):
    """An MPC with limits, and where it begins.

    Attributes:
        make: The MPC, with ``soft`` in place of its own penalties where one is given.
        draw: ``(n, rng) -> states (n, nx)``.
    """

    make: Callable[[], MPC]
    draw: Callable[[int, np.random.Generator], Array]


def cart_pole(soft: Penalty | None = None) -> MPC:
    """The task's, with a track of 0.3 m to each side."""
    limit = Constraint(lambda x, u, p: ca.vertcat(x[0] - 0.3, -x[0] - 0.3), "track", soft)
    return nominal_mpc(CARTPOLE).replace(constraints=limit)


def _cart_states(n: int, rng: np.random.Generator) -> Array:
    states = random_states(CARTPOLE, n, int(rng.integers(1 << 30)))
    states[:, :2] *= [0.25, 0.3]
    states[:, 4] *= 0.3
    return states


def pendulum(soft: Penalty | None = None) -> MPC:
    """The task's over 100 steps, no faster than 4 rad/s."""
    return nominal_mpc(PENDULUM).replace(
        constraints=StateBounds([-INF, -INF, -4.0], [INF, INF, 4.0], "speed", soft), horizon=100
    )


def _pendulum_states(n: int, rng: np.random.Generator) -> Array:
    return random_states(PENDULUM, n, int(rng.integers(1 << 30)), speed=2.0)


def four_tank(soft: Penalty | None = None) -> MPC:
    """Johansson's quadruple tank: levels in cm, pumps in V; the upper tanks run over at 2.5 cm."""
    areas = np.array([28.0, 32.0, 28.0, 32.0])
    c = np.array([0.071, 0.057, 0.071, 0.057]) * np.sqrt(2.0 * 981.0) / areas

    def ode(h: Any, v: Any, p: Any) -> Any:
        q = [c[i] * h[i] / (h[i] ** 2 + 0.01) ** 0.25 for i in range(4)]
        k, g = (3.33, 3.35), (0.7, 0.6)
        return ca.vertcat(
            -q[0] + q[2] * areas[2] / areas[0] + g[0] * k[0] * v[0] / areas[0],
            -q[1] + q[3] * areas[3] / areas[1] + g[1] * k[1] * v[1] / areas[1],
            -q[2] + (1 - g[1]) * k[1] * v[1] / areas[2],
            -q[3] + (1 - g[0]) * k[0] * v[0] / areas[3],
        )

    cost = {"W": np.diag([1.0, 1.0, 0.0, 0.0]), "x_ref": [14.0, 12.0, 2.0, 1.5]}
    levels = StateBounds([2.0, 2.0, 0.5, 0.5], [14.5, 12.5, 2.5, 2.0], "levels", soft)
    return MPC(
        Model(ode, 4, 2, 5.0),
        QuadraticCost(R=0.2 * np.eye(2), u_ref=[3.0, 3.0], **cost),
        QuadraticCost(**cost),
        horizon=40,
        discount=0.97,
        action_low=[0.0, 0.0],
        action_high=[8.0, 8.0],
        constraints=levels,
    )


def _tank_states(n: int, rng: np.random.Generator) -> Array:
    return rng.uniform([8.0, 8.0, 1.0, 0.8], [14.0, 12.0, 2.3, 1.9], (n, 4))


def obstacle(soft: Penalty | None = None) -> MPC:
    """A point in the plane around a disc to the origin, its speed in a disc of 1."""

    def step(x: Any, u: Any, p: Any) -> Any:
        return ca.vertcat(x[:2] + 0.1 * x[2:] + 0.005 * u, x[2:] + 0.1 * u)

    disc = Constraint(lambda x, u, p: 0.25 - (x[0] - 1.0) ** 2 - (x[1] - 0.9) ** 2, "disc", soft)
    speed = Constraint(lambda x, u, p: x[2] ** 2 + x[3] ** 2 - 1.0, "speed", soft)
    return MPC(
        Model(step, 4, 2, 0.1, discrete=True),
        QuadraticCost(np.diag([1.0, 1.0, 0.1, 0.1]), 0.1 * np.eye(2)),
        QuadraticCost(np.diag([10.0, 10.0, 1.0, 1.0])),
        horizon=40,
        discount=0.99,
        action_low=[-2.0, -2.0],
        action_high=[2.0, 2.0],
        constraints=[disc, speed],
    )


def _plane_states(n: int, rng: np.random.Generator) -> Array:
    return np.hstack([rng.uniform([1.6, 1.5], [2.4, 2.4], (n, 2)), rng.uniform(-0.3, 0.3, (n, 2))])


def integrator() -> MPC:
    """A double integrator with a bounded speed, that ends at rest."""
    step = Model(lambda x, u, p: ca.vertcat(x[0] + 0.2 * x[1], x[1] + 0.2 * u[0]), 2, 1, 0.2, discrete=True)
    end = Constraint(lambda x, p: ca.vertcat(x - 0.05, -x - 0.05), "rest", terminal=True)
    return MPC(
        step,
        QuadraticCost(np.diag([1.0, 0.1]), [[0.1]]),
        QuadraticCost(np.eye(2)),
        horizon=20,
        discount=0.98,
        action_low=[-2.0],
        action_high=[2.0],
        constraints=[StateBounds([-INF, -1.0], [INF, 1.0], "speed"), end],
    )


def _line_states(n: int, rng: np.random.Generator) -> Array:
    return rng.uniform([-1.5, -0.9], [1.5, 0.9], (n, 2))


def planar_quadrotor(soft: Penalty | None = None) -> MPC:
    """The task's, above a floor, with a lateral limit and one on thrust and tilt together (mixed)."""
    plant = PLANTS["quadrotor"]
    limits: list[Any] = [Constraint(lambda x, u, p: ca.vertcat(-0.15 - x[1], x[0] - 0.9), "room", soft)]
    return nominal_mpc(plant.id).replace(constraints=limits)


def _quadrotor_states(n: int, rng: np.random.Generator) -> Array:
    plant = PLANTS["quadrotor"]
    return random_states(plant.id, n, int(rng.integers(1 << 30)))


def quadrotor_3d(soft: Penalty | None = None) -> MPC:
    """Thirteen states: position, speed, quaternion, rates; four thrusts; a floor and a limit of the tilt."""
    mass, arm, inertia = 1.0, 0.2, np.array([0.01, 0.01, 0.02])

    def ode(x: Any, u: Any, p: Any) -> Any:
        v, q, w = x[3:6], x[6:10], x[10:13]
        thrust = (u[0] + u[1] + u[2] + u[3]) / mass
        up = ca.vertcat(
            2 * (q[1] * q[3] + q[0] * q[2]), 2 * (q[2] * q[3] - q[0] * q[1]), 1 - 2 * (q[1] ** 2 + q[2] ** 2)
        )
        turned = 0.5 * ca.vertcat(
            -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
            q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
            q[0] * w[1] - q[1] * w[2] + q[3] * w[0],
            q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
        )
        torque = ca.vertcat(arm * (u[1] - u[3]), arm * (u[2] - u[0]), 0.05 * (u[0] - u[1] + u[2] - u[3]))
        gyro = ca.cross(w, inertia * w)
        return ca.vertcat(v, up * thrust - ca.vertcat(0, 0, 9.81), turned, (torque - gyro) / inertia)

    weights = np.diag([5.0, 5.0, 5.0, 0.5, 0.5, 0.5, 0.0, 1.0, 1.0, 1.0, 0.05, 0.05, 0.05])
    rest = np.r_[np.zeros(6), 1.0, np.zeros(6)]
    floor = StateBounds(np.r_[-INF, -INF, -0.2, np.full(10, -INF)], np.full(13, INF), "floor", soft)
    tilt = Constraint(lambda x, u, p: x[7] ** 2 + x[8] ** 2 - 0.01, "tilt", soft)
    return MPC(
        Model(ode, 13, 4, 0.05),
        QuadraticCost(weights, 0.05 * np.eye(4), x_ref=rest, u_ref=np.full(4, 9.81 / 4)),
        QuadraticCost(5.0 * weights, x_ref=rest),
        horizon=25,
        discount=0.98,
        action_low=np.zeros(4),
        action_high=np.full(4, 5.0),
        constraints=[floor, tilt],
    )


def _flying_states(n: int, rng: np.random.Generator) -> Array:
    position = rng.uniform([-1.5, -1.5, 0.0], [1.5, 1.5, 1.0], (n, 3))
    axis = rng.uniform(-0.05, 0.05, (n, 3))
    attitude = np.hstack([np.sqrt(1.0 - (axis**2).sum(axis=1, keepdims=True)), axis])
    return np.hstack([position, rng.uniform(-0.4, 0.4, (n, 3)), attitude, rng.uniform(-0.3, 0.3, (n, 3))])


def lane(soft: Penalty | None = None) -> MPC:
    """A car at 20 m/s in a lane, beside its middle: lateral limit and one of the lateral acceleration (mixed)."""

    def ode(x: Any, u: Any, p: Any) -> Any:
        return ca.vertcat(20.0 * ca.sin(x[1]), 20.0 * ca.tan(x[2]) / 4.5 - 20.0 * x[3], (u[0] - x[2]) / 0.25, 0)

    sideways = Constraint(lambda x, u, p: ca.vertcat(x[0] - 0.6, -0.6 - x[0]), "lane", soft)
    steering = Constraint(lambda x, u, p: ca.vertcat(u[0] - x[2] - 0.04, x[2] - u[0] - 0.04), "steering", soft)
    return MPC(
        Model(ode, 4, 1, 0.1),
        QuadraticCost(np.diag([1.0, 10.0, 100.0, 0.0]), [[100.0]], S=[[0.0], [0.0], [-100.0], [0.0]]),
        QuadraticCost(np.diag([5.0, 50.0, 0.0, 0.0])),
        horizon=30,
        discount=0.97,
        action_low=[-0.15],
        action_high=[0.15],
        constraints=[sideways, steering],
    )


def _lane_states(n: int, rng: np.random.Generator) -> Array:
    return rng.uniform([-0.5, -0.03, -0.02, -0.005], [0.5, 0.03, 0.02, 0.005], (n, 4))


class Energy(Component):
    """What a pump pays for, bar times per cent; nothing at the end."""

    def __init__(self) -> None:
        self.space = ParameterSpace(())

    def expression(self, x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        """As a stage cost."""
        return 0.005 * u[0] * x[0]

    def terminal_expression(self, x: ca.SX, p: object) -> ca.SX:
        """As a terminal cost."""
        return ca.SX(0)


def reverse_osmosis(soft: Penalty | None = None) -> MPC:
    """Pressure in bar, salt in g/L, a product tank in m; pump and brine valve are slow, and the valve has no price."""

    def flows(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        product, brine, feed = 0.0012 * (x[0] - 0.75 * x[1]), 8e-4 * u[1] * x[0], 0.001 * u[0]
        salt = (5.0 * feed - brine * x[1] - 0.02 * product * x[1]) / 1.2
        return ca.vertcat(20.0 * (feed - product - brine), salt, (product - 0.02) / 6.0)

    def changes(x: ca.SX, u: ca.SX, before: ca.SX, p: object) -> ca.SX:
        change, most = u - before, ca.DM([1.0, 0.01])
        return ca.vertcat(change - most, -change - most)

    limits = [
        Constraint(changes, "rates", uses_previous=True),
        StateBounds([-INF, -INF, 1.0], [60.0, 32.0, 4.0], "operation", soft or Penalty(20.0)),
    ]
    model, low, high = Model(flows, 3, 2, 2.0), [20.0, 0.05], [100.0, 1.0]
    return MPC(model, Energy(), Energy(), 40, 0.99, low, high, constraints=limits)


def _brackish_states(n: int, rng: np.random.Generator) -> Array:
    return rng.uniform([25.0, 15.0, 1.2, 20.0, 0.05], [40.0, 25.0, 3.5, 60.0, 0.6], size=(n, 5))


#: By name. Hard where nothing else is said.
PROBLEMS = {
    "cart-pole": Problem(cart_pole, _cart_states),
    "cart-pole, l1 = 200": Problem(lambda: cart_pole(Penalty(200.0)), _cart_states),
    "cart-pole, l1 = 5, l2 = 50": Problem(lambda: cart_pole(Penalty(5.0, 50.0)), _cart_states),
    "pendulum": Problem(pendulum, _pendulum_states),
    "four tanks": Problem(four_tank, _tank_states),
    "four tanks, l1 = 20": Problem(lambda: four_tank(Penalty(20.0)), _tank_states),
    "obstacle": Problem(obstacle, _plane_states),
    "obstacle, l1 = 50": Problem(lambda: obstacle(Penalty(50.0)), _plane_states),
    "double integrator": Problem(integrator, _line_states),
    "planar quadrotor": Problem(planar_quadrotor, _quadrotor_states),
    "lane": Problem(lane, _lane_states),
    "quadrotor": Problem(quadrotor_3d, _flying_states),
    "reverse osmosis, rates": Problem(reverse_osmosis, _brackish_states),
}
