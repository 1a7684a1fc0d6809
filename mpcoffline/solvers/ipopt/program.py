"""The compiled nonlinear programs of an MPC, and the tests of what ipopt returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.solvers.interface import Plan
from mpcoffline.solvers.starts import candidate_inputs
from mpcoffline.solvers.status import Status

from .transcription import Multipliers, Transcription

_FEASIBILITY_TOLERANCE = 1e-6  # of the size of the states
_OPTIMALITY_TOLERANCE = 1e-5  # of the size of the terms of the gradient
_ENDS = {  # what ipopt says of itself, where its point did not pass the tests
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
}


class Programs:
    """The programs of an MPC, each built when first used.

    Args:
        mpc: The problem.
        options: ``n_starts``, ``tolerance``, ``max_iterations`` and ``max_time`` of :class:`IpoptSolver`.
    """

    def __init__(self, mpc: MPC, options: Mapping[str, Any]) -> None:
        self._mpc, self._options, self._candidates = mpc, dict(options), candidate_inputs(mpc)

    @cached_property
    def common(self) -> Program:
        """The program of one theta for all stages."""
        return Program(self._mpc, self._candidates, **self._options)

    @cached_property
    def _stagewise(self) -> Program:
        """The program of one theta a stage."""
        return Program(self._mpc, self._candidates, **self._options, stagewise=True)

    def solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan) -> list[Found]:
        """Solves the problems one after the other; arguments as checked by ``Solver.solve``."""
        program = self._stagewise if theta.ndim == 3 else self.common
        known = warm_start.known
        return [
            program.solve(
                state,
                theta if theta.ndim == 1 else theta[i],
                None if u0 is None else u0[i],
                (warm_start.x[i], warm_start.u[i]) if known[i] else None,
            )
            for i, state in enumerate(x)
        ]


@dataclass(frozen=True)
class Found:
    """One problem's solution.

    Attributes:
        x: ``(N + 1, nx)``.
        u: ``(N, nu)``.
        value: The objective.
        status: Whether the trajectory passed all tests, and if not, why.
        words: ipopt's word, and what is wrong.
        iterations: Of ipopt, all starts together.
        residual: Of the first-order conditions, relative.
        violation: Of the constraint that is violated most; 0 where all hold.
    """

    x: Array
    u: Array
    value: float
    status: Status
    words: str
    iterations: int
    residual: float
    violation: float

    @property
    def success(self) -> bool:
        """Whether the trajectory passed all tests."""
        return self.status is Status.CONVERGED


class Program:
    """The compiled program: one for the Gauss-Newton, one for the exact Hessian."""

    def __init__(
        self,
        mpc: MPC,
        candidates: Array,
        *,
        n_starts: int,
        tolerance: float,
        max_iterations: int,
        max_time: float,
        stagewise: bool = False,
    ) -> None:
        self._mpc, self._candidates, self._n_starts = mpc, candidates, n_starts
        self._problem = Transcription(mpc, stagewise)
        common = {"print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": max_iterations}
        if np.isfinite(max_time):
            common["max_wall_time"] = max_time / (n_starts + 2)
        warm = {"warm_start_init_point": "yes", "mu_init": 1e-4}
        self._cold = _ipopt("cold", self._problem, common, {"hess_lag": _cost_curvature(self._problem)})
        self._exact = _ipopt("exact", self._problem, common | warm, {})

    def solve(self, state: Array, theta: Array, u0: Array | None, guess: tuple[Array, Array] | None) -> Found:
        """One problem: warm from a guess if that works, else cold from several starts and polished."""
        iterations = 0
        p = np.r_[state, theta.ravel()]  # theta (N + 1, size) by rows is CasADi's (size, N + 1) by columns
        if guess is not None:
            warm = self._call(self._exact, p, u0, guess)
            if warm.success:
                return warm
            iterations = warm.iterations
        attempts = [self._call(self._cold, p, u0, start) for start in self._starts(state, theta, u0)]
        best = min(attempts, key=lambda attempt: (not attempt.success, attempt.violation, attempt.value))
        polished = self._call(self._exact, p, u0, (best.x, best.u))
        iterations += sum(attempt.iterations for attempt in [*attempts, polished])
        if polished.success and (not best.success or polished.value <= best.value + 1e-6 * (1.0 + abs(best.value))):
            best = polished
        return replace(best, iterations=iterations)

    def excess(self, state: Array, u: Array, theta: Array) -> float:
        """By how much a plan violates a hard constraint; zero within the tolerance, inf if it is not finite."""
        p = np.r_[state, theta.ravel()]
        x = np.vstack([state, self._problem.simulate(u.T, p).full().T])
        if not (np.isfinite(x).all() and np.isfinite(u).all()):
            return np.inf
        violation, _ = self._problem.violation(self._problem.pack(x, u, p), p)
        return 0.0 if violation <= _tolerated(x) else violation

    def _starts(self, state: Array, theta: Array, u0: Array | None) -> list[tuple[Array, Array]]:
        """The ``n_starts`` cheapest of the candidate input sequences, with the states that they lead to."""
        inputs = self._candidates.copy()
        if u0 is not None:
            inputs[:, 0] = u0
        n, horizon, nu = inputs.shape
        along = np.broadcast_to(theta, (horizon + 1, theta.shape[-1])).T
        states, costs = self._problem.rollout_candidates(state, inputs.reshape(n * horizon, nu).T, along)
        trajectories = states.full().T.reshape(n, horizon, self._mpc.nx)
        cost = np.nan_to_num(costs.full().ravel(), nan=np.inf, posinf=np.inf)
        order = np.argsort(cost, kind="stable")[: self._n_starts]
        first = np.broadcast_to(state, (1, self._mpc.nx))
        return [
            (np.concatenate([first, trajectories[i]]), inputs[i]) for i in order if np.isfinite(trajectories[i]).all()
        ] or [(np.repeat(first, horizon + 1, axis=0), inputs[0])]

    def _call(self, solver: ca.Function, p: Array, u0: Array | None, guess: tuple[Array, Array]) -> Found:
        """One run of ipopt, and the tests of what it returned."""
        problem, mpc = self._problem, self._mpc
        low, high = problem.bounds(u0)
        start = problem.pack(*guess, p)
        result = solver(x0=start, lbx=low, ubx=high, lbg=problem.constraint_low, ubg=0.0, p=p)
        stats = solver.stats()
        w = result["x"].full().ravel()
        planned, u = problem.unpack(w)
        u = np.clip(u, np.asarray(mpc.action_low), np.asarray(mpc.action_high))  # ipopt relaxes bounds by 1e-8
        simulated = problem.simulate(u.T, p).full().T
        followed = bool(np.isfinite(simulated).all())
        x = np.vstack([p[: mpc.nx], simulated if followed else planned])
        point = problem.pack(x, u, p)
        value = float(problem.appraise(point, p)[0])
        violation, where = problem.violation(point, p)
        multipliers = Multipliers(result["lam_x"].full().ravel(), result["lam_g"].full().ravel())
        residual = problem.optimality(point, p, u0, multipliers)
        word = str(stats["return_status"])
        status, failure = Status.CONVERGED, ""
        if not (followed and np.isfinite(value)):
            status, failure = Status.NOT_FINITE, ": the model run with the inputs found is not finite"
        elif not violation <= _tolerated(x):
            status, failure = _ENDS.get(word, Status.VIOLATED), f": {where} is violated by {violation:.3g}"
        elif not residual <= _OPTIMALITY_TOLERANCE:
            status = _ENDS.get(word, Status.NOT_OPTIMAL)
            failure = f": not optimal, the first-order conditions leave {residual:.1e}"
        return Found(x, u, value, status, word + failure, int(stats["iter_count"]), residual, violation)


def _tolerated(x: Array) -> float:
    """The violation of a constraint that still counts as none."""
    return _FEASIBILITY_TOLERANCE * (1.0 + float(np.abs(x).max()))


def _cost_curvature(problem: Transcription) -> ca.Function:
    """The Gauss-Newton Hessian for ipopt: the curvature of the cost, without that of the constraints."""
    hessian, _ = ca.hessian(problem.cost, problem.variables)
    cost_factor, multipliers = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", problem.constraints.numel())
    return ca.Function(
        "nlp_hess_l",
        [problem.variables, problem.parameters, cost_factor, multipliers],
        [ca.triu(cost_factor * hessian)],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )


def _ipopt(name: str, problem: Transcription, options: dict[str, Any], extra: dict[str, Any]) -> ca.Function:
    quiet = {"print_time": False, "show_eval_warnings": False, "record_time": False, "calc_lam_p": False}
    nlp = {"x": problem.variables, "f": problem.cost, "g": problem.constraints, "p": problem.parameters}
    return ca.nlpsol(name, "ipopt", nlp, quiet | {"ipopt": options} | extra)
