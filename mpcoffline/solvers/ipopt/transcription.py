"""(MPC) as a nonlinear program by direct multiple shooting, and the checks of its solutions."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC, Penalty
from mpcoffline.solvers.limits import depends_on_input, element_names
from mpcoffline.solvers.scaling import costs_of
from mpcoffline.solvers.starts import N_CANDIDATES

from .units import Units, costates


class Multipliers(NamedTuple):
    """The multipliers of a solution in CasADi's signs: positive at upper bounds.

    Attributes:
        bounds: Of the variables, ``(n,)``.
        constraints: ``(m,)``.
    """

    bounds: Array
    constraints: Array


class Expansion(NamedTuple):
    """A program to first order.

    Attributes:
        rows: Of the elements of the Jacobian of the constraints that are not always zero.
        columns: Their variables.
        slopes: These elements.
        gradient: Of the objective, ``(n,)``.
        constraints: Their values, ``(m,)``.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    slopes: Array
    gradient: Array
    constraints: Array


class Transcription:
    """The nonlinear program of an MPC.

    Its variables are (u_0, x_1, u_1, ..., x_N, slacks), its parameters (s, theta) with one theta or, ``stagewise``, one
    a stage; its constraints the defects of the dynamics, then h. A soft constraint h <= slack has a slack >= 0 that
    is paid for.

    Args:
        mpc: The problem.
        stagewise: Whether theta is ``(N + 1, size)`` instead of ``(size,)``.

    Attributes:
        variables: ``(n, 1)``.
        parameters: ``(nx + size of theta, 1)``.
        cost: The objective, without the constants of the costs.
        constraints: ``(m, 1)``.
        constraint_low: ``(m,)``; the upper bounds are all zero.
        soft: All soft constraints h, as many as slacks.
        labels: The name of each hard constraint and state bound in :meth:`violations`, and its stage.
    """

    mpc: MPC
    stagewise: bool

    def __init__(self, mpc: MPC, stagewise: bool = False) -> None:
        self.mpc, self.stagewise = mpc, stagewise
        n, size = mpc.horizon, mpc.space.size
        self._stage, self._terminal, self._constants = _cost_functions(mpc)
        self._state = ca.SX.sym("s", mpc.nx)
        self._theta = ca.SX.sym("theta", size, n + 1 if stagewise else 1)
        self._inputs = [ca.SX.sym(f"u{k}", mpc.nu) for k in range(n)]
        self._states = [self._state, *(ca.SX.sym(f"x{k + 1}", mpc.nx) for k in range(n))]
        self.parameters: ca.SX = ca.vertcat(self._state, ca.vec(self._theta))
        self.labels: list[tuple[str, int]] = []
        hard: list[ca.SX] = []
        soft: list[tuple[ca.SX, Penalty, int]] = []
        self._collect(hard, soft)
        self._hard = hard
        self.soft: ca.SX = ca.vertcat(*(h for h, _, _ in soft)) if soft else ca.SX(0, 1)
        slacks = ca.SX.sym("slack", self.soft.numel())
        # The square alone keeps a slack from being negative, and has no kink for which a bound would be needed.
        low = [np.full(h.numel(), 0.0 if penalty.l1 else -np.inf) for h, penalty, _ in soft]
        self._slack_low = np.concatenate([*low, np.zeros(0)])
        self.variables: ca.SX = ca.vertcat(
            *(v for pair in zip(self._inputs, self._states[1:], strict=True) for v in pair), slacks
        )
        self.cost: ca.SX = self._objective() + _price(soft, slacks, mpc.discount)
        self._true_cost = self._objective() + _price(soft, ca.fmax(self.soft, 0.0), mpc.discount)
        self.constraints: ca.SX = ca.vertcat(*self._defects(), *hard, self.soft - slacks)
        n_defects = n * mpc.nx
        self.constraint_low: Array = np.full(self.constraints.numel(), -np.inf)
        self.constraint_low[:n_defects] = 0.0

    def theta_at(self, k: int) -> ca.SX:
        """Theta of a stage."""
        return self._theta[:, k] if self.stagewise else self._theta

    def _objective(self) -> ca.SX:
        """gamma^N T_th(x_N) + sum_{k<N} gamma^k Lhat_th(x_k, u_k), without constants."""
        mpc, n = self.mpc, self.mpc.horizon
        cost = mpc.discount**n * self._terminal(self._states[n], self.theta_at(n))
        for k in range(n):
            cost += mpc.discount**k * self._stage(self._states[k], self._inputs[k], self.theta_at(k))
        return cost

    def _defects(self) -> list[ca.SX]:
        f, x = self.mpc.dynamics_function, self._states
        return [f(x[k], u, self.theta_at(k)) - x[k + 1] for k, u in enumerate(self._inputs)]

    def _collect(self, hard: list[ca.SX], soft: list[tuple[ca.SX, Penalty, int]]) -> None:
        """All constraints besides the bounds of inputs and the hard bounds of states; labels of the hard ones."""
        mpc, n, x = self.mpc, self.mpc.horizon, self._states

        def add(name: str, h: ca.SX, penalty: Penalty | None, k: int) -> None:
            if penalty is not None:
                soft.append((h, penalty, k))
                return
            names = element_names(name, h.numel())
            # The given state may violate what no input can change: that is no infeasibility of what is planned.
            kept = np.flatnonzero(depends_on_input(h, self._inputs[0]) | (k > 0)).tolist()
            if kept:
                hard.append(h[kept])
            self.labels += [(names[j], k) for j in kept]

        for k, u in enumerate(self._inputs):
            for constraint in mpc.constraints_at("stages"):
                h = mpc.constraint_expression(constraint)(x[k], u, self.theta_at(k))
                add(constraint.name, h, constraint.soft, k)
        for constraint in mpc.constraints_at("end"):
            add(constraint.name, mpc.constraint_expression(constraint)(x[n], self.theta_at(n)), constraint.soft, n)
        for bounds in mpc.state_bounds:
            if bounds.soft is not None:
                stages = range(int(bounds.at_end), n + int(bounds.at_end))
                soft += [(bounds.expression(x[k]), bounds.soft, k) for k in stages]

    def bounds(self, u0: Array | None) -> tuple[Array, Array]:
        """Lower and upper bounds of the variables, with the first input imposed where it is given."""
        mpc = self.mpc
        low = np.full((mpc.horizon, mpc.nu + mpc.nx), -np.inf)
        high = -low
        low[:, : mpc.nu], high[:, : mpc.nu] = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
        low[:, mpc.nu :], high[:, mpc.nu :] = self._state_bounds
        if u0 is not None:
            low[0, : mpc.nu] = high[0, : mpc.nu] = u0
        return np.r_[low.ravel(), self._slack_low], np.r_[high.ravel(), np.full(len(self._slack_low), np.inf)]

    @cached_property
    def _state_bounds(self) -> tuple[Array, Array]:
        """The tightest of the hard bounds of the states."""
        hard = [bounds for bounds in self.mpc.state_bounds if bounds.soft is None]
        low, high = np.full(self.mpc.nx, -np.inf), np.full(self.mpc.nx, np.inf)
        for bounds in hard:
            low, high = np.maximum(low, np.asarray(bounds.low)), np.minimum(high, np.asarray(bounds.high))
        return low, high

    def pack(self, x: Array, u: Array, p: Array) -> Array:
        """The variables for states ``(N + 1, nx)`` and inputs ``(N, nu)``, with the slacks that they need."""
        trajectory = np.hstack([u, x[1:]]).ravel()
        if not self.soft.numel():
            return trajectory
        needed = self._slack_function(np.r_[trajectory, np.zeros(self.soft.numel())], p).full().ravel()
        return np.asarray(np.r_[trajectory, np.nan_to_num(needed)])

    def unpack(self, w: Array) -> tuple[Array, Array]:
        """States x_1 ... x_N ``(N, nx)`` and inputs ``(N, nu)``."""
        mpc = self.mpc
        rows = w[: mpc.horizon * (mpc.nu + mpc.nx)].reshape(mpc.horizon, mpc.nu + mpc.nx)
        return rows[:, mpc.nu :], rows[:, : mpc.nu]

    @cached_property
    def _slack_function(self) -> ca.Function:
        return ca.Function("slacks", [self.variables, self.parameters], [ca.fmax(self.soft, 0.0)])

    @cached_property
    def simulate(self) -> ca.Function:
        """``(inputs (nu, N), p) -> x_1 ... x_N (nx, N)``: the model run open loop."""
        x, reached = self._state, []
        u = ca.SX.sym("u", self.mpc.nu, self.mpc.horizon)
        step = self.mpc.dynamics_function
        for k in range(self.mpc.horizon):
            x = step(x, u[:, k], self.theta_at(k))
            reached.append(x)
        return ca.Function("simulate", [u, self.parameters], [ca.horzcat(*reached)])

    @cached_property
    def appraise(self) -> ca.Function:
        """``(variables, p) -> cost, hard constraints``: the objective with the slacks that are needed, and h."""
        return ca.Function(
            "appraise", [self.variables, self.parameters], [self._true_cost, ca.vertcat(ca.SX(0, 1), *self._hard)]
        )

    @cached_property
    def _lagrangian(self) -> ca.Function:
        """``(variables, p, multipliers) -> gradient of the Lagrangian, constraints``."""
        multipliers = ca.SX.sym("lam", self.constraints.numel())
        gradient = ca.gradient(self.cost, self.variables)
        total = gradient + ca.jtimes(self.constraints, self.variables, multipliers, True)
        arguments = [self.variables, self.parameters, multipliers]
        return ca.Function("lagrangian", arguments, [total, self.constraints])

    @cached_property
    def constant(self) -> ca.Function:
        """``p -> number``: what the constants of the costs add to the objective."""
        n, discount = self.mpc.horizon, self.mpc.discount
        total = discount**n * self._constants(self.theta_at(n))[1]
        for k in range(n):
            total += discount**k * self._constants(self.theta_at(k))[0]
        return ca.Function("constant", [self.parameters], [ca.densify(total)])

    def reference(self, p: Array) -> list[Array]:
        """The state that the costs pull to, by the theta in p: none, or ``(nx,)`` for each theta."""
        for name in ("stage_cost.x_ref", "terminal_cost.x_ref"):
            part = self.mpc.space.slices.get(name)
            if part is not None and part.stop - part.start == self.mpc.nx:
                return list(p[self.mpc.nx :].reshape(-1, self.mpc.space.size)[:, part])
        return []

    def expansion(self, w: Array, p: Array) -> Expansion:
        """The program to first order at a point."""
        rows, columns = self._places
        found = self._expansion(w, p).full().ravel()
        slopes, gradient, constraints = np.split(found, [len(rows), len(rows) + len(w)])
        return Expansion(rows, columns, slopes, gradient, constraints)

    @cached_property
    def _expansion(self) -> ca.Function:
        jacobian, gradient = ca.jacobian(self.constraints, self.variables), ca.gradient(self.cost, self.variables)
        elements: list[Any] = jacobian.nonzeros()
        column = ca.vertcat(
            ca.vertcat(*elements),
            ca.densify(gradient),
            ca.densify(self.constraints),
        )
        return ca.Function("expansion", [self.variables, self.parameters], [column])

    @cached_property
    def _places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        jacobian = ca.Function("g", [self.variables, self.parameters], [self.constraints]).jac_sparsity(0, 0)
        rows, columns = jacobian.get_triplet()
        return np.array(rows, dtype=np.int64), np.array(columns, dtype=np.int64)

    def gradient(self, w: Array, p: Array) -> Array:
        """Of the objective by the variables, ``(n,)``."""
        return np.asarray(self._gradient(w, p).full().ravel())

    @cached_property
    def _gradient(self) -> ca.Function:
        gradient = ca.densify(ca.gradient(self.cost, self.variables))
        return ca.Function("gradient", [self.variables, self.parameters], [gradient])

    def violation(self, w: Array, p: Array, units: Units) -> tuple[float, float, str]:
        """The hard constraint or state bound that is violated most: by how many units, by how much, name and stage."""
        n_defects = self.mpc.horizon * self.mpc.nx
        h = self.appraise(w, p)[1].full().ravel()
        low, high = self._state_bounds
        x, _ = self.unpack(w)
        state_units, _ = self.unpack(units.variables)
        excess = np.maximum(x - high, low - x)  # -inf where there is no bound
        in_units = h / units.constraints[n_defects : n_defects + h.size], excess / state_units
        worst, amount, where = 0.0, 0.0, ""
        if h.size and in_units[0].max() > worst:
            j = int(in_units[0].argmax())
            name, stage = self.labels[j]
            worst, amount, where = float(in_units[0][j]), float(h[j]), f"{name!r} at stage {stage}"
        if in_units[1].max(initial=-np.inf) > worst:
            k, i = np.unravel_index(int(in_units[1].argmax()), excess.shape)
            where = f"{self._bound_name(int(i), x[k, i] > high[i])!r} at stage {k + 1}"
            worst, amount = float(in_units[1][k, i]), float(excess[k, i])
        return worst, amount, where

    def _bound_name(self, i: int, above: bool) -> str:
        """The name of the hard state bound that is the tightest for a state."""
        low, high = self._state_bounds
        for bounds in self.mpc.state_bounds:
            tight = np.asarray(bounds.high)[i] == high[i] if above else np.asarray(bounds.low)[i] == low[i]
            if bounds.soft is None and tight:
                return f"{bounds.name}[{i}]"
        raise KeyError(i)

    def optimality(self, w: Array, p: Array, u0: Array | None, multipliers: Multipliers, units: Units) -> float:
        """How far the conditions of Karush, Kuhn and Tucker are from holding, relative to the size of their terms.

        Stationarity of the Lagrangian, signs and complementarity of the multipliers, computed from the problem's
        functions at the point given, all as changes of the cost over a unit; feasibility is the business of
        :meth:`violation`. The multipliers of the model and of the inputs' bounds are not asked for: with those that
        make the Lagrangian stationary in the states, what is left is by the inputs, as small as their effects may be.
        """
        low, high = self.bounds(u0)
        inequality = np.isneginf(self.constraint_low)
        pressed = multipliers.constraints[inequality]
        pressing = np.where(inequality, multipliers.constraints, 0.0)
        lagrangian, g = (part.full().ravel() for part in self._lagrangian(w, p, pressing))
        bound = np.where(self._is_input, 0.0, multipliers.bounds)
        above, below = np.maximum(bound, 0.0), np.maximum(-bound, 0.0)
        slope = self._by_inputs(lagrangian + bound, units) * units.variables / units.cost
        # Of an input what a step down the gradient moves it within its bounds, whatever their multipliers are.
        moved = np.abs(np.clip(w - slope * units.variables, low, high) - w) / units.variables
        residuals = [
            np.where(self._is_input, moved, np.abs(slope)),
            above * np.where(np.isfinite(high), np.abs(high - w), units.variables) / units.cost,
            below * np.where(np.isfinite(low), np.abs(w - low), units.variables) / units.cost,
            np.maximum(-pressed, 0.0) * units.constraints[inequality] / units.cost,
            np.abs(pressed * g[inequality]) / units.cost,
        ]
        worst = max(float(residual.max(initial=0.0)) for residual in residuals)
        return worst if np.isfinite(worst) else np.inf

    @cached_property
    def _is_input(self) -> NDArray[np.bool_]:
        """Which of the variables are inputs."""
        mpc, n = self.mpc, self.variables.numel()
        entries = np.arange(n)
        stage = mpc.nu + mpc.nx
        return np.asarray((entries % stage < mpc.nu) & (entries < mpc.horizon * stage))

    def _by_inputs(self, gradient: Array, units: Units) -> Array:
        """A gradient by the variables ``(n,)`` with what the states add to it moved to the inputs."""
        nu, N = self.mpc.nu, self.mpc.horizon
        result = gradient.copy()
        rows = result[: N * (nu + self.mpc.nx)].reshape(N, -1)
        rows[:, :nu] += np.einsum("kx,kxu->ku", costates(rows[:, nu:], units.A), units.B)
        rows[:, nu:] = 0.0
        return result

    @cached_property
    def rollout_candidates(self) -> ca.Function:
        """``(s, inputs (nu, K N), theta (size, N + 1)) -> states (nx, K N), costs (1, K)`` of the K candidates."""
        mpc = self.mpc
        u, theta = ca.SX.sym("u", mpc.nu), ca.SX.sym("theta", mpc.space.size)
        # The running cost is carried along as one more state: (x, J, gamma^k).
        carried = ca.SX.sym("carried", mpc.nx + 2)
        state, total, weight = carried[: mpc.nx], carried[mpc.nx], carried[mpc.nx + 1]
        stepped = ca.vertcat(
            mpc.dynamics_function(state, u, theta),
            total + weight * self._stage(state, u, theta),
            weight * mpc.discount,
        )
        horizon = ca.Function("step", [carried, u, theta], [stepped]).mapaccum("rollout", mpc.horizon)
        s, inputs = ca.MX.sym("s", mpc.nx), ca.MX.sym("u", mpc.nu, mpc.horizon)
        p = ca.MX.sym("theta", mpc.space.size, mpc.horizon + 1)
        path = horizon(ca.vertcat(s, 0, 1), inputs, p[:, : mpc.horizon])
        last = path[:, -1]
        cost = last[mpc.nx] + last[mpc.nx + 1] * self._terminal(last[: mpc.nx], p[:, mpc.horizon])
        one = ca.Function("one", [s, inputs, p], [path[: mpc.nx, :], cost])
        return one.map("all", "serial", N_CANDIDATES, [0, 2], [])


def _price(soft: list[tuple[ca.SX, Penalty, int]], slacks: ca.SX, discount: float) -> ca.SX:
    """What the violations cost: gamma^k (l1 sum(s) + l2 sum(s^2)) of each soft constraint."""
    cost, start = ca.SX(0), 0
    for h, penalty, k in soft:
        s = slacks[start : start + h.numel()]
        cost += discount**k * (penalty.l1 * ca.sum1(s) + penalty.l2 * ca.sumsqr(s))
        start += h.numel()
    return cost


def _cost_functions(mpc: MPC) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Stage and terminal cost without constants, ``(x, u, theta)`` and ``(x, theta)``; those of theta, as a pair."""
    x, u, theta = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX.sym("theta", mpc.space.size)
    costs = costs_of(mpc, x, u, theta)
    return (
        ca.Function("stage", [x, u, theta], [costs.stage]),
        ca.Function("terminal", [x, theta], [costs.terminal]),
        ca.Function("constants", [theta], [costs.offset, costs.last]),
    )
