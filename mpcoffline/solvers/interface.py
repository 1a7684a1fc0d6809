"""The one protocol of all solvers: a batch of states in, a :class:`Solution` out."""

from __future__ import annotations

import math
import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.registry import Registry
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

from .plan import Plan
from .status import Stats, Status

_FLOAT32 = float(np.finfo(np.float32).eps)


@dataclass(frozen=True)
class Solution:
    """What a solver found. For a single state ``(nx,)`` all arrays lack the leading dimension B.

    Attributes:
        u0: First inputs, ``(B, nu)``: the policy pi_theta.
        x: State trajectories, ``(B, N + 1, nx)``.
        u: Input trajectories, ``(B, N, nu)``.
        value: V_theta(s), or Q_theta(s, a) where ``u0`` was given, ``(B,)``.
        success: Whether the trajectory was checked to be a solution, whatever the algorithm said of itself: it obeys
            model, bounds and constraints, and the conditions of an optimum hold. ``(B,)``
        status: How each solve ended, one a problem.
        stats: Figures of the call, as ``stats["iterations"]``.
        multipliers: Of limits, as in :class:`Plan`: rows of NaN where a solve failed; None where there are none.
    """

    u0: Array
    x: Array = field(repr=False)
    u: Array = field(repr=False)
    value: Array
    success: NDArray[np.bool_]
    status: list[Status] = field(repr=False)
    stats: Stats = field(repr=False)
    multipliers: Array | None = field(default=None, repr=False)

    @property
    def plan(self) -> Plan:
        """The trajectories, for the next call's ``warm_start``."""
        if self.x.ndim == 3:
            return Plan(self.x, self.u, self.multipliers)
        return Plan(self.x[None], self.u[None], None if self.multipliers is None else self.multipliers[None])

    @property
    def words(self) -> Sequence[str]:
        """For people, one text a problem: how it was solved, or what is wrong, as the constraint that is violated."""
        return self.stats.get("words", self.status)

    def unbatched(self) -> Solution:
        """The solution of the only problem, without the batch dimension."""
        stats = cast(Stats, {k: v[0] if isinstance(v, np.ndarray) else v for k, v in self.stats.items()})
        y = None if self.multipliers is None else self.multipliers[0]
        return Solution(self.u0[0], self.x[0], self.u[0], self.value[0], self.success[0], self.status, stats, y)


class OneAtATime:
    """A lock that threads of one process share; in a forked child it is open."""

    def __init__(self) -> None:
        self._lock, self._process = threading.RLock(), os.getpid()

    def __enter__(self) -> None:
        """Waits until no other thread is within."""
        if self._process != os.getpid():  # a fork: whoever was within is not here
            self._lock, self._process = threading.RLock(), os.getpid()
        self._lock.acquire()

    def __exit__(self, *exception: object) -> None:
        """Lets the next thread in."""
        self._lock.release()


class Solver(ABC):
    """Solves (MPC) for batches of states.

    Threads may share a solver: equal calls give equal results. ddp solves for all of them at once; lqr and ipopt, whose
    libraries keep what they work on in one place, for one after the other. A copy is the solver itself, as nothing in
    it changes; an unpickled one is built anew, from an MPC that has a JSON form.

    Args:
        mpc: The problem. Its parameters are the default ``theta``; another theta never rebuilds the solver.
        **options: With which a subclass was made, to be made again in another process or from a file.

    Attributes:
        mpc: The problem.
        options: As given.
        theta_dimensions: Which forms of theta it takes: 1 ``(size,)``, 2 ``(B, size)``, 3 ``(B, N + 1, size)``.
        relative_speed: How many problems it solves while ipopt solves one, roughly, where nothing makes it hard.
        needs_compiler: Whether making it raises :class:`~mpcoffline.solvers.CompilerError` without a C compiler.
        reason: Why :func:`mpcoffline.make_solver` chose it; empty where it was named.

    Raises:
        InvalidArgumentError: For a problem that :meth:`refuses` names a reason against.
    """

    mpc: MPC
    options: dict[str, Any]

    relative_speed: ClassVar[float] = 1.0
    needs_compiler: ClassVar[bool] = False
    theta_dimensions: ClassVar[tuple[int, ...]] = (1,)
    reason: str = ""

    def __init__(self, mpc: MPC, **options: Any) -> None:
        if reason := self.refuses(mpc):
            raise InvalidArgumentError(
                "mpc",
                expected=f"a problem that the {self.name} solver takes",
                actual=reason,
                hint='Use make_solver(mpc, "auto").',
            )
        self.mpc, self.options = mpc, options
        self._theta = mpc.theta

    @classmethod
    def refuses(cls, mpc: MPC) -> str:
        """Why it does not take a problem, e.g. ``"constraints"``; empty where it does. Nothing is built for it."""
        return ""

    @property
    def name(self) -> str:
        """What :func:`mpcoffline.make_solver` and files call it; its class's name where it is not registered."""
        return SOLVERS.name_of(type(self)) or type(self).__name__

    def __copy__(self) -> Self:
        """The solver itself."""
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """The solver itself."""
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """How another process makes it again.

        Raises:
            InvalidArgumentError: For an MPC that cannot be written to JSON.
        """
        document = self.mpc.to_json(portable=True)
        return _made_again, (type(self), document, self.options), {"reason": self.reason}

    def __repr__(self) -> str:
        """Its class and the sizes of its problem."""
        return f"{type(self).__name__}(nx={self.mpc.nx}, nu={self.mpc.nu}, horizon={self.mpc.horizon})"

    def solve(
        self,
        x: ArrayLike,
        theta: ArrayLike | None = None,
        u0: ArrayLike | None = None,
        warm_start: Plan | Solution | None = None,
    ) -> Solution:
        """Solves (MPC), or (Q_th) where the first input is given.

        Args:
            x: Initial states, ``(B, nx)`` or ``(nx,)``.
            theta: Parameters, ``(size,)``; the MPC's own by default. Solvers whose ``theta_dimensions`` say so also
                take one theta a problem, ``(B, size)``, and one a problem and stage, ``(B, N + 1, size)`` or
                ``(1, N + 1, size)``: time-varying references, prices, models, see :meth:`mpcoffline.MPC.theta_along`.
            u0: First inputs that are imposed, ``(B, nu)`` or ``(nu,)``.
            warm_start: A plan near the solution (an earlier solution, shifted); rows of NaN start cold.

        Returns:
            The solution; unbatched for ``x`` of shape ``(nx,)``. A failed problem is reported in
            ``success``, not raised.

        Raises:
            InvalidArgumentError: For a wrong shape, NaN, an imposed input out of bounds, or theta out of bounds.
        """
        states = _checked("x", x, self.mpc.nx)
        imposed = None if u0 is None else self._checked_inputs(u0, len(states))
        parameters = self._theta if theta is None else self._checked_theta(theta, len(states))
        plan = warm_start.plan if isinstance(warm_start, Solution) else warm_start
        if plan is not None:
            n, N = len(states), self.mpc.horizon
            for name, given, expected in (("x", plan.x, (n, N + 1, self.mpc.nx)), ("u", plan.u, (n, N, self.mpc.nu))):
                if given.shape != expected:
                    raise InvalidArgumentError(
                        f"warm_start.{name}", expected=f"shape {expected}", actual=f"shape {given.shape}"
                    )
        solution = self._solve(states, parameters, imposed, plan)
        return solution.unbatched() if np.ndim(x) == 1 else solution

    def value(self, x: ArrayLike, theta: ArrayLike | None = None) -> Array:
        """V_theta(s) of (MPC), ``(B,)`` or a scalar; +inf where no solution was found."""
        solution = self.solve(x, theta)
        return np.where(solution.success, solution.value, np.inf)

    def q_value(self, x: ArrayLike, u: ArrayLike, theta: ArrayLike | None = None) -> Array:
        """Q_theta(s, a) of (Q_th), ``(B,)`` or a scalar; +inf where no solution was found."""
        solution = self.solve(x, theta, u0=u)
        return np.where(solution.success, solution.value, np.inf)

    @property
    def constrained(self) -> bool:
        """Whether plans can violate anything: there are constraints other than input bounds."""
        return self.mpc.constraints is not None

    def violation(self, x: Array, u: Array) -> Array:
        """How much each plan violates a hard constraint or state bound, ``(B,)``.

        Args:
            x: Initial states, ``(B, nx)``.
            u: Inputs, ``(B, N, nu)``.

        Returns:
            The largest violation of each; zero where it is within the tolerance of the solver, or nothing can be
            violated, inf where the model run with these inputs is not finite.
        """
        return np.zeros(len(x))

    @abstractmethod
    def _solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan | None) -> Solution:
        """Solves the batch; arguments are checked, ``x`` is ``(B, nx)``, theta ``(size,)`` or has B rows.

        Without any ``warm_start`` all problems are cold; making and looking through a plan that holds none would take
        longer than some solvers do.
        """

    def _checked_theta(self, theta: ArrayLike, n_problems: int) -> Array:
        array, space = np.asarray(theta, dtype=np.float64), self.mpc.space
        if array.ndim not in self.theta_dimensions or array.ndim == 1:
            if array.ndim in (2, 3):
                raise InvalidArgumentError(
                    "theta",
                    expected=f"shape ({space.size},) for the {self.name} solver",
                    actual=f"shape {array.shape}",
                    hint="The ipopt solver takes a theta for each problem and stage.",
                )
            return space.checked(array)
        shape = (n_problems, *(() if array.ndim == 2 else (self.mpc.horizon + 1,)), space.size)
        if array.shape not in (shape, (1, *shape[1:])):
            raise InvalidArgumentError("theta", expected=f"shape {shape}", actual=f"shape {array.shape}")
        rows = array.reshape(-1, space.size)
        extremes = rows.min(axis=0), rows.max(axis=0)
        for row in extremes:
            space.checked(row)
        return np.broadcast_to(array, shape)

    def _checked_inputs(self, u0: ArrayLike, n_problems: int) -> Array:
        inputs = _checked("u0", u0, self.mpc.nu)
        if len(inputs) != n_problems:
            raise InvalidArgumentError("u0", expected=f"{n_problems} rows, as x", actual=f"{len(inputs)} rows")
        low, high = np.asarray(self.mpc.action_low), np.asarray(self.mpc.action_high)
        # float32 actions touch their bounds, which can be large against the range.
        width = 1e-6 * np.where(np.isfinite(high - low), high - low, 0.0)
        below, above = (width + _FLOAT32 * np.where(np.isfinite(bound), np.abs(bound), 0.0) for bound in (low, high))
        if ((inputs < low - below) | (inputs > high + above)).any():
            raise InvalidArgumentError("u0", expected=f"inputs from {low} to {high}", actual=str(inputs))
        return np.clip(inputs, low, high)


#: All solvers by name.
SOLVERS: Registry[type[Solver]] = Registry("solver", Solver)


def _made_again(kind: type[Solver], document: dict[str, Any], options: dict[str, Any]) -> Solver:
    return kind(MPC.from_json(document), **options)


def _checked(name: str, value: ArrayLike, size: int) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim not in (1, 2) or array.shape[-1] != size or not array.size:
        raise InvalidArgumentError(name, expected=f"shape (B, {size}) or ({size},)", actual=f"shape {array.shape}")
    # The sum of squares is finite only if all are; it takes half the time, and overflows beyond 1e154 alone.
    if not math.isfinite(np.vdot(array, array)) and not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(np.atleast_2d(array)).all(axis=1))[0])
        raise InvalidArgumentError(name, expected="finite numbers", actual=f"{np.atleast_2d(array)[row]} in row {row}")
    return array if array.ndim == 2 else array[None]
