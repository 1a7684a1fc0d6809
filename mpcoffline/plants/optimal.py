"""The closed-loop optimum of a linear plant with quadratic cost."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_are

from mpcoffline.core.types import Array
from mpcoffline.envs import Plant
from mpcoffline.envs.episode import DISCOUNT
from mpcoffline.mpc import MPC, QuadraticCost

from .nominal import nominal_mpc


def riccati(plant: Plant, A: Array, B: Array) -> Array:
    """P of V*(s) = s'Ps without bounds: P = W + gamma A'PA - gamma^2 A'PB (R + gamma B'PB)^-1 B'PA.

    Args:
        plant: The plant, whose nominal cost is the true one.
        A: Its matrix, ``(nx, nx)``.
        B: Its input matrix, ``(nx, nu)``.
    """
    root = np.sqrt(DISCOUNT)
    weights = np.diag(plant.nominal.weights), np.diag(plant.nominal.input_weights)
    P = solve_discrete_are(root * A, root * B, *weights)
    return np.asarray((P + P.T) / 2.0)


def optimal_linear_mpc(plant: Plant, A: Array, B: Array) -> MPC:
    """The optimal controller: the MPC with the true plant, the true cost and terminal cost V*.

    While no input bound is active it equals the linear feedback of :func:`riccati`; where bounds are active it respects
    them.

    Args:
        plant: As in :func:`riccati`.
        A: Likewise.
        B: Likewise.
    """
    nominal = nominal_mpc(plant.id)
    true_model = nominal.with_theta(nominal.space.pack({"model.A": A, "model.B": B}))
    return true_model.replace(terminal_cost=QuadraticCost(riccati(plant, A, B)))
