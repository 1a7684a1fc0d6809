"""Two tanks in series below their overflows; centimetres, volts, seconds.

The lower level is wanted 1 cm below where the tank runs over, the upper tank runs over before the lower one is full
when the pump is started hard, and an inflow that nobody measures disturbs both.
"""

import casadi as ca
import numpy as np

from mpcoffline import MPC, Model, Parameter, Penalty, QuadraticCost, StateBounds

DT, STEPS, DISCOUNT, N_EPISODES = 4.0, 80, 0.97, 25  # s, control steps of an episode, gamma, episodes of the log
WHY = "a set-point below an overflow, disturbances, wrong outlets and pump"
WANTED, FULL, PRICE = 13.0, np.array([9.0, 14.0]), 30.0  # cm, cm, what a centimetre over the limit costs a step
OUTLETS, PUMP = np.array([0.21, 0.17]), 0.23  # cm^0.5 / s, cm / (V s)


class Plant:
    def reset(self, rng):
        self.rng, self.h, self.inflow = rng, rng.uniform([2.0, 3.0], [7.0, 13.0]), 0.0
        return self.observed()

    def step(self, u):
        v = float(np.clip(u[0], 0.0, 6.0))
        over = np.maximum(self.h - FULL, 0.0)
        cost = (self.h[1] - WANTED) ** 2 + 0.2 * (v - 2.5) ** 2 + PRICE * over.sum()
        self.inflow = 0.8 * self.inflow + 0.03 * self.rng.normal()
        for _ in range(8):
            out = OUTLETS * np.sqrt(self.h)
            rates = np.array([PUMP * v + self.inflow - out[0], out[0] - out[1]])
            self.h = np.clip(self.h + DT / 8 * rates, 0.0, 30.0)
        return self.observed(), cost, False

    def success(self):
        return abs(self.h[1] - WANTED) < 0.7

    def violations(self):
        return {"upper level": self.h[0] - FULL[0], "lower level": self.h[1] - FULL[1]}

    def observed(self):
        return np.maximum(self.h + 0.03 * self.rng.normal(size=2), 0.0)


def behaviour(rng):
    gain, slow, sum_, offset = rng.uniform(0.1, 0.4), rng.uniform(60.0, 150.0), [0.0], [0.0]
    wanted = WANTED - rng.uniform(0.0, 4.0)

    def act(observation, k):
        error = wanted - observation[1]
        sum_[0] = float(np.clip(sum_[0] + DT * gain / slow * error, -2.0, 2.0))
        if rng.random() < 0.1:
            offset[0] = rng.normal()
        return np.clip([2.7 + gain * error + sum_[0] + offset[0]], 0.0, 6.0)

    return act


def an_mpc(outlets, pump, horizon):
    def ode(h, u, p):
        out = [p["outlets"][i] * h[i] / (h[i] ** 2 + 0.01) ** 0.25 for i in range(2)]  # a root that is smooth at 0
        return ca.vertcat(p["pump"] * u[0] - out[0], out[0] - out[1])

    parameters = {
        "outlets": Parameter(outlets, low=outlets / 5, high=outlets * 5),
        "pump": Parameter(pump, low=pump / 5, high=pump * 5),
    }
    cost = {"W": np.diag([0.0, 1.0]), "x_ref": [8.0, WANTED]}
    return MPC(
        Model(ode, 2, 1, DT, parameters),
        QuadraticCost(R=[[0.2]], u_ref=[2.5], **cost),
        QuadraticCost(**cost),
        horizon,
        DISCOUNT,
        action_low=[0.0],
        action_high=[6.0],
        constraints=StateBounds([-np.inf, -np.inf], FULL, "levels", Penalty(PRICE)),
    )


def mpc(seed):
    factors = np.exp(np.random.default_rng(seed).uniform(-0.35, 0.35, 3))
    return an_mpc(OUTLETS * factors[:2], PUMP * factors[2], 25)


def truth():
    return an_mpc(OUTLETS, PUMP, 60)
