"""LQRSolver: linear model, quadratic costs; the Riccati recursion, and a QP where input bounds are active."""

from __future__ import annotations

import time
from collections import OrderedDict

import daqp
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.checks import check_integers
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

from .interface import SOLVERS, OneAtATime, Solution, Solver
from .ipopt.solver import IpoptSolver
from .linear_quadratic import Extraction, LinearQuadratic, Riccati, misfit
from .plan import Plan
from .status import Stats, Status

_TOLERANCE = 1e-8
_INFINITE = 1e30  # daqp's
_UPPER, _LOWER = 1, 3  # daqp's marks of a bound that is active from the start
_SETTINGS = {"primal_tol": 1e-11, "dual_tol": 1e-12, "iter_limit": 10_000}
_REASONS = {-1: "infeasible", -2: "cycling", -3: "unbounded", -4: "iteration limit", -5: "not convex"}


@SOLVERS.register("lqr")
class LQRSolver(Solver):
    """The exact solution of linear-quadratic problems, in numpy.

    For each theta the discounted Riccati recursion is run once and kept; a batch of problems is then one matrix
    product. Where that solution leaves the input bounds, a QP in the departures from it is solved by daqp, a dual
    active-set method, which finds the active bounds and with them the exact solution; a warm start says which bounds
    to try first. Where daqp fails (unstable models that saturated inputs cannot hold), ipopt takes over.

    ``success`` says that the first-order conditions hold along the trajectory, which is decisive as the problem is
    convex; ``stats["residual"]`` says how well, each relative to the size of its own terms.

    A theta whose Hessian with respect to the inputs is singular or indefinite at some stage (inputs free of cost
    that also change nothing that costs) has no unique solution: its problems are passed on to ipopt, and
    their status says so.

    References: discounted Riccati recursion: Bertsekas, "Dynamic Programming and Optimal Control", vol. 1; QP:
    Arnstroem, Bemporad, Axehill, "A dual active-set solver for embedded quadratic programming using recursive LDL'
    updates", IEEE TAC 67(8), 2022.

    Args:
        mpc: The problem: a model that is affine in (x, u), quadratic stage and terminal costs, no constraints but
            input bounds.
        cache_size: Number of thetas whose recursion is kept.

    Raises:
        InvalidArgumentError: For another structure; the message says what does not fit.
    """

    relative_speed = 2000.0
    theta_dimensions = (1, 2, 3)

    def __init__(self, mpc: MPC, *, cache_size: int = 8) -> None:
        super().__init__(mpc, cache_size=cache_size)
        check_integers(1, cache_size=cache_size)
        self._extraction = Extraction(mpc)
        self._low, self._high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
        self._cache: OrderedDict[bytes, _Controller] = OrderedDict()
        self._cache_size = cache_size
        self._ipopt: IpoptSolver | None = None
        self._alone = OneAtATime()

    @classmethod
    def refuses(cls, mpc: MPC) -> str:
        """See :meth:`Solver.refuses`."""
        return misfit(mpc)

    def _solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan | None) -> Solution:
        start = time.perf_counter()
        with self._alone:  # daqp works in memory that a solver has once
            if theta.ndim == 1:
                solution = self._solve_with(theta, x, u0, warm_start)
            else:
                solution = self._solve_each(theta, x, u0, warm_start)
        solution.stats["time"], solution.stats["all_starts"] = time.perf_counter() - start, True
        return solution

    def _solve_each(self, theta: Array, x: Array, u0: Array | None, warm_start: Plan | None) -> Solution:
        """Problems with thetas of their own, those with equal ones together."""
        _, group = np.unique(theta.reshape(len(theta), -1), axis=0, return_inverse=True)
        result = _empty(len(x), self.mpc)
        for k in range(group.max() + 1):
            rows = np.flatnonzero(group == k)
            warm = _part(warm_start, rows)
            _put(result, rows, self._solve_with(theta[rows[0]], x[rows], None if u0 is None else u0[rows], warm))
        return result

    def _solve_with(self, theta: Array, x: Array, u0: Array | None, warm_start: Plan | None) -> Solution:
        """The problems of one theta, ``(size,)`` or ``(N + 1, size)``."""
        controller = self._controller(theta)
        if not controller.definite(u0 is not None):
            return self._by_ipopt(theta, x, u0, warm_start, "no unique solution by Riccati")
        solution = controller.solve(x, u0, warm_start)
        lost = np.flatnonzero(~solution.success)
        if len(lost):
            warm = _part(warm_start, lost)
            reason = solution.words[lost[0]]
            _put(solution, lost, self._by_ipopt(theta, x[lost], None if u0 is None else u0[lost], warm, reason))
        return solution

    def _by_ipopt(self, theta: Array, x: Array, u0: Array | None, warm_start: Plan | None, reason: str) -> Solution:
        if self._ipopt is None:
            self._ipopt = IpoptSolver(self.mpc)
        every = theta if theta.ndim == 1 else theta[None]
        solution = self._ipopt.solve(x, every, u0, warm_start)
        solution.stats["words"] = [f"ipopt, as {reason}: {words}" for words in solution.words]
        return solution

    def _controller(self, theta: Array) -> _Controller:
        key = theta.tobytes()
        if key not in self._cache:
            self._cache[key] = _Controller(self._extraction(theta), self._low, self._high)
            if len(self._cache) > self._cache_size:
                self._cache.popitem(last=False)
        self._cache.move_to_end(key)
        return self._cache[key]


class _Controller:
    """What is computed once a theta."""

    def __init__(self, problem: LinearQuadratic, low: Array, high: Array) -> None:
        self._problem, self._bounds = problem, (low, high)
        self._low, self._high = low - problem.u_ref, high - problem.u_ref
        self._free = Riccati(problem)
        self._rest: Riccati | None = None
        self._programs: dict[bool, _BoundedInputs] = {}

    def definite(self, imposed: bool) -> bool:
        """Whether the recursion went through; with the first input imposed, as far as the second stage."""
        return self._riccati(imposed).definite

    def _riccati(self, imposed: bool) -> Riccati:
        if not imposed:
            return self._free
        if self._rest is None:
            self._rest = Riccati(self._problem.tail())
        return self._rest

    def solve(self, x: Array, u0: Array | None, warm_start: Plan | None) -> Solution:
        """The problems from ``x (B, nx)``; with ``u0 (B, nu)`` given, the rest of them from its successor."""
        problem, imposed, given, first = self._problem, u0 is not None, x, u0
        riccati, skipped = self._riccati(imposed), int(imposed)
        x, u0 = x - problem.x_ref, None if u0 is None else u0 - problem.u_ref
        begin = x if u0 is None else x @ problem.A[0].T + u0 @ problem.B[0].T + problem.c[0]
        states, inputs = riccati.trajectories(begin)
        value, residual = riccati.value(begin), np.full(len(x), riccati.residual)
        iterations, words = np.zeros(len(x), dtype=np.int64), ["Riccati"] * len(x)
        rows = np.flatnonzero(((inputs < self._low) | (inputs > self._high)).any(axis=(1, 2)))
        if len(rows):
            program, rest = self._program(imposed, riccati), riccati.problem
            for i in rows:
                guess = None if warm_start is None else warm_start.u[i, skipped:] - problem.u_ref
                inputs[i], iterations[i], words[i] = program.solve(inputs[i], guess)
            states[rows] = rest.rollout(begin[rows], inputs[rows])
            bounded = states[rows], inputs[rows]
            value[rows] = rest.cost(*bounded)
            residual[rows] = rest.optimality(*bounded, rest.costates(*bounded), self._low, self._high)
        success = np.isfinite(value) & (residual <= _TOLERANCE)
        status = [Status.CONVERGED] * len(x)
        for i in np.flatnonzero(~success):
            status[i], words[i] = Status.NOT_OPTIMAL, f"{words[i]} left a residual of {residual[i]:.1e}"
        if u0 is not None:
            z = np.concatenate([x, u0], axis=1)
            stage = np.einsum("bi,ij,bj->b", z, problem.H[0], z) + 2.0 * z @ problem.h[0] + problem.offset[0]
            value = stage + problem.discount * value
            states = np.concatenate([x[:, None], states], axis=1)
            inputs = np.concatenate([u0[:, None], inputs], axis=1)
        states, inputs = states + problem.x_ref, inputs + problem.u_ref
        states[:, 0] = given
        inputs = np.clip(inputs, *self._bounds)
        if first is not None:
            inputs[:, 0] = first
        stats: Stats = {"iterations": iterations, "time": 0.0, "residual": residual, "words": words}
        return Solution(inputs[:, 0].copy(), states, inputs, value, success, status, stats)

    def _program(self, imposed: bool, riccati: Riccati) -> _BoundedInputs:
        if imposed not in self._programs:
            self._programs[imposed] = _BoundedInputs(riccati.response, self._low, self._high)
        return self._programs[imposed]


class _BoundedInputs:
    """The QP min |w|^2 with low <= u + G w <= high, u being the inputs without bounds.

    Args:
        G: What w adds to the inputs, ``(N nu, N nu)``, see :attr:`Riccati.response`.
        low: ``(nu,)``.
        high: ``(nu,)``.
    """

    def __init__(self, G: Array, low: Array, high: Array) -> None:
        n = len(G)
        self._G, self._low, self._high = G, low, high
        # daqp's tolerances are absolute: its rows are of length 1, its bounds the violations relative to the largest.
        lengths = np.linalg.norm(G, axis=1)
        self._lengths = np.where(lengths > 0.0, lengths, 1.0)
        self._model = daqp.Model()
        self._model.settings = _SETTINGS
        wide, rows = np.full(n, _INFINITE), np.ascontiguousarray(G / self._lengths[:, None])
        # Whether daqp copies what it is given or points to it: all of it lives as long as this object.
        self._data = (np.eye(n), np.zeros(n), rows, wide, -wide, np.zeros(n, dtype=np.intc))
        self._model.setup(*self._data)

    def solve(self, u: Array, guess: Array | None) -> tuple[Array, int, str]:
        """The best inputs within the bounds ``(N, nu)``, iterations, and how it went.

        Args:
            u: The inputs without bounds, ``(N, nu)``, some of them beyond.
            guess: Inputs of a plan ``(N, nu)``, whose active bounds are tried first; None, or NaN, for none.
        """
        sense = np.zeros(u.size, dtype=np.intc)
        if guess is not None:
            sense[(guess >= self._high).ravel()] = _UPPER
            sense[(guess <= self._low).ravel()] = _LOWER
        upper, lower = ((bound - u).ravel() / self._lengths for bound in (self._high, self._low))
        largest = max(float(lower.max()), float(-upper.min()))
        self._model.update(
            bupper=np.minimum(upper / largest, _INFINITE), blower=np.maximum(lower / largest, -_INFINITE), sense=sense
        )
        w, _, flag, info = self._model.solve()
        iterations = int(info["iterations"])
        if flag <= 0 or not np.isfinite(w).all():
            # A guess that the conditions of an optimum then confirm, or refute.
            reason = f"clipped Riccati, as daqp says {_REASONS.get(flag, flag)}"
            return np.clip(u, self._low, self._high), iterations, reason
        return np.clip(u + largest * (self._G @ w).reshape(u.shape), self._low, self._high), iterations, "QP"


def _part(plan: Plan | None, rows: NDArray[np.intp]) -> Plan | None:
    """The plans of some problems."""
    return None if plan is None else Plan(plan.x[rows], plan.u[rows])


def _empty(n: int, mpc: MPC) -> Solution:
    plan = Plan.none(n, mpc)
    iterations = np.zeros(n, dtype=np.int64)
    stats: Stats = {"iterations": iterations, "time": 0.0, "residual": np.zeros(n), "words": [""] * n}
    u0, value, success = np.empty((n, mpc.nu)), np.empty(n), np.zeros(n, dtype=bool)
    return Solution(u0, plan.x, plan.u, value, success, [Status.NOT_OPTIMAL] * n, stats)


def _put(target: Solution, rows: NDArray[np.intp], part: Solution) -> None:
    """Writes the solution of some problems into that of all."""
    for name in ("u0", "x", "u", "value", "success"):
        getattr(target, name)[rows] = getattr(part, name)
    target.stats["iterations"][rows] = part.stats["iterations"]
    target.stats["residual"][rows] = part.stats["residual"]
    for row, status, words in zip(rows, part.status, part.words, strict=True):
        target.status[row], target.stats["words"][row] = status, words
