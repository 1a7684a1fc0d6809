"""A small unstable linear plant with quadratic cost, whose values, policies and optimal MPC are known exactly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from riccati import optimum
from scipy.linalg import solve_discrete_lyapunov
from torch import Tensor

from mpcoffline.datasets import TransitionTable
from mpcoffline.learning import ValueFunction
from mpcoffline.mpc import MPC, Model, QuadraticCost

Array = NDArray[np.float64]

DISCOUNT = 0.9
A = np.array([[1.0, 0.1], [0.15, 1.02]])
B = np.array([[0.0], [0.12]])
W, R = np.diag([1.0, 0.1]), np.array([[0.1]])
MODEL_A = np.array([[0.98, 0.07], [0.20, 0.98]])  # what an engineer would believe
MODEL_B = np.array([[-0.02], [0.09]])
BEST = optimum(A, B, W, R, DISCOUNT)
GAIN = np.array([[-2.0, -1.5]])  # the logging policy u = GAIN x, stabilising but not optimal


def policy_value(gain: Array) -> Array:
    """P of the value x'Px of u = gain x, by the discounted Lyapunov equation."""
    closed = np.sqrt(DISCOUNT) * (A + B @ gain)
    return np.asarray(solve_discrete_lyapunov(closed.T, W + gain.T @ R @ gain))


def quadratic(P: Array, x: ArrayLike) -> Array:
    """x'Px of each row."""
    rows = np.asarray(x, dtype=np.float64)
    return np.asarray(np.einsum("...i,ij,...j->...", rows, P, rows))


def float32_uniform(rng: np.random.Generator, n: int, size: int, bound: float = 1.0) -> Array:
    """Numbers that a float32 table holds exactly."""
    return rng.uniform(-bound, bound, size=(n, size)).astype(np.float32).astype(np.float64)


def logged(x: Array, u: Array, terminations: ArrayLike | None = None) -> TransitionTable:
    """The table of transitions of the plant from states ``(n, 2)`` under inputs ``(n, 1)``."""
    ends = np.zeros(len(x)) if terminations is None else terminations
    return TransitionTable.from_arrays(x, u, quadratic(W, x) + quadratic(R, u), x @ A.T + u @ B.T, ends)


def policy_log(n: int, gain: Array = GAIN, seed: int = 0) -> TransitionTable:
    """Transitions of u = gain x from states all over [-1, 1]^2."""
    x = float32_uniform(np.random.default_rng(seed), n, 2)
    return logged(x, x @ gain.T)


def random_log(n: int, seed: int = 0, bound: float = 2.0) -> TransitionTable:
    """Transitions under inputs that have nothing to do with the state."""
    rng = np.random.default_rng(seed)
    return logged(float32_uniform(rng, n, 2), float32_uniform(rng, n, 1, bound))


def exploring_log(n: int, seed: int = 0, noise: float = 2.0) -> TransitionTable:
    """Transitions under inputs spread widely around the logging policy's, the optimal ones among them."""
    rng = np.random.default_rng(seed)
    x = float32_uniform(rng, n, 2)
    u = x @ GAIN.T + rng.uniform(-noise, noise, size=(n, 1))
    return logged(x, u.astype(np.float32).astype(np.float64))


def make_mpc(
    model: Sequence[Array] = (MODEL_A, MODEL_B),
    W: ArrayLike = W,
    R: ArrayLike = R,
    S: ArrayLike | None = None,
    **changes: Any,
) -> MPC:
    """An MPC of the plant: linear model, quadratic costs, wide bounds."""
    arguments: dict[str, Any] = {
        "model": Model(
            lambda x, u, p: p["A"] @ x + p["B"] @ u, 2, 1, 0.1, {"A": model[0], "B": model[1]}, discrete=True
        ),
        "stage_cost": QuadraticCost(W, R, S),
        "terminal_cost": QuadraticCost(BEST.P),
        "horizon": 10,
        "discount": DISCOUNT,
        "action_low": [-20.0],
        "action_high": [20.0],
    }
    return MPC(**(arguments | changes))


class QuadraticValue(ValueFunction):
    """V(x) = x'Px in float64, in place of a network."""

    def __init__(self, P: Array) -> None:
        super().__init__(len(P), (1,))
        self.P = torch.from_numpy(np.array(P, dtype=np.float64))

    def forward(self, observations: Tensor) -> Tensor:
        """x'Px, ``(...)``."""
        x = observations.double()
        return ((x @ self.P) * x).sum(-1)


def explained(truth: ArrayLike, found: ArrayLike) -> float:
    """R2: the share of the variance of the truth that is explained."""
    t, f = np.asarray(truth, dtype=np.float64), np.asarray(found, dtype=np.float64)
    return 1.0 - float(((t - f) ** 2).mean() / t.var())
