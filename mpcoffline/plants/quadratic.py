"""Costs that are quadratics, found in their expressions: solvers and learning know most about these."""

from __future__ import annotations

import itertools

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc import QuadraticCost

_ROUNDING = 1e-9
_POINTS = (1.0, 30.0, 1000.0)  # sizes of the points at which it is compared with the expression


def quadratic_form(cost: ca.Function, signals: list[str], rest: Array) -> QuadraticCost | None:
    """The quadratic cost that an expression is, with what follows signals; None where it is none, or not convex.

    ::

        L = [e; v]'[[W, S], [S', R]][e; v] + du'D du + constant,     e = x - T d - x_ref,   v = u - u_ref

    where T says which state follows which signal.

    Args:
        cost: ``(x, u, d, before) -> L``.
        signals: Names of the signals.
        rest: Where inputs without a weight rest, ``(nu,)``.
    """
    n, nu, m, _ = (int(cost.numel_in(i)) for i in range(4))
    sizes = np.cumsum([0, n, nu, m, nu])
    v = ca.SX.sym("v", int(sizes[-1]))
    value = cost(*(v[int(a) : int(b)] for a, b in itertools.pairwise(sizes)))
    function = ca.Function("parts", [v], [value, ca.gradient(value, v), ca.hessian(value, v)[0]])
    constant, gradient, H = (np.asarray(part.full()) for part in function(np.zeros(int(sizes[-1]))))
    if not (np.isfinite(H).all() and np.isfinite(gradient).all() and np.isfinite(constant).all()):
        return None
    H, g = H / 2.0, gradient.ravel()
    if not _agrees(function, float(constant.item()), g, H):
        return None
    x, u, d, b = (slice(int(a), int(e)) for a, e in itertools.pairwise(sizes))
    size = float(np.abs(H).max(initial=0.0)) or 1.0

    def same(a: Array, e: Array) -> bool:
        return bool((np.abs(a - e) <= _ROUNDING * size).all())

    D = H[b, b]
    W, S, R = H[x, x], H[x, u], H[u, u] - D
    T = np.zeros((n, m))
    for i in range(n):
        for j in range(m):
            if W[i, i] > _ROUNDING * size and abs(H[x, d][i, j] + W[i, i]) <= _ROUNDING * size and not T[i].any():
                T[i, j] = 1.0
    whole = same(H[u, b], -D) and same(H[x, b], np.zeros((n, nu))) and same(H[d, b], np.zeros((m, nu)))
    if not (whole and same(H[x, d], -W @ T) and same(H[u, d], -S.T @ T) and same(H[d, d], T.T @ W @ T)):
        return None
    M = np.block([[W, S], [S.T, R]])
    reference, *_ = np.linalg.lstsq(M, -np.append(g[x], g[u]) / 2.0, rcond=_ROUNDING)
    slope = float(np.abs(g).max(initial=0.0)) or 1.0
    left = np.concatenate([2.0 * M @ reference + np.append(g[x], g[u]), g[d] + T.T @ g[x], g[b]])
    if (np.abs(left) > 1e-7 * slope).any() or any(_negative(part) for part in (M, D)):
        return None
    offset = float(constant.item()) - float(reference @ M @ reference)
    free = np.abs(M[n:]).max(axis=1) == 0.0
    return QuadraticCost(
        W,
        R,
        S if np.abs(S).max() > 0.0 else None,
        x_ref=reference[:n],
        u_ref=np.where(free, rest, reference[n:]),
        constant=offset if abs(offset) > 1e-7 * (abs(float(constant.item())) or 1.0) else 0.0,
        D=D if np.abs(D).max() > 0.0 else None,
        tracks={i: signals[int(np.argmax(T[i]))] for i in range(n) if T[i].any()},
    )


def _agrees(function: ca.Function, constant: float, g: Array, H: Array) -> bool:
    """Whether the quadratic about zero is the expression, at points of all sizes."""
    rng = np.random.default_rng(0)
    for scale in _POINTS:
        for _ in range(4):
            point = scale * rng.normal(size=len(g))
            value, gradient, _ = (part.full().ravel() for part in function(point))
            own = constant + g @ point + point @ H @ point
            most = abs(constant) + np.abs(g) @ np.abs(point) + np.abs(point) @ np.abs(H) @ np.abs(point)
            slope = np.abs(g) + 2.0 * np.abs(H) @ np.abs(point)
            if not abs(value.item() - own) <= _ROUNDING * most:
                return False
            if not (np.abs(gradient - g - 2.0 * H @ point) <= _ROUNDING * (slope + slope.max())).all():
                return False
    return True


def _negative(matrix: Array) -> bool:
    """Whether a symmetric matrix is not positive semidefinite."""
    values = np.linalg.eigvalsh((matrix + matrix.T) / 2.0)
    return bool(values.min() < -1e-10 * max(float(np.abs(values).max()), np.finfo(float).tiny))
