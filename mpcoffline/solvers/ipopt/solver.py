"""(MPC) as a nonlinear program for ipopt: any smooth model, cost and constraint; the oracle of the other solvers."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.solvers.interface import SOLVERS, OneAtATime, Solution, Solver
from mpcoffline.solvers.linear_quadratic import is_convex
from mpcoffline.solvers.options import check_options
from mpcoffline.solvers.plan import Plan
from mpcoffline.solvers.starts import N_CANDIDATES
from mpcoffline.solvers.status import Stats

from .program import Programs
from .workers import WorkerPool


@SOLVERS.register("ipopt")
class IpoptSolver(Solver):
    """Direct multiple shooting with CasADi and ipopt.

    A cold start rolls out many random input sequences, takes the best few as starting points, solves each with the
    Gauss-Newton Hessian (the cost's curvature alone, which needs no convexification and rarely fails), and
    polishes the best with the exact Hessian. A warm start goes to the exact Hessian at once. The starting points are
    fixed by a seed at construction, so that equal calls give equal results.

    ipopt sees variables, constraints and cost in units that each start's trajectory gives, so that its absolute
    tolerances fit; results are judged in those of the solution.

    What is returned is the model run with the inputs found, within their bounds, and what that costs. ``success`` says
    that this trajectory violates no constraint and that the first-order conditions hold at it
    (``stats["residual"]``), whatever ipopt returned. Otherwise ``words`` say what is wrong, e.g.
    ``"Infeasible_Problem_Detected: 'speed limit' at stage 3 is violated by 0.2"``.

    Args:
        mpc: The problem.
        n_starts: Starting points of a cold solve; by default 4, and 1 where the problem is convex.
        tolerance: ipopt's relative convergence tolerance, in these units.
        max_iterations: Bound on the iterations of each ipopt call.
        max_time: Bound on the time of a problem in s, shared out among its calls of ipopt, of which there are up to two
            more than starts. What it cuts short is not accepted, but returned.
        n_workers: Processes that share a batch (CasADi's threads crash with ipopt). They start with the first batch,
            which takes seconds, and end with the solver; results do not depend on their number.
    """

    theta_dimensions = (1, 2, 3)

    def __init__(
        self,
        mpc: MPC,
        *,
        n_starts: int | None = None,
        tolerance: float = 1e-8,
        max_iterations: int = 300,
        max_time: float = np.inf,
        n_workers: int = 1,
    ) -> None:
        super().__init__(
            mpc,
            n_starts=n_starts,
            tolerance=tolerance,
            max_iterations=max_iterations,
            max_time=max_time,
            n_workers=n_workers,
        )
        if n_starts is not None and not 1 <= n_starts <= N_CANDIDATES:
            raise InvalidArgumentError("n_starts", expected=f"from 1 to {N_CANDIDATES}", actual=str(n_starts))
        check_options(
            {
                "tolerance": tolerance,
                "max_iterations": max_iterations,
                "max_time": max_time,
                "n_workers": n_workers,
            }
        )
        program: dict[str, Any] = {
            "n_starts": n_starts or (1 if is_convex(mpc) else 4),
            "tolerance": tolerance,
            "max_iterations": max_iterations,
            "max_time": max_time,
        }
        self._programs = Programs(mpc, program)
        self._alone = OneAtATime()
        self._pool = WorkerPool(mpc, program, n_workers) if n_workers > 1 else None
        if self._pool is None:
            _ = self._programs.common  # built here, not at the first solve

    def _solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan | None) -> Solution:
        start = time.perf_counter()
        warm_start = warm_start or Plan.none(len(x), self.mpc)
        with self._alone:  # CasADi's functions keep one state each: threads in them at once crash
            if self._pool is not None and len(x) > 1:
                found = self._pool.solve(x, theta, u0, warm_start)
            else:
                found = self._programs.solve(x, theta, u0, warm_start)
        u = np.stack([one.u for one in found])
        stats: Stats = {
            "iterations": np.array([one.iterations for one in found]),
            "time": time.perf_counter() - start,
            "residual": np.array([one.residual for one in found]),
            "violation": np.array([one.violation for one in found]),
            "all_starts": True,
            "words": [one.words for one in found],
        }
        success, values = np.array([one.success for one in found]), np.array([one.value for one in found])
        trajectories = np.stack([one.x for one in found])
        return Solution(u[:, 0].copy(), trajectories, u, values, success, [one.status for one in found], stats)

    def violation(self, x: Array, u: Array) -> Array:
        """See :meth:`Solver.violation`."""
        return np.array([self._programs.common.excess(*one, self._theta) for one in zip(x, u, strict=True)])

    def close(self) -> None:
        """Ends the worker processes, if there are any; a later batch starts them again."""
        if self._pool is not None:
            with self._alone:
                self._pool.close()
