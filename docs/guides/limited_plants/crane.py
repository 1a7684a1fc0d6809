"""A crane that lifts a load over a stack of containers; metres, radians, seconds.

Inputs are the trolley's acceleration and the speed of the rope. The load swings on it, by no more than is safe, has to
pass above the containers, and the trolley has a largest speed.
"""

import casadi as ca
import numpy as np

from mpcoffline import MPC, Constraint, Model, Parameter, Penalty, QuadraticCost, StateBounds

DT, STEPS, DISCOUNT, N_EPISODES = 0.2, 60, 0.98, 30
WHY = "an obstacle, a swing that is lightly damped, wrong rope and winch"
TARGET, ROPE = 3.0, 1.5  # m: where to, how much rope is out there
MIDDLE, TOP, STEEP = 1.5, 1.0, 1.2  # m: of the containers; below the drum, their highest; 1/m: of their flanks
FAST, SWING = 1.0, 0.15  # m/s, rad
DRAG, GAIN = 0.15, 1.0  # 1/s, of the swing; of the trolley's drive
PRICES = {"containers": 30.0, "swing": 40.0, "speed": 20.0}  # a step, per metre, radian, metre a second
G = 9.81


def below(x, cos, sin):
    """How far the load hangs below the hump of containers, metres."""
    load = x[0] + x[4] * sin(x[2])
    return x[4] * cos(x[2]) - TOP - STEEP * (load - MIDDLE) ** 2


def rates(x, u, gain, drag, cos, sin):
    """Of place, speed, swing, its rate, and rope."""
    a = gain * u[0]
    swing = -(G * sin(x[2]) + a * cos(x[2]) + 2.0 * u[1] * x[3]) / x[4] - drag * x[3]
    return [x[1], a, x[3], swing, u[1]]


class Plant:
    def reset(self, rng):
        self.rng = rng
        self.x = np.array([rng.uniform(-0.3, 0.6), 0.0, rng.uniform(-0.05, 0.05), 0.0, rng.uniform(1.3, 1.6)])
        return self.observed()

    def step(self, u):
        u = np.clip(u, [-0.8, -0.5], [0.8, 0.5])
        x = self.x
        over = self.violations()
        cost = (x[0] - TARGET) ** 2 + 0.2 * x[1] ** 2 + 2.0 * x[2] ** 2 + 0.2 * x[3] ** 2 + (x[4] - ROPE) ** 2
        cost += 0.1 * u[0] ** 2 + 0.1 * u[1] ** 2 + sum(PRICES[name] * max(v, 0.0) for name, v in over.items())
        for _ in range(10):
            x = x + DT / 10 * np.array(rates(x, u, GAIN, DRAG, np.cos, np.sin))
            x[4] = np.clip(x[4], 0.6, 2.0)
        x[3] += 0.004 * self.rng.normal()  # wind
        self.x = x
        return self.observed(), float(cost), False

    def success(self):
        return abs(self.x[0] - TARGET) < 0.1 and abs(self.x[2]) < 0.05

    def violations(self):
        x = self.x
        return {"containers": below(x, np.cos, np.sin), "swing": abs(x[2]) - SWING, "speed": abs(x[1]) - FAST}

    def observed(self):
        return self.x + np.array([0.003, 0.003, 0.002, 0.005, 0.003]) * self.rng.normal(size=5)


def behaviour(rng):
    gains, target, late = rng.uniform([0.3, 0.8, 1.0], [0.6, 1.6, 3.0]), rng.uniform(1.0, 3.2), [0.0, 0.0]
    high = rng.uniform(0.8, 1.1)

    def act(y, k):
        if rng.random() < 0.15:
            late[:] = 0.3 * rng.normal(size=2)
        pull = high if abs(y[0] - MIDDLE) < 0.9 else ROPE
        ahead = np.clip(target - y[0], -1.0, 1.0)
        return np.clip(
            [gains[0] * ahead - gains[1] * y[1] + gains[2] * y[2] + late[0], 0.8 * (pull - y[4]) + late[1]],
            [-0.8, -0.5],
            [0.8, 0.5],
        )

    return act


def an_mpc(gain, drag, horizon):
    def ode(x, u, p):
        return ca.vertcat(*rates(x, u, p["gain"], p["drag"], ca.cos, ca.sin))

    parameters = {"gain": Parameter(gain, low=0.3, high=3.0), "drag": Parameter(drag, low=0.0, high=2.0)}
    cost = {"W": np.diag([1.0, 0.2, 2.0, 0.2, 1.0]), "x_ref": [TARGET, 0.0, 0.0, 0.0, ROPE]}
    edge = np.array([np.inf, FAST, SWING, np.inf, np.inf])
    fast, swing = (np.where(np.arange(5) == i, edge, np.inf) for i in (1, 2))
    limits = [
        StateBounds(-fast, fast, "speed", Penalty(PRICES["speed"])),
        StateBounds(-swing, swing, "swing", Penalty(PRICES["swing"])),
        Constraint(lambda x, u, p: below(x, ca.cos, ca.sin), "containers", Penalty(PRICES["containers"])),
    ]
    return MPC(
        Model(ode, 5, 2, DT, parameters),
        QuadraticCost(R=0.1 * np.eye(2), **cost),
        QuadraticCost(**(cost | {"W": 5.0 * cost["W"]})),
        horizon,
        DISCOUNT,
        action_low=[-0.8, -0.5],
        action_high=[0.8, 0.5],
        constraints=limits,
    )


def mpc(seed):
    rng = np.random.default_rng(seed)
    return an_mpc(GAIN * np.exp(rng.uniform(-0.4, 0.4)), DRAG * np.exp(rng.uniform(-1.0, 1.0)), 30)


def truth():
    return an_mpc(GAIN, DRAG, 40)
