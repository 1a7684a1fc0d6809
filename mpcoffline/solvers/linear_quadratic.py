"""The linear-quadratic special case of (MPC): its matrices, its Riccati recursion, and the QP that input bounds make.

With z = (x, u) - (x_ref, u_ref), so that no digits are lost far from zero, and an index k on all matrices where theta
is given for each stage::

    f_th(x, u) = A x + B u + c,      Lhat_th(x, u) = z'H z + 2 h'z + l,      T_th(x) = x'W x + 2 w'x + t
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC, StageCost, TerminalCost, expressions

_TOUCHING = 1e-9  # distance from a bound that counts as none, relative to the range or, without one, to |u|
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
    """Whether every minimum is global, for every theta: affine model and limits, convex costs."""
    costs = promises_convexity(mpc.stage_cost) and promises_convexity(mpc.terminal_cost)
    return costs and is_affine(mpc) and _has_affine_limits(mpc)


def _has_affine_limits(mpc: MPC) -> bool:
    """Whether h is affine in (x, u) for every theta, wherever there is one: penalties are convex and grow with it."""
    if mpc.constraints is None:
        return True
    x, u, theta = _symbols(mpc)
    along = [mpc.constraint_expression(c)(x, u, theta) for c in mpc.constraints_at("stages")]
    end = [mpc.constraint_expression(c)(x, theta) for c in mpc.constraints_at("end")]
    return expressions.is_affine(ca.Function("h", [x, u, theta], [ca.densify(ca.vertcat(ca.SX(0, 1), *along, *end))]))


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
        x_ref: What states are counted from, ``(nx,)``.
        u_ref: What inputs are counted from, ``(nu,)``.
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
    x_ref: Array
    u_ref: Array

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
        matrices, whatever the trajectories and costates come from; each element is compared with its own terms, so that
        no unit matters. ``affine (B,)`` scales c, h and w.
        """
        nx = x.shape[2]
        c, h, w = (np.multiply.outer(np.asarray(affine), part) for part in (self.c, self.h, self.w))
        z = np.concatenate([x[:, :-1], u], axis=2)
        AB = np.concatenate([self.A, self.B], axis=2)
        ABt = self.discount * AB.transpose(0, 2, 1)
        gradient = _times(self.H, z) + h + _times(ABt, costates[:, 1:])
        terms = _times(abs(self.H), abs(z)) + abs(h) + _times(abs(ABt), abs(costates[:, 1:]))
        slope = gradient[:, :, nx:]
        room = np.where(slope > 0.0, u - low, high - u)  # in the direction of descent
        bound = np.where(slope > 0.0, low, high)
        known = np.where(np.isfinite(bound), abs(bound), 0.0)
        slope = np.where(room <= _TOUCHING * np.minimum(high - low, known + abs(u)), 0.0, slope)
        adjoint, here = gradient[:, :, :nx] - costates[:, :-1], terms[:, :, :nx] + abs(costates[:, :-1])
        dynamics, moved = x[:, 1:] - (_times(AB, z) + c), abs(x[:, 1:]) + _times(abs(AB), abs(z)) + abs(c)
        last = costates[:, -1] - (x[:, -1] @ self.W + w)
        end = abs(x[:, -1]) @ abs(self.W) + abs(w) + abs(costates[:, -1])
        residuals = (
            _relative(adjoint, here),
            _relative(slope, terms[:, :, nx:]),
            _relative(dynamics, moved),
            _relative(last[:, None], np.maximum(end, here.max(axis=1, initial=0.0))[:, None]),
        )
        return np.asarray(np.maximum.reduce([part.max(axis=(1, 2), initial=0.0) for part in residuals]))


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
        # Where states and inputs are counted from; zero where the costs have no reference.
        self._references = [
            next((mpc.space.slices[name] for name in names if _is_vector(mpc, name, size)), None)
            for names, size in (
                (("stage_cost.x_ref", "terminal_cost.x_ref"), mpc.nx),
                (("stage_cost.u_ref",), mpc.nu),
            )
        ]

    def __call__(self, theta: Array) -> LinearQuadratic:
        """The matrices for theta ``(size,)``, or ``(N + 1, size)`` with one theta a stage."""
        mpc, n = self._mpc, self._mpc.horizon
        rows = np.atleast_2d(theta)
        x_ref, u_ref = (
            np.zeros(size) if part is None else rows[0, part]
            for part, size in zip(self._references, (mpc.nx, mpc.nu), strict=True)
        )
        origin = np.r_[x_ref, u_ref]
        stages = [[part.full() for part in self._stage(origin, row)] for row in (rows[:-1] if len(rows) > 1 else rows)]
        AB, c, H, h, offset = (
            np.broadcast_to(np.stack(parts), (n, *parts[0].shape)) for parts in zip(*stages, strict=True)
        )
        P, p, v = (part.full() for part in self._terminal(origin[: mpc.nx], rows[-1]))
        A, B = AB[:, :, : mpc.nx], AB[:, :, mpc.nx :]
        terminal = P, p[:, 0], float(v[0, 0])
        steps = c[..., 0] - x_ref
        return LinearQuadratic(A, B, steps, H, h[..., 0], offset[:, 0, 0], *terminal, mpc.discount, x_ref, u_ref)


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

    p: Array
    v: Array
    kappa: Array

    def __init__(self, problem: LinearQuadratic) -> None:
        self.problem = problem
        n, nx, nu = problem.B.shape
        self.P, self.p, self.v = np.empty((n + 1, nx, nx)), np.empty((n + 1, nx)), np.empty(n + 1)
        self.K, self.kappa = np.empty((n, nu, nx)), np.empty((n, nu))
        self._factors = np.empty((n, nu, nu))  # C with Muu = C C'
        self.P[n], self.p[n], self.v[n] = problem.W, problem.w, problem.t
        self.definite: bool = self._recursion()

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

    @cached_property
    def residual(self) -> float:
        """A bound on :meth:`LinearQuadratic.optimality` of all :meth:`trajectories`.

        Without bounds they are sums of what x = 0 and each unit vector give, of which this is the largest residual.
        """
        _, nx, nu = self.problem.B.shape
        z = np.eye(nx + 1)
        x, u = self._closed_loop(z)
        costates = _times(self.P, x) + self.p * z[:, nx, None, None]
        bounds = np.full(nu, -np.inf), np.full(nu, np.inf)
        return float(self.problem.optimality(x, u, costates, *bounds, z[:, nx]).max())

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
    return factor if (pivots > _SINGULAR * np.diag(matrix)).all() else None


def _times(matrices: Array, vectors: Array) -> Array:
    """``(N, i, j)`` times ``(B, N, j)``, stage by stage: ``(B, N, i)``."""
    return np.asarray(np.matmul(matrices, vectors[..., None])[..., 0])


def _relative(errors: Array, terms: Array) -> Array:
    """Magnitudes of errors ``(B, N, i)`` relative to the largest of their terms so far along the stages, 0 where none.

    So far: where the states grow along the horizon, the last ones must not hide the errors of the first; where they
    vanish, the last ones are exact to a part of the first.
    """
    sizes = np.maximum.accumulate(terms, axis=1)
    return np.asarray(np.abs(errors) / np.where(sizes > 0.0, sizes, 1.0))


def _is_vector(mpc: MPC, name: str, size: int) -> bool:
    """Whether there is a parameter of that name and shape ``(size,)``."""
    return any(block.name == name and block.shape == (size,) for block in mpc.space)
