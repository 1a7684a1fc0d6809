"""DDPSolver: batches of MPCs in generated, vectorised C."""

from __future__ import annotations

import ctypes
import functools
import math
import time
from concurrent.futures import ThreadPoolExecutor
from ctypes import POINTER, c_double, c_int, c_int64, c_void_p
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.errors import InvalidArgumentError
from mpcoffline.mpc import MPC
from mpcoffline.solvers.interface import Array, Plan, Solution, Solver
from mpcoffline.solvers.linear_quadratic import is_convex
from mpcoffline.solvers.starts import N_CANDIDATES, candidate_inputs

from .build import compiled
from .codegen import source

_STATUS = ("converged", "iteration limit", "stalled", "not finite")
_LANES = 8


class _Problem(ctypes.Structure):
    """``mpc_problem`` of the kernel."""

    _fields_ = (
        ("horizon", c_int64),
        ("discount", c_double),
        ("low", c_void_p),
        ("high", c_void_p),
        ("max_iterations", c_int64),
        ("tolerance", c_double),
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
        ("iterations", c_void_p),
        ("status", c_void_p),
        ("guess", c_int),  # 0, as here: a plan that need not obey the model
        ("x_guess", c_void_p),
        ("u_guess", c_void_p),
        ("rivals", c_int),
    )


class DDPSolver(Solver):
    """Control-limited differential dynamic programming with Gauss-Newton Hessians, eight problems an instruction.

    Model, costs and their derivatives become C together with a small kernel, compiled once with the system's compiler
    and cached. Input bounds are handled exactly (a box QP at each stage); there are no other constraints. Costs whose
    class does not promise to be ``convex`` enter with the positive semidefinite part of their Hessian.

    A cold problem is solved from 16 of 64 fixed input sequences, each the cheapest of four that are alike; the best
    four of different costs go on after three iterations, and the best solution is kept. A warm one is solved from its
    plan, which need not obey the model. Every result is a rollout of the model, so the dynamics hold exactly;
    ``success`` says that the quadratic model at it promises no further decrease and that the first input has settled.

    References: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA 2014.

    Args:
        mpc: The problem; without constraints other than input bounds.
        max_iterations: Bound on the iterations of a problem.
        tolerance: Predicted decrease of the cost, relative to ``1 + |V|``, below which a problem is solved; 1000 times
            as much where the iterations are used up.
        n_starts: Starting points of a cold solve; by default 16, and 1 where the problem is convex.
        n_threads: Threads that share a batch; a batch of up to eight problems uses one.

    Raises:
        InvalidArgumentError: For an MPC with constraints, or functions without a counterpart in C.
        CompilerError: If there is no working C compiler.
    """

    name = "ddp"
    theta_dimensions = (1, 2)

    def __init__(
        self,
        mpc: MPC,
        *,
        max_iterations: int = 200,
        tolerance: float = 1e-11,
        n_starts: int | None = None,
        n_threads: int = 1,
    ) -> None:
        super().__init__(mpc)
        if mpc.constraints is not None:
            raise InvalidArgumentError(
                "constraints",
                expected="none but input bounds for the ddp solver",
                actual="constraints",
                hint="Use ipopt.",
            )
        for name, value in (("max_iterations", max_iterations), ("n_threads", n_threads)):
            if value < 1:
                raise InvalidArgumentError(name, expected="a positive integer", actual=str(value))
        if n_starts is None:
            n_starts = 1 if is_convex(mpc) else 16
        if not 1 <= n_starts <= N_CANDIDATES:
            raise InvalidArgumentError("n_starts", expected=f"from 1 to {N_CANDIDATES}", actual=str(n_starts))
        library = compiled(source(mpc))
        problem, batch = POINTER(_Problem), POINTER(_Batch)
        library.mpc_solve.argtypes = (problem, batch, c_int64, c_int64)
        library.mpc_solve_cold.argtypes = (problem, batch, c_void_p, c_int64, c_int64, c_int64, c_int64)
        self._library = library
        self._low, self._high = (np.ascontiguousarray(b, dtype=np.float64) for b in (mpc.action_low, mpc.action_high))
        self._problem = _Problem(
            mpc.horizon, mpc.discount, self._low.ctypes.data, self._high.ctypes.data, max_iterations, tolerance
        )
        compared = n_starts if is_convex(mpc) else N_CANDIDATES  # any start leads to the only minimum
        self._candidates = np.ascontiguousarray(candidate_inputs(mpc)[:compared])
        self.n_starts, self.max_iterations, self.tolerance = n_starts, max_iterations, tolerance
        self._n_threads = n_threads

    def _solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan) -> Solution:
        start = time.perf_counter()
        known = warm_start.known
        n_known = np.count_nonzero(known)
        if n_known == len(x):
            result = self._run(x, theta, u0, warm_start)
        elif n_known == 0:
            result = self._run(x, theta, u0, None)
        else:
            result = self._run_mixed(x, theta, u0, warm_start, known)
        # A warm start can lead nowhere; such a problem gets the cold solve that it would have had without.
        lost = known & (result["status"] > 1)
        if np.count_nonzero(lost):
            again = self._run(x[lost], _rows(theta, lost), None if u0 is None else u0[lost], None)
            for name, array in again.items():
                result[name][lost] = array
        status = result["status"]
        stats: dict[str, Any] = {"iterations": result["iterations"], "time": time.perf_counter() - start}
        stats["predicted_decrease"] = result["predicted"]
        success = (status == 0) & np.isfinite(result["J"])
        words = [_STATUS[code] for code in status.tolist()]
        return Solution(result["u"][:, 0].copy(), result["x"], result["u"], result["J"], success, words, stats)

    def _run_mixed(
        self, x: Array, theta: Array, u0: Array | None, plan: Plan, known: NDArray[np.bool_]
    ) -> dict[str, NDArray[Any]]:
        """Warm and cold problems of one batch, solved apart and put together in order."""
        merged: dict[str, NDArray[Any]] = {}
        for chosen, warm in ((known, Plan(plan.x[known], plan.u[known])), (~known, None)):
            part = self._run(x[chosen], _rows(theta, chosen), None if u0 is None else u0[chosen], warm)
            for name, array in part.items():
                merged.setdefault(name, np.empty((len(x), *array.shape[1:]), array.dtype))[chosen] = array
        return merged

    def _run(self, x: Array, theta: Array, u0: Array | None, plan: Plan | None) -> dict[str, NDArray[Any]]:
        """Calls the kernel; warm with a plan, cold without."""
        n, mpc = len(x), self.mpc
        block, address = _block(n, mpc.horizon, mpc.nx, mpc.nu)
        block["x0"][:] = x
        theta = np.ascontiguousarray(theta)  # one for all, or a row a problem
        if u0 is None:
            address["u0"] = None
        else:
            block["u0"][:] = u0
        guess: dict[str, int | None] = {"x_guess": address["x"], "u_guess": address["u"]}
        if plan is not None:
            kept = [np.ascontiguousarray(a, np.float64) for a in plan]  # as long as the kernel reads them
            guess = {"x_guess": kept[0].ctypes.data, "u_guess": kept[1].ctypes.data}
        stride = theta.shape[1] if theta.ndim == 2 else 0
        batch = _Batch(n=n, theta=theta.ctypes.data, theta_stride=stride, **guess, **address)
        failed = self._call(batch, cold=plan is None)
        if failed:
            raise MemoryError(f"solving {n} MPCs: the kernel could not allocate its work space")
        return {name: block[name] for name in ("x", "u", "J", "predicted", "iterations", "status")}

    def _call(self, batch: _Batch, *, cold: bool) -> int:
        """Runs the kernel on a batch, in several threads if there are; returns how many failed."""
        library, problem, arguments = self._library, ctypes.byref(self._problem), ctypes.byref(batch)
        workers = min(self._n_threads, batch.n if cold else -(-batch.n // _LANES))

        def work(first: int) -> int:
            if not cold:
                return int(library.mpc_solve(problem, arguments, first, workers))
            starts = self._candidates.ctypes.data, len(self._candidates), self.n_starts
            return int(library.mpc_solve_cold(problem, arguments, *starts, first, workers))

        if workers == 1:
            return work(0)
        with ThreadPoolExecutor(workers) as pool:  # ctypes releases the interpreter lock
            return sum(pool.map(work, range(workers)))


def _rows(theta: Array, chosen: NDArray[np.bool_]) -> Array:
    """The thetas of the chosen problems, or the one of all."""
    return theta[chosen] if theta.ndim == 2 else theta


@functools.lru_cache(maxsize=64)
def _layout(n: int, horizon: int, nx: int, nu: int) -> tuple[tuple[tuple[str, slice, tuple[int, ...]], ...], int]:
    """Name, place and shape of the arrays of n problems in one piece of memory, and its size in numbers of 8 bytes."""
    shapes = {
        "x": (n, horizon + 1, nx),
        "u": (n, horizon, nu),
        "J": (n,),
        "predicted": (n,),
        "x0": (n, nx),
        "u0": (n, nu),
        "iterations": (n,),
        "status": (n,),
    }
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()]).tolist()
    places = (slice(start, end) for start, end in pairwise([0, *ends]))
    return tuple((name, place, shape) for (name, shape), place in zip(shapes.items(), places, strict=True)), ends[-1]


def _block(n: int, horizon: int, nx: int, nu: int) -> tuple[dict[str, NDArray[Any]], dict[str, int | None]]:
    """Arrays in one piece of memory, and their addresses: for one problem, allocations would take long."""
    layout, size = _layout(n, horizon, nx, nu)
    memory = np.empty(size)
    integers = memory.view(np.int64)
    start = memory.ctypes.data
    arrays: dict[str, NDArray[Any]] = {}
    addresses: dict[str, int | None] = {}
    for name, place, shape in layout:
        whole = integers if name in ("iterations", "status") else memory
        arrays[name] = whole[place].reshape(shape)
        addresses[name] = start + 8 * place.start
    return arrays, addresses
