"""The linear-quadratic special case of (MPC): its matrices, its Riccati recursion, and the QP that input bounds make.

With z = (x, u), and an index k on all matrices where theta is given for each stage::

    f_th(x, u) = A x + B u + c,      Lhat_th(x, u) = z'H z + 2 h'z + l,      T_th(x) = x'W x + 2 w'x + t
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC, StageCost, TerminalCost, expressions

_TOUCHING = 1e-9  # distance from a bound that counts as none, relative to 1 + |u|
_SINGULAR = 1e-13  # of a Hessian's diagonal, below which a pivot counts as zero


def misfit(mpc: MPC) -> str:
    """What keeps a problem from being linear-quadratic; empty where nothing does."""
    if mpc.constraints is not None:
        return "constraints other than input bounds"
    if not is_affine(mpc):
        return "a model that is not affine in (x, u)"
    x, u, theta = _symbols(mpc)
    for name, cost in (("stage", mpc.stage_function(x, u, theta)), ("terminal", mpc.terminal_function(x, theta))):
        z = ca.vertcat(x, u)
        hessian, _ = ca.hessian(cost, z)
        if ca.depends_on(hessian, z):
            return f"a {name} cost that is not quadratic ({type(getattr(mpc, f'{name}_cost')).__name__})"
    return ""


def is_affine(mpc: MPC) -> bool:
    """Whether f_theta is affine in (x, u) for every theta."""
    return expressions.is_affine(mpc.dynamics_function)


def promises_convexity(cost: StageCost | TerminalCost) -> bool:
    """Whether a cost's class says by ``convex`` that its Hessian is positive semidefinite for every theta."""
    return bool(getattr(cost, "convex", False))


def is_convex(mpc: MPC) -> bool:
    """Whether every minimum is global, for every theta: affine model, convex costs, only inputs bounded."""
    costs = promises_convexity(mpc.stage_cost) and promises_convexity(mpc.terminal_cost)
    return mpc.constraints is None and costs and is_affine(mpc)


def _symbols(mpc: MPC) -> tuple[ca.SX, ca.SX, ca.SX]:
    return ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX.sym("theta", mpc.space.size)


@dataclass(frozen=True, eq=False)
class LinearQuadratic:
    """The matrices of one linear-quadratic problem; a leading N counts the stages.

    Attributes:
        A: ``(N, nx, nx)``.
        B: ``(N, nx, nu)``.
        c: ``(N, nx)``.
        H: ``(N, nx + nu, nx + nu)``.
        h: ``(N, nx + nu)``.
        offset: l, ``(N,)``.
        W: ``(nx, nx)``.
        w: ``(nx,)``.
        t: Scalar.
        discount: gamma.
    """

    A: Array
    B: Array
    c: Array
    H: Array
    h: Array
    offset: Array
    W: Array
    w: Array
    t: float
    discount: float

    @property
    def horizon(self) -> int:
        """N."""
        return len(self.A)

    def tail(self) -> LinearQuadratic:
        """The problem that is left after the first stage; with a horizon of 0 it is the terminal cost alone."""
        names = ("A", "B", "c", "H", "h", "offset")
        return replace(self, **{name: getattr(self, name)[1:] for name in names})

    def rollout(self, x: Array, u: Array) -> Array:
        """States ``(B, N + 1, nx)`` from states ``(B, nx)`` under inputs ``(B, N, nu)``."""
        driven = _times(self.B, u) + self.c
        states = np.empty((len(x), self.horizon + 1, x.shape[1]))
        states[:, 0] = x
        for k in range(self.horizon):
            states[:, k + 1] = states[:, k] @ self.A[k].T + driven[:, k]
        return states

    def cost(self, x: Array, u: Array) -> Array:
        """The objective of (MPC), ``(B,)``, of states ``(B, N + 1, nx)`` and inputs ``(B, N, nu)``."""
        z = np.concatenate([x[:, :-1], u], axis=2)
        stages = np.einsum("bki,kij,bkj->bk", z, self.H, z) + 2.0 * np.einsum("ki,bki->bk", self.h, z) + self.offset
        last = x[:, -1]
        terminal = np.einsum("bi,ij,bj->b", last, self.W, last) + 2.0 * last @ self.w + self.t
        weights = self.discount ** np.arange(self.horizon + 1)
        return np.asarray(stages @ weights[:-1] + weights[-1] * terminal)

    def costates(self, x: Array, u: Array) -> Array:
        """Half the gradient of the cost to go with respect to the states, ``(B, N + 1, nx)``, in current value."""
        nx = x.shape[2]
        z = np.concatenate([x[:, :-1], u], axis=2)
        local = np.einsum("kij,bkj->bki", self.H[:, :nx], z) + self.h[:, :nx]
        result = np.empty_like(x)
        result[:, -1] = x[:, -1] @ self.W + self.w
        for k in reversed(range(self.horizon)):
            result[:, k] = local[:, k] + self.discount * result[:, k + 1] @ self.A[k]
        return result

    def optimality(
        self, x: Array, u: Array, costates: Array, low: Array, high: Array, affine: Array | float = 1.0
    ) -> Array:
        """How far the first-order conditions are from holding, relative to the size of their terms, ``(B,)``.

        The problem is convex, so that they decide: the dynamics, the recursion of the costates, and at each stage
        either a zero gradient or one that points out of the bounds. Everything is computed from the problem's own
        matrices, whatever the trajectories and costates come from. ``affine (B,)`` scales c, h and w.
        """
        nx = x.shape[2]
        c, h, w = (np.multiply.outer(np.asarray(affine), part) for part in (self.c, self.h, self.w))
        z = np.concatenate([x[:, :-1], u], axis=2)
        AB = np.concatenate([self.A, self.B], axis=2)
        dynamics = x[:, 1:] - (_times(AB, z) + c)
        own, ahead = _times(self.H, z) + h, self.discount * _times(AB.transpose(0, 2, 1), costates[:, 1:])
        gradient = own + ahead
        last = costates[:, -1] - (x[:, -1] @ self.W + w)
        slope = gradient[:, :, nx:]
        room = np.where(slope > 0.0, u - low, high - u)  # in the direction of descent
        slope = np.where(room <= _TOUCHING * (1.0 + np.abs(u)), 0.0, slope)
        adjoint = gradient[:, :, :nx] - costates[:, :-1]
        # Stage by stage: where the states grow along the horizon, the last ones must not hide the errors of the first.
        scale = 1.0 + _largest(own) + _largest(ahead)
        stages = np.maximum(_largest(adjoint), _largest(slope)) / scale
        stages = np.maximum(stages, _largest(dynamics) / (1.0 + _largest(z)))
        end = _largest(last) / (1.0 + _largest(costates[:, -1]))
        return np.asarray(np.maximum(stages.max(axis=1, initial=0.0), end))


class Extraction:
    """Reads the matrices of an MPC whose :func:`misfit` is empty, for any theta.

    Args:
        mpc: The problem.
    """

    def __init__(self, mpc: MPC) -> None:
        x, _, theta = _symbols(mpc)
        z = ca.SX.sym("z", mpc.nx + mpc.nu)
        reached = mpc.dynamics_function(z[: mpc.nx], z[mpc.nx :], theta)
        stage = mpc.stage_function(z[: mpc.nx], z[mpc.nx :], theta)
        terminal = mpc.terminal_function(x, theta)
        H, h = ca.hessian(stage, z)
        P, p = ca.hessian(terminal, x)
        parts = [ca.jacobian(reached, z), reached, H / 2, h / 2, stage]
        self._stage = ca.Function("stage", [z, theta], [ca.densify(part) for part in parts])
        self._terminal = ca.Function("terminal", [x, theta], [ca.densify(part) for part in (P / 2, p / 2, terminal)])
        self._mpc = mpc

    def __call__(self, theta: Array) -> LinearQuadratic:
        """The matrices for theta ``(size,)``, or ``(N + 1, size)`` with one theta a stage."""
        mpc, n = self._mpc, self._mpc.horizon
        rows = np.atleast_2d(theta)
        origin = np.zeros(mpc.nx + mpc.nu)
        stages = [[part.full() for part in self._stage(origin, row)] for row in (rows[:-1] if len(rows) > 1 else rows)]
        AB, c, H, h, offset = (
            np.broadcast_to(np.stack(parts), (n, *parts[0].shape)) for parts in zip(*stages, strict=True)
        )
        P, p, v = (part.full() for part in self._terminal(origin[: mpc.nx], rows[-1]))
        A, B = AB[:, :, : mpc.nx], AB[:, :, mpc.nx :]
        terminal = P, p[:, 0], float(v[0, 0])
        return LinearQuadratic(A, B, c[..., 0], H, h[..., 0], offset[:, 0, 0], *terminal, mpc.discount)


class Riccati:
    """The solution of a linear-quadratic problem without input bounds, and what is needed to respect bounds.

    The discounted Riccati recursion: with V_k(x) = x'P_k x + 2 p_k'x + v_k,

        M_k = H_k + gamma (A_k B_k)' P_{k+1} (A_k B_k),      u_k = K_k x_k + kappa_k + nu_k,      K_k = -Muu^-1 Mux

    every input sequence costs V_0(x_0) + sum_k gamma^k nu_k' Muu_k nu_k. The best one has nu = 0; under bounds the
    problem is to find the least-norm nu that keeps u within them.

    Args:
        problem: The matrices.

    Attributes:
        definite: Whether all Muu_k are positive definite; otherwise there is no unique solution, and nothing else
            of this object is defined.
        P: ``(N + 1, nx, nx)``.
        p: ``(N + 1, nx)``.
        v: ``(N + 1,)``.
        K: Gains, ``(N, nu, nx)``.
        kappa: Offsets, ``(N, nu)``.
    """

    def __init__(self, problem: LinearQuadratic) -> None:
        self.problem = problem
        n, nx, nu = problem.B.shape
        self.P, self.p, self.v = np.empty((n + 1, nx, nx)), np.empty((n + 1, nx)), np.empty(n + 1)
        self.K, self.kappa = np.empty((n, nu, nx)), np.empty((n, nu))
        self._factors = np.empty((n, nu, nu))  # C with Muu = C C'
        self.P[n], self.p[n], self.v[n] = problem.W, problem.w, problem.t
        self.definite = self._recursion()

    def _recursion(self) -> bool:
        """Fills all attributes from the last stage to the first; False where a Muu is not positive definite."""
        problem, gamma = self.problem, self.problem.discount
        nx = problem.A.shape[1]
        for k in reversed(range(problem.horizon)):
            AB = np.hstack([problem.A[k], problem.B[k]])
            PAB = self.P[k + 1] @ AB
            c, ahead = problem.c[k], self.P[k + 1] @ problem.c[k] + self.p[k + 1]
            M = problem.H[k] + gamma * AB.T @ PAB
            m = problem.h[k] + gamma * AB.T @ ahead
            factor = _cholesky(M[nx:, nx:])
            if factor is None:
                return False
            gains = -np.linalg.solve(factor.T, np.linalg.solve(factor, np.column_stack([M[nx:, :nx], m[nx:]])))
            self._factors[k], self.K[k], self.kappa[k] = factor, gains[:, :nx], gains[:, nx]
            P = M[:nx, :nx] + M[:nx, nx:] @ self.K[k]
            self.P[k], self.p[k] = (P + P.T) / 2.0, m[:nx] + M[:nx, nx:] @ self.kappa[k]
            constant = c @ ahead + c @ self.p[k + 1] + self.v[k + 1]
            self.v[k] = problem.offset[k] + gamma * constant + m[nx:] @ self.kappa[k]
        return bool(np.isfinite(self.P).all() and np.isfinite(self.p).all())

    def value(self, x: Array) -> Array:
        """V_0 of states ``(B, nx)``, ``(B,)``."""
        return np.asarray(((x @ self.P[0] + 2.0 * self.p[0]) * x).sum(axis=1) + self.v[0])

    def residual(self, x: Array) -> Array:
        """A bound on :meth:`LinearQuadratic.optimality` of :meth:`trajectories`, ``(B,)``, at the cost of one product.

        Without bounds the first-order conditions are affine in x: they are computed once, for a basis.
        """
        return np.asarray(np.abs(x) @ self._basis_residuals[:-1] + self._basis_residuals[-1])

    @cached_property
    def _basis_residuals(self) -> Array:
        """Residuals of the first-order conditions for x = 0 (last) and what each unit vector adds, ``(nx + 1,)``."""
        _, nx, nu = self.problem.B.shape
        z = np.eye(nx + 1)
        x, u = self._closed_loop(z)
        return self.problem.optimality(
            x, u, _times(self.P, x) + self.p * z[:, nx, None, None], np.full(nu, -np.inf), np.full(nu, np.inf), z[:, nx]
        )

    def trajectories(self, x: Array) -> tuple[Array, Array]:
        """The best states ``(B, N + 1, nx)`` and inputs ``(B, N, nu)`` without bounds, from states ``(B, nx)``."""
        return self._closed_loop(np.column_stack([x, np.ones(len(x))]))

    def _closed_loop(self, z: Array) -> tuple[Array, Array]:
        """States and inputs for rows (x_0, 1)."""
        n, nx, nu = self.problem.B.shape
        state_map, input_map = self._maps
        return (z @ state_map).reshape(len(z), n + 1, nx), (z @ input_map).reshape(len(z), n, nu)

    @cached_property
    def _maps(self) -> tuple[Array, Array]:
        """The closed loop as one matrix each, ``(nx + 1, (N + 1) nx)`` and ``(nx + 1, N nu)``, acting on (x_0, 1)."""
        problem = self.problem
        nx = problem.A.shape[1]
        state = np.hstack([np.eye(nx), np.zeros((nx, 1))])
        one = np.eye(nx + 1)[nx]
        states, inputs = [state], []
        for k in range(problem.horizon):
            u = self.K[k] @ state + np.outer(self.kappa[k], one)
            state = problem.A[k] @ state + problem.B[k] @ u + np.outer(problem.c[k], one)
            states.append(state)
            inputs.append(u)
        return np.vstack(states).T.copy(), (np.vstack(inputs).T.copy() if inputs else np.zeros((nx + 1, 0)))

    @cached_property
    def response(self) -> Array:
        """G ``(N nu, N nu)``: departures w add G w to the inputs.

        They cost |w|^2, as w_k = gamma^(k/2) C_k' nu_k with Muu_k = C_k C_k'. Written in w the QP is a least-distance
        problem, well conditioned also where the model is unstable.
        """
        problem = self.problem
        n, nx, nu = problem.B.shape
        G, state = np.zeros((n * nu, n * nu)), np.zeros((nx, n * nu))
        for k in range(n):
            block = slice(k * nu, (k + 1) * nu)
            G[block] = self.K[k] @ state
            G[block, block] += np.linalg.inv(self._factors[k]).T * problem.discount ** (-k / 2)
            state = problem.A[k] @ state + problem.B[k] @ G[block]
        return G


def _cholesky(matrix: Array) -> Array | None:
    """The lower factor of a matrix, or None where it is not safely positive definite."""
    if not np.isfinite(matrix).all():
        return None
    try:
        factor = np.asarray(np.linalg.cholesky((matrix + matrix.T) / 2.0))
    except np.linalg.LinAlgError:
        return None
    pivots = np.diag(factor) ** 2
    return factor if (pivots > _SINGULAR * np.maximum(np.diag(matrix), 0.0).max(initial=0.0)).all() else None


def _times(matrices: Array, vectors: Array) -> Array:
    """``(N, i, j)`` times ``(B, N, j)``, stage by stage: ``(B, N, i)``."""
    return np.asarray(np.matmul(matrices, vectors[..., None])[..., 0])


def _largest(array: Array) -> Array:
    """The largest magnitude along the last axis."""
    return np.asarray(np.abs(array).max(axis=-1, initial=0.0))
