"""Plants whose inputs act late, and logs of them."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from mpcoffline import MPC, Model, Parameter, QuadraticCost, TransitionTable


def belt_mpc(delay: int | None = None, *, gain: float = 0.7, decay: float = 0.8) -> MPC:
    """MPC_1 of a belt scale: flow x+ = decay x + gain u + 0.1, rough by default (truly 0.9 and 0.5)."""
    parameters = {"decay": Parameter(decay, low=0.1, high=0.99), "gain": Parameter(gain, low=0.05, high=5.0)}
    model = Model(
        lambda x, u, p: p["decay"] * x + p["gain"] * u + 0.1, 1, 1, 1.0, parameters, discrete=True, delay=delay
    )
    cost = QuadraticCost([[1.0]], [[0.02]], x_ref=[3.0])
    return MPC(model, cost, QuadraticCost([[3.0]], x_ref=[3.0]), 20, 0.95, [0.0], [1.0])


def belt_log(
    delay: int, *, n_episodes: int = 20, length: int = 60, noise: float = 0.0, white: bool = False, seed: int = 0
) -> TransitionTable:
    """Logs of the belt under a proportional controller with steps on top, or under inputs at random."""
    rng, parts = np.random.default_rng(seed), []
    for e in range(n_episodes):
        x, past, kp, extra, y = rng.uniform(0.0, 5.0), [0.0] * delay, rng.uniform(0.1, 0.4), 0.0, []
        measured = x + noise * rng.normal()
        for _ in range(length):
            if rng.random() < 0.15:
                extra = rng.uniform(-0.4, 0.4)
            u = float(np.clip(rng.uniform() if white else 0.5 + kp * (3.0 - measured) + extra, 0.0, 1.0))
            past.append(u)
            cost = (x - 3.0) ** 2 + 0.02 * u**2
            x = 0.9 * x + 0.5 * past.pop(0) + 0.1 + 0.01 * rng.normal()
            reached = x + noise * rng.normal()
            y.append((measured, u, cost, reached))
            measured = reached
        s, a, c, r = np.array(y).T
        parts.append((s[:, None], a[:, None], c, r[:, None], np.zeros(length, bool), np.full(length, e)))
    return TransitionTable.from_arrays(*(np.concatenate(part) for part in zip(*parts, strict=True)))


A = np.array([[0.95, 0.1, 0.0], [0.0, 0.85, 0.1], [0.05, 0.0, 0.9]])
B = np.array([[0.05, 0.0], [0.2, 0.02], [0.0, 0.15]])


def pair_mpc(delay: Sequence[int] | None = None) -> MPC:
    """MPC_1 of a plant with three states and two inputs, of which the gains are unknown."""

    def step(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return ca.SX(A) @ x + ca.SX(B) @ (p["gains"] * u)

    parameters = {"gains": Parameter(np.array([0.6, 1.5]), low=0.05, high=10.0)}
    model = Model(step, 3, 2, 0.5, parameters, discrete=True, delay=delay)
    end = QuadraticCost(np.eye(3))
    return MPC(model, QuadraticCost(np.eye(3), 0.1 * np.eye(2)), end, 15, 0.95, [-1.0, -1.0], [1.0, 1.0])


def pair_log(delay: Sequence[int], *, n_episodes: int = 25, length: int = 50, seed: int = 0) -> TransitionTable:
    """Logs of it under noisy feedback."""
    rng, parts = np.random.default_rng(seed), []
    for e in range(n_episodes):
        x, past = rng.normal(size=3), [[0.0] * d for d in delay]
        for _ in range(length):
            u = np.clip(-0.3 * x[:2] + 0.5 * rng.normal(size=2), -1.0, 1.0)
            for queue, value in zip(past, u, strict=True):
                queue.append(value)
            reached = A @ x + B @ [queue.pop(0) for queue in past] + 0.01 * rng.normal(size=3)
            parts.append((x, u, x @ x + 0.1 * u @ u, reached, False, e))
            x = reached
    return TransitionTable.from_arrays(*(np.array(part) for part in zip(*parts, strict=True)))
