"""DDPSolver: batches of MPCs in generated, vectorised C."""

from __future__ import annotations

import ctypes
import time
from ctypes import POINTER, c_double, c_int, c_int64, c_void_p
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.threads import Crew
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.solvers.interface import SOLVERS, Solution, Solver
from mpcoffline.solvers.linear_quadratic import is_convex
from mpcoffline.solvers.options import check_options
from mpcoffline.solvers.plan import Plan
from mpcoffline.solvers.scaling import cost_constant, input_units
from mpcoffline.solvers.starts import N_CANDIDATES, candidate_inputs
from mpcoffline.solvers.status import Stats, Status

from .build import compiled
from .codegen import source
from .limited import Limited, address, better
from .rounding import Rounding

# By the kernel's codes.
STATUS = (Status.CONVERGED, Status.ITERATION_LIMIT, Status.STALLED, Status.NOT_FINITE, Status.INFEASIBLE)
_LANES = 8
_ITERATIONS, _LIMITED_ITERATIONS = 200, 500


class _Problem(ctypes.Structure):
    """``mpc_problem`` of the kernel."""

    _fields_ = (
        ("horizon", c_int64),
        ("discount", c_double),
        ("low", c_void_p),
        ("high", c_void_p),
        ("unit", c_void_p),
        ("rest", c_void_p),
        ("max_iterations", c_int64),
        ("tolerance", c_double),
        ("race", c_int),  # with limits only
    )


class _Batch(ctypes.Structure):
    """``mpc_batch`` of the kernel."""

    _fields_ = (
        ("n", c_int64),
        ("x0", c_void_p),
        ("theta", c_void_p),
        ("u0", c_void_p),
        ("theta_stride", c_int64),
        ("x", c_void_p),
        ("u", c_void_p),
        ("J", c_void_p),
        ("predicted", c_void_p),
        ("size", c_void_p),  # NULL, as here: nobody asks
        ("iterations", c_void_p),
        ("status", c_void_p),
        ("guess", c_int),  # 0, as here: a plan that need not obey the model
        ("x_guess", c_void_p),
        ("u_guess", c_void_p),
        ("rivals", c_int),
        ("stays", c_int),
        ("limits_guess", c_void_p),  # from here on with limits only
        ("limits_stride", c_int64),
        ("limits", c_void_p),
        ("violation", c_void_p),
        ("now", c_void_p),
        ("worst", c_void_p),
        ("amount", c_void_p),
    )


@SOLVERS.register("ddp")
class DDPSolver(Solver):
    """Control-limited differential dynamic programming with Gauss-Newton Hessians, eight problems an instruction.

    Model, costs and their derivatives become C together with a small kernel, compiled once with the system's compiler
    and cached. Input bounds are handled exactly (a box QP at each stage), and so are hard limits to what inputs change
    by in a step: bounds that move with the input before, which every plan keeps. Other limits, hard and soft, are
    handled by an augmented Lagrangian: minimisations with multipliers that are made better after each, until every
    limit is kept to a millionth of what it is measured by (how far it moves along the plan, or what the candidates make
    of it). Costs whose class does not promise to be ``convex`` enter with the positive semidefinite part of their
    Hessian; stage costs that are linear in the states (prices) with the curvature of the model besides, as they have
    none of their own, unless the model is large (a network).

    A cold problem is solved from 16 of 64 fixed input sequences, each the cheapest of four that are alike; the best
    four of different costs go on after three iterations, beside a plan that stays where the plant is (an unstable one
    is led far away by all sequences), and the best solution is kept. A warm one is solved from its plan, which need not
    obey the model. Every result is a rollout of the model, so the dynamics hold exactly;
    ``success`` says that the quadratic model at it promises no further decrease and that the first input has settled.
    Otherwise it is the best plan found, and ``status`` says why it was not accepted: ``"iteration limit"``,
    ``"stalled"`` (no step lowers the cost, though the quadratic model promises one), ``"infeasible"`` (a hard limit
    cannot be kept, however much is paid for it: the plan violates it by little more than it must), or ``"not finite"``;
    ``words`` name the limit that is violated most. A hard limit that the given state violates, and no input can change,
    is reported in ``stats["violation_now"]``, not imposed. Multipliers travel in the plan, but for those of failures.

    Slopes that jump or are infinite (``fmax``, ``fabs``, ``if_else``, saturations, dead zones, ``sqrt`` or ``v**0.8``
    at 0) stop a method that follows them. What is not solved because of them is solved with the corners rounded over
    1 % of each quantity's range, and again exactly from there; the better plan of the exact model is returned, and it
    counts as solved if the rounded problem was. The first time, the log says which corners there are.

    References: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA 2014. Rockafellar,
    "Augmented Lagrangians and applications of the proximal point algorithm in convex programming", 1976,
    doi:10.1287/moor.1.2.97.

    Args:
        mpc: The problem.
        max_iterations: Bound on the iterations of a problem, with limits of all its minimisations together; by default
            200, with limits 500.
        tolerance: Predicted decrease of the cost, relative to the magnitudes of its stages (their constants left out),
            below which a problem is solved; 1000 times as much where the iterations are used up.
        n_starts: Starting points of a cold solve; by default 16, and 1 where the problem is convex.
        n_threads: Threads that share a batch at most; small ones, of less than some ms, are one thread's.
        round_corners: Whether to round corners for what is not solved; exported C never does, nor is it done under
            limits.

    Raises:
        InvalidArgumentError: For functions without a counterpart in C, or more of them than compilers take.
        CompilerError: If there is no working C compiler.
    """

    relative_speed = 500.0
    needs_compiler = True
    theta_dimensions = (1, 2)

    def __init__(
        self,
        mpc: MPC,
        *,
        max_iterations: int | None = None,
        tolerance: float = 1e-11,
        n_starts: int | None = None,
        n_threads: int = 1,
        round_corners: bool = True,
    ) -> None:
        options: dict[str, Any] = {"max_iterations": max_iterations, "tolerance": tolerance, "n_starts": n_starts}
        super().__init__(mpc, **options, n_threads=n_threads, round_corners=round_corners)
        if max_iterations is None:
            max_iterations = _ITERATIONS if mpc.constraints is None else _LIMITED_ITERATIONS
        check_options({"max_iterations": max_iterations, "tolerance": tolerance, "n_threads": n_threads})
        if n_starts is None:
            n_starts = 1 if is_convex(mpc) else 16
        if not 1 <= n_starts <= N_CANDIDATES:
            raise InvalidArgumentError("n_starts", expected=f"from 1 to {N_CANDIDATES}", actual=str(n_starts))
        library = compiled(source(mpc))
        problem, batch, number = POINTER(_Problem), POINTER(_Batch), c_int64
        library.mpc_solve.argtypes = (problem, batch, number, number)
        library.mpc_solve_cold.argtypes = (problem, batch, c_void_p, number, number, number, number)
        self._library = library
        self._low, self._high = (np.ascontiguousarray(b, dtype=np.float64) for b in (mpc.action_low, mpc.action_high))
        self._unit, self._rest = input_units(mpc), np.ascontiguousarray(mpc.usual_input)
        self._problem = _Problem(
            mpc.horizon,
            mpc.discount,
            self._low.ctypes.data,
            self._high.ctypes.data,
            self._unit.ctypes.data,
            self._rest.ctypes.data,
            max_iterations,
            tolerance,
        )
        self._constant = cost_constant(mpc)
        self._own_constant = float(self._constant(self._theta))
        self._limited = None if mpc.constraints is None else Limited(mpc)
        if self._limited is not None:
            library.mpc_limits.argtypes = (problem, batch, c_void_p, c_int64)
        # Any start leads to the only minimum; but all say how large limits are.
        compared = n_starts if is_convex(mpc) and self._limited is None else N_CANDIDATES
        self._candidates = np.ascontiguousarray(candidate_inputs(mpc)[:compared])
        self._starts = address(self._candidates), len(self._candidates), n_starts
        self.n_starts, self.max_iterations, self.tolerance = n_starts, max_iterations, tolerance
        self._n_threads, self._crews = n_threads, (Crew(), Crew())  # for warm problems, for cold ones
        self._rounding: Rounding | None = None
        self._round_corners = bool(round_corners) and self._limited is None

    @property
    def limit_names(self) -> tuple[str, ...]:
        """What the elements of limits are called, in the order of multipliers; none where there are no limits."""
        return self._limited.labels if self._limited is not None else ()

    def _solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan | None) -> Solution:
        start = time.perf_counter()
        result = self.run(x, theta, u0, warm_start)
        if self._round_corners and np.count_nonzero(result["status"]):
            self._rounded().improve(self, x, theta, u0, result)
        status = result["status"]
        stats: Stats = {
            "iterations": result["iterations"],
            "time": time.perf_counter() - start,
            "predicted_decrease": result["predicted"],
            "all_starts": result.get("all_starts", warm_start is None),
        }
        ended = [STATUS[code] for code in status.tolist()]  # the first one only where all numbers are finite
        value = result["J"]
        if theta is not self._theta:
            value = value + self._constant(theta.T).full()[0]
        elif self._own_constant:
            value = value + self._own_constant
        if self._limited is not None:
            stats["violation"] = result["amount"]
            stats["violation_now"] = result["now"]
            if np.count_nonzero(status):
                stats["words"] = self._limited.words(result, ended)
                result["multipliers"][status != 0] = np.nan
        arrays = result["u"][:, 0].copy(), result["x"], result["u"], value, status == 0
        return Solution(*arrays, ended, stats, result.get("multipliers"))

    def violation(self, x: Array, u: Array) -> Array:
        """See :meth:`Solver.violation`; in what each limit is measured by."""
        if self._limited is None:
            return np.zeros(len(x))
        return self._survey(x, self._theta, None, u)["violation"]

    def limit_prices(self, x: Array) -> Array:
        """A price of each element of limits that is dear, by the sizes of costs and limits, ``(B, n)``.

        A hundred spreads of the stage cost over that of the element, along random input sequences from states ``(B,
        nx)``.
        """
        if self._limited is None:
            return np.zeros((len(x), 0))
        found = self._survey(x, self._theta, None, None)["multipliers"]
        return np.asarray(found[:, -2] * found[:, -1])  # first weights and scales

    def _rounded(self) -> Rounding:
        """What solves the problem where its corners stand in the way; made when it is first needed."""
        if self._rounding is None:

            def make(mpc: MPC) -> DDPSolver:
                return DDPSolver(
                    mpc,
                    max_iterations=self.max_iterations,
                    tolerance=self.tolerance,
                    n_starts=self.n_starts,
                    n_threads=self._n_threads,
                )

            self._rounding = Rounding(self.mpc, make)
        return self._rounding

    def run(self, x: Array, theta: Array, u0: Array | None, plan: Plan | None) -> dict[str, NDArray[Any]]:
        """Solves problems as they are: warm from a plan, cold without; see :class:`Rounding` for what it returns."""
        return self._run(x, theta, u0, None) if plan is None else self._run_warm(x, theta, u0, plan)

    def _run_warm(self, x: Array, theta: Array, u0: Array | None, plan: Plan) -> dict[str, NDArray[Any]]:
        """Problems that have a plan are warm; those that have none, or that it leads nowhere, are cold."""
        known = np.isfinite(plan.u[:, 0, 0])  # faster than plan.known; NaN elsewhere leads nowhere
        n_known = np.count_nonzero(known)
        if n_known == 0:
            return self._run(x, theta, u0, None)
        result = self._run(x, theta, u0, plan) if n_known == len(x) else self._run_mixed(x, theta, u0, plan, known)
        if not np.count_nonzero(result["status"]):
            return result
        # A plan of a problem that could not be solved was the best from all starts; what is told again, is believed.
        believed = self._was_lost(plan) & (result["status"] == STATUS.index(Status.INFEASIBLE))
        lost = known & (result["status"] > 1) & ~believed
        result["all_starts"] = ~known | lost | believed
        if np.count_nonzero(lost):
            again = self._run(x[lost], _rows(theta, lost), None if u0 is None else u0[lost], None)
            # A plan that is not accepted either is only taken if it is better.
            rows = np.flatnonzero(lost)
            taken = better(again, {name: result[name][rows] for name in again})
            result["iterations"][rows] += again.pop("iterations")
            for name, array in again.items():
                result[name][rows[taken]] = array[taken]
        return result

    def _was_lost(self, plan: Plan) -> NDArray[np.bool_]:
        """Which plans are of solves that failed: such have no multipliers, where others of the same solver do."""
        if self._limited is None or plan.multipliers is None:
            return np.zeros(len(plan.u), dtype=bool)
        return self._limited.unknown(plan.multipliers)

    def _run_mixed(
        self, x: Array, theta: Array, u0: Array | None, plan: Plan, known: NDArray[np.bool_]
    ) -> dict[str, NDArray[Any]]:
        """Warm and cold problems of one batch, solved apart and put together in order."""
        merged: dict[str, NDArray[Any]] = {}
        for chosen, warm in ((known, plan.rows(known)), (~known, None)):
            part = self._run(x[chosen], _rows(theta, chosen), None if u0 is None else u0[chosen], warm)
            for name, array in part.items():
                merged.setdefault(name, np.empty((len(x), *array.shape[1:]), array.dtype))[chosen] = array
        return merged

    def _run(self, x: Array, theta: Array, u0: Array | None, plan: Plan | None) -> dict[str, NDArray[Any]]:
        """Calls the kernel; warm with a plan, cold without."""
        n, mpc = len(x), self.mpc
        # What the kernel reads; named here, so that it lives as long.
        x, theta = _plain(x), _plain(theta)  # one theta for all, or a row a problem
        u0 = None if u0 is None else _plain(u0)
        # What it writes, in one piece of memory: for one problem, allocations would take long.
        n_x, n_u = n * (mpc.horizon + 1) * mpc.nx, n * mpc.horizon * mpc.nu
        memory = np.empty(n_x + n_u + 4 * n)
        reached = address(memory)
        inputs, figures, row = reached + 8 * n_x, reached + 8 * (n_x + n_u), 8 * n
        batch = _Batch(
            n=n,
            x0=address(x),
            theta=address(theta),
            u0=None if u0 is None else address(u0),
            theta_stride=theta.shape[1] if theta.ndim == 2 else 0,
            x=reached,
            u=inputs,
            J=figures,
            predicted=figures + row,
            iterations=figures + 2 * row,
            status=figures + 3 * row,
        )
        if plan is not None:
            y = None if self._limited is None else self._multipliers(x, theta, u0, plan)
            plan = Plan(_plain(plan.x), _plain(plan.u), y)
            batch.x_guess, batch.u_guess = address(plan.x), address(plan.u)
            if y is not None:
                batch.limits_guess, batch.limits_stride = address(y), y[0].size
        more = {} if self._limited is None else self._limited.results(n)
        for name, array in more.items():
            setattr(batch, "limits" if name == "multipliers" else name, address(array))
        if self._call(batch, cold=plan is None):
            raise MemoryError(f"solving {n} MPCs: the kernel could not allocate its work space")
        values = memory[n_x + n_u :].reshape(4, n)
        integers = values.view(np.int64)
        return {
            "x": memory[:n_x].reshape(n, mpc.horizon + 1, mpc.nx),
            "u": memory[n_x : n_x + n_u].reshape(n, mpc.horizon, mpc.nu),
            "J": values[0],
            "predicted": values[1],
            "iterations": integers[2],
            "status": integers[3],
            **more,
        }

    def _multipliers(self, x: Array, theta: Array, u0: Array | None, plan: Plan) -> Array:
        """Those of a plan; where nothing is known of them, zeros, with weights that the candidates give."""
        assert self._limited is not None  # noqa: S101 -- asked with limits only; narrows the type
        unknown = np.ones(len(x), dtype=bool)
        if plan.multipliers is not None:
            self._limited.check(plan.multipliers, len(x))
            if not (unknown := self._limited.unknown(plan.multipliers)).any():
                return _plain(plan.multipliers)
        found = self._limited.results(len(x))["multipliers"] if plan.multipliers is None else plan.multipliers.copy()
        some = None if u0 is None else u0[unknown]
        found[unknown] = self._survey(x[unknown], _rows(theta, unknown), some, None)["multipliers"]
        return found

    def _survey(self, x: Array, theta: Array, u0: Array | None, u: Array | None) -> dict[str, NDArray[Any]]:
        """Multipliers to begin with; the violations of plans with inputs u ``(B, N, nu)``, where they are given."""
        assert self._limited is not None  # noqa: S101 -- asked with limits only; narrows the type
        n, x, theta = len(x), _plain(x), _plain(theta)
        u0, u = (None if inputs is None else _plain(inputs) for inputs in (u0, u))
        batch = _Batch(
            n=n,
            x0=address(x),
            theta=address(theta),
            u0=None if u0 is None else address(u0),
            theta_stride=theta.shape[1] if theta.ndim == 2 else 0,
            u_guess=None if u is None else address(u),
        )
        found = self._limited.results(n)
        for name, array in found.items():
            setattr(batch, "limits" if name == "multipliers" else name, address(array))
        if self._library.mpc_limits(ctypes.byref(self._problem), ctypes.byref(batch), *self._starts[:2]):
            raise MemoryError(f"looking at {n} MPCs: the kernel could not allocate its work space")
        return found

    def _call(self, batch: _Batch, *, cold: bool) -> int:
        """Runs the kernel on a batch, in several threads where that pays; returns how many failed."""
        library, problem, arguments = self._library, ctypes.byref(self._problem), ctypes.byref(batch)
        most = min(self._n_threads, batch.n if cold else -(-batch.n // _LANES))

        def work(first: int, workers: int) -> int:
            if not cold:
                return int(library.mpc_solve(problem, arguments, first, workers))
            return int(library.mpc_solve_cold(problem, arguments, *self._starts, first, workers))

        # ctypes releases the interpreter lock
        return work(0, 1) if most < 2 else sum(self._crews[cold].share(work, batch.n, most))


def _rows(theta: Array, chosen: NDArray[np.bool_]) -> Array:
    """The thetas of the chosen problems, or the one of all."""
    return theta[chosen] if theta.ndim == 2 else theta


def _plain(array: Array) -> Array:
    """An array as C and :func:`~mpcoffline.solvers.ddp.limited.address` take it: contiguous and writable."""
    array = np.ascontiguousarray(array, dtype=np.float64)
    return array if array.flags.writeable else array.copy()
