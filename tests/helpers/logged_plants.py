"""Small plants, simulated by numpy, and logs of them: truth for what is estimated from logs."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable
from mpcoffline.mpc import MPC, Model, Parameter, QuadraticCost

Array = NDArray[np.float64]

#: The jacketed tank's heating by the valve, heat passed on, heat lost; in 1/s.
TANK = np.array([0.030, 0.020, 0.002])
TANK_DT = 10.0


def tank_rate(x: Array, valve: Array, k: Array = TANK, curve: float = 1.0) -> Array:
    """The derivative of tank and jacket temperature, ``(..., 2)``; ``curve`` is the valve's exponent."""
    tank, jacket = x[..., 0], x[..., 1]
    passed, heat = k[1] * (jacket - tank), k[0] * valve**curve * (90.0 - jacket)
    return np.stack([passed - k[2] * (tank - 20.0), heat - passed], axis=-1)


def tank_log(
    n_episodes: int, steps: int, seed: int, *, noise: float = 0.0, delay: int = 0, curve: float = 1.0
) -> TransitionTable:
    """Episodes of the tank under a controller that follows set-points, badly; noise in spreads, measured once."""
    rng = np.random.default_rng(seed)
    x = rng.uniform([35.0, 40.0], [60.0, 65.0], (n_episodes, 2))
    goal, states, inputs = x[:, 0], [x], []
    for t in range(steps):
        if t % 40 == 0:
            goal = rng.uniform(35.0, 65.0, n_episodes)
        inputs.append(np.clip(0.2 + 0.03 * (goal - x[:, 0]) + 0.05 * rng.normal(size=n_episodes), 0.02, 1.0))
        acting = inputs[max(0, t - delay)]
        for _ in range(5):
            h = TANK_DT / 5
            a = tank_rate(x, acting, curve=curve)
            b = tank_rate(x + 0.5 * h * a, acting, curve=curve)
            c = tank_rate(x + 0.5 * h * b, acting, curve=curve)
            x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + tank_rate(x + h * c, acting, curve=curve))
        states.append(x)
    path = np.stack(states, axis=1)
    path = path + noise * path.std(axis=(0, 1)) * rng.normal(size=path.shape)
    n = n_episodes * steps
    flat = path[:, :-1].reshape(n, 2), np.stack(inputs, axis=1).reshape(n, 1), path[:, 1:].reshape(n, 2)
    zeros, ids = np.zeros(n), np.repeat(np.arange(n_episodes), steps)
    return TransitionTable.from_arrays(flat[0], flat[1], zeros, flat[2], zeros, ids)


def tank_mpc(k: Array | tuple[float, float, float] = (0.05, 0.03, 0.001)) -> MPC:
    """The tank with a linear valve and rough parameters."""

    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        passed = p["k1"] * (x[1] - x[0])
        return ca.vertcat(passed - p["k2"] * (x[0] - 20.0), p["kv"] * u[0] * (90.0 - x[1]) - passed)

    parameters = {
        name: Parameter(value, low=value / 30.0, high=30.0 * value)
        for name, value in zip(("kv", "k1", "k2"), k, strict=True)
    }
    model = Model(ode, 2, 1, TANK_DT, parameters)
    return MPC(model, QuadraticCost(np.eye(2), [[1.0]]), QuadraticCost(np.eye(2)), 10, 0.95, [0.0], [1.0])


def pendulum_log(n_episodes: int, steps: int, seed: int, *, friction: bool) -> TransitionTable:
    """Episodes of a hanging pendulum, shaken at random: angle and speed; friction dry (smooth) and viscous, or none."""
    rng = np.random.default_rng(seed)
    x, dt = rng.uniform([-1.5, -1.0], [1.5, 1.0], (n_episodes, 2)), 0.05

    def rate(x: Array, u: Array) -> Array:
        lost = 0.8 * np.tanh(5.0 * x[:, 1]) + 0.3 * x[:, 1] if friction else 0.0
        return np.stack([x[:, 1], -9.8 * np.sin(x[:, 0]) + 3.0 * u - lost], axis=1)

    states, inputs = [x], []
    for t in range(steps):
        u = rng.uniform(-2.0, 2.0, n_episodes) if t % 5 == 0 else inputs[-1]
        inputs.append(u)
        for _ in range(5):
            h = dt / 5
            a = rate(x, u)
            b = rate(x + 0.5 * h * a, u)
            c = rate(x + 0.5 * h * b, u)
            x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + rate(x + h * c, u))
        states.append(x)
    path, n = np.stack(states, axis=1), n_episodes * steps
    zeros, ids = np.zeros(n), np.repeat(np.arange(n_episodes), steps)
    s, a, reached = path[:, :-1].reshape(n, 2), np.stack(inputs, axis=1).reshape(n, 1), path[:, 1:].reshape(n, 2)
    return TransitionTable.from_arrays(s, a, zeros, reached, zeros, ids)


def pendulum_mpc() -> MPC:
    """The same pendulum without friction, with rough parameters."""

    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return ca.vertcat(x[1], -p["g"] * ca.sin(x[0]) + p["b"] * u[0])

    model = Model(ode, 2, 1, 0.05, {"g": Parameter(8.0, low=1.0), "b": Parameter(2.0, low=0.1)})
    return MPC(model, QuadraticCost(np.eye(2), [[0.1]]), QuadraticCost(np.eye(2)), 10, 0.95, [-2.0], [2.0])
