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
from mpcoffline.solvers.plan import Plan
from mpcoffline.solvers.starts import candidate_inputs
from mpcoffline.solvers.status import Status

from .transcription import Multipliers, Transcription
from .units import Units, units_at

_FEASIBILITY_TOLERANCE = 1e-6  # units of a constraint
_OPTIMALITY_TOLERANCE = 1e-3  # units of an input: the cost is flat at an optimum, so off by a millionth
_ALIKE = 1e-6  # costs that differ by less, relative, are of one minimum
_COMPARED = 4  # starts whose spread says what a state may be measured by
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
        value: The objective, the constants of the costs included.
        status: Whether the trajectory passed all tests, and if not, why.
        words: ipopt's word, and what is wrong.
        iterations: Of ipopt, all starts together.
        residual: Of the first-order conditions, relative.
        violation: Of the constraint that is violated most; 0 where all hold.
        excess: The same in units of that constraint.
    """

    x: Array
    u: Array
    value: float
    status: Status
    words: str
    iterations: int
    residual: float
    violation: float
    excess: float

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
        scaled = _Scaled(self._problem)
        self._cold = _ipopt("cold", scaled, common, {"hess_lag": _cost_curvature(scaled)})
        self._exact = _ipopt("exact", scaled, common | warm, {})

    def solve(self, state: Array, theta: Array, u0: Array | None, guess: tuple[Array, Array] | None) -> Found:
        """One problem: warm from a guess if that works, else cold from several starts and polished."""
        p = np.r_[state, theta.ravel()]  # theta (N + 1, size) by rows is CasADi's (size, N + 1) by columns
        found = self._solve(p, theta, u0, guess)
        return replace(found, value=found.value + float(self._problem.constant(p)))

    def _solve(self, p: Array, theta: Array, u0: Array | None, guess: tuple[Array, Array] | None) -> Found:
        iterations = 0
        if guess is not None:
            warm = self._call(self._exact, p, u0, guess)
            if warm.success:
                return warm
            iterations = warm.iterations
        starts, reached = self._starts(p[: self._mpc.nx], theta, u0)
        attempts = [self._call(self._cold, p, u0, start, reached) for start in starts]
        best = min(attempts, key=lambda attempt: (not attempt.success, attempt.excess, attempt.value))
        polished = self._call(self._exact, p, u0, (best.x, best.u), reached)
        iterations += sum(attempt.iterations for attempt in [*attempts, polished])
        slack = _ALIKE * abs(best.value)
        if polished.success and (not best.success or polished.value <= best.value + slack):
            best = polished
        return replace(best, iterations=iterations)

    def excess(self, state: Array, u: Array, theta: Array) -> float:
        """By how many units a plan violates a hard constraint; 0 within the tolerance, inf if it is not finite.

        The units are those of the cheapest start, so that plans from one state can be compared.
        """
        p = np.r_[state, theta.ravel()]
        x = np.vstack([state, self._problem.simulate(u.T, p).full().T])
        if not (np.isfinite(x).all() and np.isfinite(u).all()):
            return np.inf
        starts, reached = self._starts(state, theta, None)
        units = units_at(self._problem, self._problem.pack(*starts[0], p), p, reached)
        violation, *_ = self._problem.violation(self._problem.pack(x, u, p), p, units)
        return 0.0 if violation <= _FEASIBILITY_TOLERANCE else violation

    def _starts(self, state: Array, theta: Array, u0: Array | None) -> tuple[list[tuple[Array, Array]], Array]:
        """The ``n_starts`` cheapest of the candidate input sequences, with the states that they lead to.

        And the states that the cheapest few reach, ``(K, nx)``.
        """
        inputs = self._candidates.copy()
        if u0 is not None:
            inputs[:, 0] = u0
        n, horizon, nu = inputs.shape
        along = np.broadcast_to(theta, (horizon + 1, theta.shape[-1])).T
        states, costs = self._problem.rollout_candidates(state, inputs.reshape(n * horizon, nu).T, along)
        trajectories = states.full().T.reshape(n, horizon, self._mpc.nx)
        cost = np.nan_to_num(costs.full().ravel(), nan=np.inf, posinf=np.inf)
        order = np.argsort(cost, kind="stable")
        first = np.broadcast_to(state, (1, self._mpc.nx))
        finite = [i for i in order[: max(_COMPARED, self._n_starts)] if np.isfinite(trajectories[i]).all()]
        starts = [(np.concatenate([first, trajectories[i]]), inputs[i]) for i in finite[: self._n_starts]]
        reached = np.vstack([first, *(trajectories[i] for i in finite[:_COMPARED])])
        return starts or [(np.repeat(first, horizon + 1, axis=0), inputs[0])], reached

    def _call(
        self, solver: ca.Function, p: Array, u0: Array | None, guess: tuple[Array, Array], reached: Array | None = None
    ) -> Found:
        """One run of ipopt, and the tests of what it returned.

        Where they fail in the units of the solution and these are much smaller than those of the guess, a second one.
        """
        start = self._problem.pack(*guess, p)
        units = units_at(self._problem, start, p, reached)
        found, own = self._run(solver, p, u0, start, units, reached)
        if not found.success and found.status is not Status.NOT_FINITE and _smaller(own, units):
            again, _ = self._run(solver, p, u0, self._problem.pack(found.x, found.u, p), own, reached)
            if again.success:
                return replace(again, iterations=found.iterations + again.iterations)
        return found

    def _run(
        self, solver: ca.Function, p: Array, u0: Array | None, start: Array, units: Units, reached: Array | None
    ) -> tuple[Found, Units]:
        """One run in these units, the tests of what it returned in the units of that, and these."""
        problem, mpc = self._problem, self._mpc
        low, high = ((bound - units.centre) / units.variables for bound in problem.bounds(u0))
        scaled = (start - units.centre) / units.variables
        parameters = np.r_[p, units.parameters]
        result = solver(x0=scaled, lbx=low, ubx=high, lbg=problem.constraint_low, ubg=0.0, p=parameters)
        stats = solver.stats()
        planned, u = problem.unpack(units.centre + units.variables * result["x"].full().ravel())
        u = np.clip(u, np.asarray(mpc.action_low), np.asarray(mpc.action_high))  # ipopt relaxes bounds by 1e-8
        if u0 is not None:
            u[0] = u0
        simulated = problem.simulate(u.T, p).full().T
        followed = bool(np.isfinite(simulated).all())
        x = np.vstack([p[: mpc.nx], simulated if followed else planned])
        point = problem.pack(x, u, p)
        value = float(problem.appraise(point, p)[0])
        own = units_at(problem, point, p, reached)
        excess, violation, where = problem.violation(point, p, own)
        multipliers = Multipliers(
            result["lam_x"].full().ravel() * units.cost / units.variables,
            result["lam_g"].full().ravel() * units.cost / units.constraints,
        )
        residual = problem.optimality(point, p, u0, multipliers, own)
        word = str(stats["return_status"])
        status, failure = Status.CONVERGED, ""
        if not (followed and np.isfinite(value)):
            status, failure = Status.NOT_FINITE, ": the model run with the inputs found is not finite"
        elif not excess <= _FEASIBILITY_TOLERANCE:
            status, failure = _ENDS.get(word, Status.VIOLATED), f": {where} is violated by {violation:.3g}"
        elif not residual <= _OPTIMALITY_TOLERANCE:
            status = _ENDS.get(word, Status.NOT_OPTIMAL)
            failure = f": not optimal, the first-order conditions leave {residual:.1e}"
        found = Found(x, u, value, status, word + failure, int(stats["iter_count"]), residual, violation, excess)
        return found, own


def _smaller(own: Units, units: Units) -> bool:
    """Whether a variable's unit is much smaller than another."""
    return bool((own.variables < 0.1 * units.variables).any())


class _Scaled:
    """The program in units: its variables are (w - centre) / unit, its parameters have the units behind them."""

    def __init__(self, problem: Transcription) -> None:
        n, m = problem.variables.numel(), problem.constraints.numel()
        self.variables = ca.SX.sym("z", n)
        centre, unit, constraints, cost = (
            ca.SX.sym(name, size) for name, size in zip("cdgf", (n, n, m, 1), strict=True)
        )
        self.parameters = ca.vertcat(problem.parameters, centre, unit, constraints, cost)
        inside = [centre + unit * self.variables, problem.parameters]
        program = ca.Function("program", [problem.variables, problem.parameters], [problem.cost, problem.constraints])
        value, h = program(*inside)
        self.cost, self.constraints = value / cost, h / constraints


def _cost_curvature(problem: _Scaled) -> ca.Function:
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


def _ipopt(name: str, problem: _Scaled, options: dict[str, Any], extra: dict[str, Any]) -> ca.Function:
    quiet = {"print_time": False, "show_eval_warnings": False, "record_time": False, "calc_lam_p": False}
    nlp = {"x": problem.variables, "f": problem.cost, "g": problem.constraints, "p": problem.parameters}
    return ca.nlpsol(name, "ipopt", nlp, quiet | {"ipopt": options} | extra)
