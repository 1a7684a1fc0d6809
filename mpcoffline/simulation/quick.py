"""MPCs as they act in simulations: in thousands of closed loops at once, near enough to how they act on the plant."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable
from typing import Any

import torch
from numpy.typing import NDArray

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.solvers import SOLVERS, CompilerError, DDPSolver, Plan, Solution
from mpcoffline.solvers.ddp.solver import STATUS
from mpcoffline.solvers.status import Status

_SLOW = 10.0  # times as fast as ipopt
_RETRIED = 0.1  # of the solves
_NEAR, _ITERATIONS = 1e-8, 60  # tolerance and iterations of simulated solves; a plant's own are nearer to the minimum
_FEW, _CARRIED = 10, 8  # iterations of solves from a plan, but of each eighth


class RealTimeSolver(DDPSolver):
    """A DDP solver of closed loops in simulation: most plans are made better by a few iterations, and taken.

    The state of a closed loop hardly moves from one step to the next, so that iterations which are left out in one are
    made in the next, from its plan. Where Gauss-Newton creeps, as on learned residuals, they are most of the time. Each
    eighth solve of a loop is carried through, like the first one: what fails then is counted, and tried from all
    starts, which leads out of a plan that leads nowhere.

    Reference: Diehl, Bock, Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback
    control", 2005, doi:10.1137/S0363012902400713.

    Args:
        mpc: The problem, without limits.
    """

    def __init__(self, mpc: MPC) -> None:
        # Threads change no digit.
        super().__init__(mpc, tolerance=_NEAR, max_iterations=_ITERATIONS, n_threads=torch.get_num_threads())
        self._step, self._hurried = 0, False

    def _solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan | None) -> Solution:
        begun = warm_start is None or not warm_start.known.any()
        self._step = 0 if begun else self._step + 1
        self._hurried = self._step % _CARRIED > 0
        self._problem.max_iterations = _FEW if self._hurried else self.max_iterations
        solution = super()._solve(x, theta, u0, warm_start)
        solution.stats["partial"] = self._hurried
        return solution

    def _run_warm(self, x: Array, theta: Array, u0: Array | None, plan: Plan) -> dict[str, NDArray[Any]]:
        result = super()._run_warm(x, theta, u0, plan)
        if self._hurried:  # an unfinished plan is one to act by
            status = result["status"]
            status[status == STATUS.index(Status.ITERATION_LIMIT)] = STATUS.index(Status.CONVERGED)
        return result


def are_slow(policies: Iterable[MPCPolicy]) -> bool:
    """Whether one of them has a slow solver, as ipopt."""
    return min(policy.solver.relative_speed for policy in policies) < _SLOW


def quick_policy(mpc: MPC) -> MPCPolicy:
    """A policy whose solver is fast in batches with active bounds, too: ``"ddp"`` where it takes the problem.

    Without limits its solves end within 1e-8 of the cost, or after a bounded number of iterations, see
    :class:`RealTimeSolver`. It takes as many threads as torch does.
    Where plans have several minima, as in swing-ups, another may be found than on the plant. Few are retried: an MPC of
    which many fail is no good one. What fails is counted, and told by those who ask; it is no warning, since nothing
    real moves.
    """
    if "ddp" in SOLVERS and not SOLVERS["ddp"].refuses(mpc):
        with contextlib.suppress(CompilerError):
            limited = mpc.constraints is not None
            solver = DDPSolver(mpc, n_threads=torch.get_num_threads()) if limited else RealTimeSolver(mpc)
            policy = MPCPolicy(mpc, solver)
            policy.retry_at_most(_RETRIED, logging.INFO)
            return policy
    return MPCPolicy(mpc)
