"""The exact infinite-horizon value of an MPC whose model is affine and whose stage cost is quadratic."""

from __future__ import annotations

import casadi as ca
import numpy as np
import scipy.linalg

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC, QuadraticCost

_EXACT = 1e-6  # relative, of the Riccati equation


def is_linear_quadratic(mpc: MPC) -> bool:
    """Whether f_theta is affine and Lhat_theta quadratic in (x, u), for every theta; inputs may be bounded."""
    if mpc.constraints is not None:
        return False
    z, theta = ca.SX.sym("z", mpc.nx + mpc.nu), ca.SX.sym("theta", mpc.space.size)
    slopes = ca.jacobian(mpc.dynamics_function(z[: mpc.nx], z[mpc.nx :], theta), z)
    curvature, _ = ca.hessian(mpc.stage_function(z[: mpc.nx], z[mpc.nx :], theta), z)
    return not (ca.depends_on(slopes, z) or ca.depends_on(curvature, z))


def riccati_cost(mpc: MPC) -> QuadraticCost | None:
    """V of the MPC with an infinite horizon and no input bounds, as terminal cost: with it, N does not matter.

    ::

        f = A x + B u + c,    Lhat = z'H z + 2 h'z + l,  z = (x, u),    V = x'P x + 2 p'x + v,
        P = H_xx + gamma A'P A - K'M_uu K,           M_uu = H_uu + gamma B'P B,   K = -M_uu^-1 (H_ux + gamma B'P A),
        p = h_x + K'h_u + gamma (A + B K)'(P c + p),      v = l + gamma (c'P c + 2 p'c + v) - k'M_uu k,
        k = -M_uu^-1 (h_u + gamma B'(P c + p))

    Bertsekas, "Dynamic Programming and Optimal Control", vol. 2, ch. 4. (sqrt(gamma) A, sqrt(gamma) B) is the
    undiscounted problem of the same P.

    Args:
        mpc: The problem; its horizon, terminal cost and input bounds do not matter.

    Returns:
        V; None where the problem is of another kind, or has no such value: where no input keeps it finite, or the
        inputs are free of cost and change nothing that costs.
    """
    if not is_linear_quadratic(mpc):
        return None
    nx, gamma = mpc.nx, mpc.discount
    A, B, c, H, h, level = _matrices(mpc)
    root = np.sqrt(gamma)
    try:
        P = scipy.linalg.solve_discrete_are(root * A, root * B, H[:nx, :nx], H[nx:, nx:], s=H[:nx, nx:])
        M = H + gamma * np.hstack([A, B]).T @ P @ np.hstack([A, B])
        factor = scipy.linalg.cho_factor(M[nx:, nx:])
        K = -scipy.linalg.cho_solve(factor, M[nx:, :nx])
        closed = gamma * (A + B @ K).T
        p = np.linalg.solve(np.eye(nx) - closed, h[:nx] + K.T @ h[nx:] + closed @ P @ c)
    except (ValueError, np.linalg.LinAlgError):
        return None
    missed = M[:nx, :nx] + M[:nx, nx:] @ K - P
    size = np.sqrt(np.abs(np.diag(P)))  # entry by entry, as every state has a unit of its own
    if not (np.abs(missed) <= _EXACT * np.outer(size, size)).all():
        return None
    k = -scipy.linalg.cho_solve(factor, h[nx:] + gamma * B.T @ (P @ c + p))
    v = (level + gamma * (c @ P @ c + 2.0 * p @ c) - k @ M[nx:, nx:] @ k) / (1.0 - gamma) if gamma < 1.0 else 0.0
    return _completed(np.asarray(P), np.asarray(p), float(v))


def _completed(P: Array, p: Array, v: float) -> QuadraticCost | None:
    """The same as (x - x_ref)'P (x - x_ref) + constant; None where it has no minimum."""
    size = np.sqrt(np.diag(P).clip(min=0.0))
    size = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(P / np.outer(size, size))
    known = values > _EXACT * values.max(initial=0.0)
    if (values < -_EXACT * values.max(initial=0.0)).any():
        return None
    along = vectors.T @ (p / size)
    if (np.abs(along[~known]) > _EXACT * np.abs(along).max(initial=0.0)).any():
        return None
    W = np.outer(size, size) * ((vectors[:, known] * values[known]) @ vectors[:, known].T)
    x_ref = -(vectors[:, known] @ (along[known] / values[known])) / size
    return QuadraticCost((W + W.T) / 2.0, x_ref=x_ref, constant=v - float(x_ref @ W @ x_ref))


def _matrices(mpc: MPC) -> tuple[Array, Array, Array, Array, Array, float]:
    """A, B, c, H, h, l at the MPC's parameters."""
    z, theta = ca.SX.sym("z", mpc.nx + mpc.nu), ca.SX.sym("theta", mpc.space.size)
    reached = mpc.dynamics_function(z[: mpc.nx], z[mpc.nx :], theta)
    stage = mpc.stage_function(z[: mpc.nx], z[mpc.nx :], theta)
    H, h = ca.hessian(stage, z)
    parts = [ca.densify(part) for part in (ca.jacobian(reached, z), reached, H / 2, h / 2, stage)]
    AB, c, H, h, level = (part.full() for part in ca.Function("lq", [z, theta], parts)(np.zeros(z.numel()), mpc.theta))
    return AB[:, : mpc.nx], AB[:, mpc.nx :], c[:, 0], H, h[:, 0], float(level[0, 0])
