"""Optimal control of linear systems with quadratic cost, discounted: the exact V*, Q* and gain."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_discrete_are

Array = NDArray[np.float64]


class Optimum(NamedTuple):
    """V*(s) = s'Ps, Q*(s, a) = (s, a)'Q(s, a), a = K s."""

    P: Array
    Q: Array
    K: Array


def optimum(A: Array, B: Array, W: Array, R: Array, discount: float) -> Optimum:
    """The optimum for s+ = A s + B a, L = s'Ws + a'Ra.

    gamma V(A s + B a) is the undiscounted problem with sqrt(gamma) A, sqrt(gamma) B.
    """
    root = np.sqrt(discount)
    P = solve_discrete_are(root * A, root * B, W, R)
    AB = np.hstack([A, B])
    Q = block_diag(W, R) + discount * AB.T @ P @ AB
    n = len(A)
    return Optimum(P, Q, -np.linalg.solve(Q[n:, n:], Q[n:, :n]))
