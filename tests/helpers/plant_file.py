"""A plant file for tests: a noisy scalar plant that ends when it is far off, with a model of another gain."""

TEXT = '''
"""A cart on a rail, one coordinate."""
import numpy as np
from mpcoffline import MPC, Model, Parameter, QuadraticCost

DT, STEPS, DISCOUNT, N_EPISODES, WHY = 0.1, 12, 0.9, 6, "a test"


class Plant:
    def reset(self, rng):
        self.rng, self.x = rng, rng.uniform(-1, 1)
        return np.array([self.x])

    def step(self, u):
        cost = self.x**2 + 0.1 * float(u[0]) ** 2
        self.x = 1.2 * self.x + 0.5 * float(np.clip(u[0], -1, 1)) + 0.05 * self.rng.normal()
        return np.array([self.x]), cost, bool(abs(self.x) > 1.1)

    def success(self):
        return abs(self.x) < 0.3


def behaviour(rng):
    gain = rng.uniform(1, 2)
    return lambda y, k: np.clip([-gain * y[0] + 0.1 * rng.normal()], -1, 1)


def _mpc(b):
    def step(x, u, p):
        return 1.2 * x + p["b"] * u

    cost = QuadraticCost(W=[[1.0]], R=[[0.1]])
    model = Model(step, nx=1, nu=1, dt=DT, discrete=True, parameters={"b": Parameter(b, low=0.01, high=5.0)})
    return MPC(model, cost, cost, horizon=5, discount=DISCOUNT, action_low=[-1], action_high=[1])


def mpc(seed):
    return _mpc(1.5 + 0.1 * seed)


def truth():
    return _mpc(0.5)
'''
