"""(MPC) as a nonlinear program for ipopt: any smooth model, cost and constraint; the oracle of the other solvers."""

from __future__ import annotations

import time
from typing import Any

import casadi as ca
import numpy as np

from mpcoffline.errors import InvalidArgumentError
from mpcoffline.mpc import MPC

from .interface import Array, Plan, Solution, Solver
from .starts import N_CANDIDATES, candidate_inputs

_FEASIBILITY_TOLERANCE = 1e-6
_CONVERGED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


class IpoptSolver(Solver):
    """Direct multiple shooting with CasADi and ipopt.

    A cold start rolls out many random input sequences, takes the best few as starting points, solves each with the
    Gauss-Newton Hessian (the cost's curvature alone, which needs no convexification and rarely fails), and
    polishes the best with the exact Hessian. A warm start goes to the exact Hessian at once. The starting points are
    fixed by a seed at construction, so that equal calls give equal results.

    Args:
        mpc: The problem.
        n_starts: Starting points of a cold solve; 1 suffices where the model is linear (the default there).
        tolerance: ipopt's relative convergence tolerance.
        max_iterations: Bound on the iterations of each ipopt call.
    """

    name = "ipopt"

    def __init__(
        self, mpc: MPC, *, n_starts: int | None = None, tolerance: float = 1e-8, max_iterations: int = 300
    ) -> None:
        super().__init__(mpc)
        if n_starts is not None and not 1 <= n_starts <= N_CANDIDATES:
            raise InvalidArgumentError("n_starts", expected=f"from 1 to {N_CANDIDATES}", actual=str(n_starts))
        self._n_starts = n_starts or (1 if is_linear(mpc) else 4)
        nlp = _nonlinear_program(mpc)
        common = {"print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": max_iterations}
        warm = {"warm_start_init_point": "yes", "mu_init": 1e-4}
        gauss_newton = {"hess_lag": _cost_curvature(nlp)}
        self._cold = _ipopt("cold", nlp, common, gauss_newton)
        self._exact = _ipopt("exact", nlp, common | warm, {})
        self._n_constraints = nlp["g"].numel() // mpc.horizon - mpc.nx
        self._rollout = _rollout_function(mpc)
        self._candidates = candidate_inputs(mpc)

    def _solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan) -> Solution:
        start = time.perf_counter()
        known = warm_start.known
        rows = []
        for i, state in enumerate(x):
            imposed = None if u0 is None else u0[i]
            guess = (warm_start.x[i], warm_start.u[i]) if known[i] else None
            rows.append(self._solve_one(state, theta, imposed, guess))
        xs, us, values, success, status, iterations = zip(*rows, strict=True)
        u = np.stack(us)
        stats = {"iterations": np.array(iterations), "time": time.perf_counter() - start}
        return Solution(u[:, 0].copy(), np.stack(xs), u, np.array(values), np.array(success), list(status), stats)

    def _solve_one(
        self, state: Array, theta: Array, u0: Array | None, guess: tuple[Array, Array] | None
    ) -> tuple[Array, Array, float, bool, str, int]:
        """One problem: warm from a guess if that works, else cold from several starts and polished."""
        iterations = 0
        if guess is not None:
            result = self._call(self._exact, state, theta, u0, guess)
            iterations = result[-1]
            if result[3]:
                return result
        attempts = [self._call(self._cold, state, theta, u0, g) for g in self._starts(state, theta, u0)]
        iterations += sum(attempt[-1] for attempt in attempts)
        best = min(attempts, key=lambda attempt: (not attempt[3], attempt[2]))
        polished = self._call(self._exact, state, theta, u0, (best[0], best[1]))
        iterations += polished[-1]
        if polished[3] and polished[2] <= best[2] + 1e-6 * (1.0 + abs(best[2])):
            best = polished
        return (*best[:-1], iterations)

    def _starts(self, state: Array, theta: Array, u0: Array | None) -> list[tuple[Array, Array]]:
        """The ``n_starts`` cheapest of the candidate input sequences, with the states that they lead to."""
        inputs = self._candidates.copy()
        if u0 is not None:
            inputs[:, 0] = u0
        n, horizon, nu = inputs.shape
        states, costs = self._rollout(state, inputs.reshape(n * horizon, nu).T, theta)
        trajectories = states.full().T.reshape(n, horizon, self.mpc.nx)
        cost = np.nan_to_num(costs.full().ravel(), nan=np.inf, posinf=np.inf)
        order = np.argsort(cost, kind="stable")[: self._n_starts]
        first = np.broadcast_to(state, (1, self.mpc.nx))
        return [
            (np.concatenate([first, trajectories[i]]), inputs[i]) for i in order if np.isfinite(trajectories[i]).all()
        ] or [(np.repeat(first, horizon + 1, axis=0), np.zeros((horizon, nu)))]

    def _call(
        self, solver: ca.Function, state: Array, theta: Array, u0: Array | None, guess: tuple[Array, Array]
    ) -> tuple[Array, Array, float, bool, str, int]:
        """One run of ipopt: states, inputs, value, checked success, status, iterations."""
        mpc = self.mpc
        low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
        lower = np.full((mpc.horizon, mpc.nu + mpc.nx), -np.inf)
        upper = -lower
        lower[:, : mpc.nu], upper[:, : mpc.nu] = low, high
        if u0 is not None:
            lower[0, : mpc.nu] = upper[0, : mpc.nu] = u0
        h_low = np.r_[np.zeros(mpc.nx), np.full(self._n_constraints, -np.inf)]
        result = solver(
            x0=np.hstack([guess[1], guess[0][1:]]).ravel(),
            lbx=lower.ravel(),
            ubx=upper.ravel(),
            lbg=np.tile(h_low, mpc.horizon),
            ubg=0.0,
            p=np.r_[state, theta],
        )
        stats = solver.stats()
        w = result["x"].full().reshape(mpc.horizon, mpc.nu + mpc.nx)
        u = np.clip(w[:, : mpc.nu], low, high)  # ipopt relaxes bounds by 1e-8
        x = np.vstack([state, w[:, mpc.nu :]])
        violation = np.abs(result["g"].full()).ravel()
        if self._n_constraints:
            violation = np.maximum(result["g"].full().ravel(), 0.0)
            violation = np.r_[violation, np.abs(self._dynamics_residual(x, u, theta))]
        scale = 1.0 + float(np.abs(x).max(initial=0.0))
        feasible = bool(np.isfinite(w).all() and violation.max() <= _FEASIBILITY_TOLERANCE * scale)
        status = str(stats["return_status"])
        success = feasible and status in _CONVERGED
        return x, u, float(result["f"]), success, status, int(stats["iter_count"])

    def _dynamics_residual(self, x: Array, u: Array, theta: Array) -> Array:
        reached = self.mpc.dynamics_function(x[:-1].T, u.T, theta).full().T
        return np.asarray(reached - x[1:]).ravel()


def is_linear(mpc: MPC) -> bool:
    """Whether f_theta is affine in (x, u), so that with convex costs every minimum is global."""
    x, u = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu)
    theta = ca.SX.sym("theta", mpc.space.size)
    z = ca.vertcat(x, u)
    jacobian = ca.jacobian(mpc.dynamics_function(x, u, theta), z)
    return mpc.constraints is None and not ca.depends_on(jacobian, z)


def _nonlinear_program(mpc: MPC) -> dict[str, ca.SX]:
    """(MPC) with decision variables (u_0, x_1, u_1, ..., x_N), parameters (s, theta)."""
    state, theta = ca.SX.sym("s", mpc.nx), ca.SX.sym("theta", mpc.space.size)
    f, stage, terminal, h = (
        mpc.dynamics_function,
        mpc.stage_function,
        mpc.terminal_function,
        mpc.constraint_function,
    )
    x, cost, variables, constraints = state, ca.SX(0), [], []
    for k in range(mpc.horizon):
        u, x_next = ca.SX.sym(f"u{k}", mpc.nu), ca.SX.sym(f"x{k + 1}", mpc.nx)
        cost += mpc.discount**k * stage(x, u, theta)
        variables += [u, x_next]
        constraints.append(f(x, u, theta) - x_next)
        if h is not None:
            constraints.append(h(x, u, theta))
        x = x_next
    cost += mpc.discount**mpc.horizon * terminal(x, theta)
    return {
        "x": ca.vertcat(*variables),
        "f": cost,
        "g": ca.vertcat(*constraints),
        "p": ca.vertcat(state, theta),
    }


def _cost_curvature(nlp: dict[str, ca.SX]) -> ca.Function:
    """The Gauss-Newton Hessian for ipopt: the curvature of the cost, without that of the constraints."""
    hessian, _ = ca.hessian(nlp["f"], nlp["x"])
    cost_factor, multipliers = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", nlp["g"].numel())
    return ca.Function(
        "nlp_hess_l",
        [nlp["x"], nlp["p"], cost_factor, multipliers],
        [ca.triu(cost_factor * hessian)],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )


def _ipopt(name: str, nlp: dict[str, ca.SX], options: dict[str, Any], extra: dict[str, Any]) -> ca.Function:
    quiet = {"print_time": False, "show_eval_warnings": False, "record_time": False}
    return ca.nlpsol(name, "ipopt", nlp, quiet | {"ipopt": options} | extra)


def _rollout_function(mpc: MPC) -> ca.Function:
    """``(s, inputs (nu, K*N), theta) -> states (nx, K*N), costs (1, K)``: the model run open loop from one state."""
    u, theta = ca.SX.sym("u", mpc.nu), ca.SX.sym("theta", mpc.space.size)
    # The running cost is carried along as one more state: (x, J, gamma^k).
    carried = ca.SX.sym("carried", mpc.nx + 2)
    state, total, weight = carried[: mpc.nx], carried[mpc.nx], carried[mpc.nx + 1]
    stepped = ca.vertcat(
        mpc.dynamics_function(state, u, theta),
        total + weight * mpc.stage_function(state, u, theta),
        weight * mpc.discount,
    )
    step = ca.Function("step", [carried, u, theta], [stepped])
    horizon = step.mapaccum("rollout", mpc.horizon)
    s, inputs = ca.MX.sym("s", mpc.nx), ca.MX.sym("u", mpc.nu, mpc.horizon)
    p = ca.MX.sym("theta", mpc.space.size)
    path = horizon(ca.vertcat(s, 0, 1), inputs, ca.repmat(p, 1, mpc.horizon))
    last = path[:, -1]
    cost = last[mpc.nx] + last[mpc.nx + 1] * mpc.terminal_function(last[: mpc.nx], p)
    one = ca.Function("one", [s, inputs, p], [path[: mpc.nx, :], cost])
    return one.map("all", "serial", N_CANDIDATES, [0, 2], [])
