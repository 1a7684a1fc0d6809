"""What a policy applies where a solve was not accepted: never an exception in a control loop, seldom nothing at all."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

from .interface import Solution, Solver
from .ipopt.solver import IpoptSolver
from .plan import Plan

logger = logging.getLogger(__name__)

RESCUES = ("ipopt",)


@dataclass
class SolverStats:
    """What the solves of a policy have amounted to. Each failure has one answer: the last five add up to all of them.

    Attributes:
        n_solves: Problems solved, without those whose solves were not carried through (in simulations).
        n_failures: Of these, problems whose solution was not accepted at first.
        iterations: Solver iterations in all, those of second attempts included.
        time: Time in the solvers in s, likewise.
        n_retried: Failures that were solved from all starts.
        n_rescued: Failures that the oracle solved, see ``rescue`` of :class:`mpcoffline.MPCPolicy`.
        n_best_plan: Failures where the best plan found was applied.
        n_previous_plan: Failures where the plan before was applied.
        n_zero: Failures without any plan, where zero was applied, within the bounds.
    """

    n_solves: int = 0
    n_failures: int = 0
    iterations: int = 0
    time: float = 0.0
    n_retried: int = 0
    n_rescued: int = 0
    n_best_plan: int = 0
    n_previous_plan: int = 0
    n_zero: int = 0

    @property
    def failed_share(self) -> float:
        """Failures a problem; 0 before the first."""
        return self.n_failures / self.n_solves if self.n_solves else 0.0

    @property
    def answers(self) -> dict[str, int]:
        """How many failures each answer had, e.g. ``{"retried": 1, "best_plan": 2, ...}``."""
        return {answer.counter.removeprefix("n_"): getattr(self, answer.counter) for answer in _ANSWERS}

    @property
    def failures(self) -> str:
        """In words, e.g. ``"3 of 200 (1.5 %): 1 solved from all starts, 2 by the best plan found"``."""
        counts = zip(_ANSWERS, self.answers.values(), strict=True)
        told = ", ".join(f"{count} {answer.told}" for answer, count in counts if count)
        return failures_in_words(self.n_failures, self.n_solves) + (f": {told}" if told else "")

    def count(self, solution: Solution) -> None:
        """Adds the work of a call."""
        self.iterations += int(solution.stats["iterations"].sum())
        self.time += float(solution.stats["time"])


def failures_in_words(n_failures: int, n_solves: int) -> str:
    """How many solves failed, e.g. ``"3 of 200 (1.5 %)"``."""
    return f"{n_failures} of {n_solves}" + (f" ({100.0 * n_failures / n_solves:.2g} %)" if n_failures else "")


@dataclass(frozen=True)
class _Answer:
    """One way to go on: where it is counted, how the counts and how the log tell of it."""

    counter: str
    told: str
    logged: str


_RETRIED = _Answer("n_retried", "solved from all starts", "solved from all starts")
_RESCUED = _Answer("n_rescued", "solved by ipopt", "solved by ipopt")
_BEST = _Answer("n_best_plan", "by the best plan found", "applying the best plan found")
_PREVIOUS = _Answer("n_previous_plan", "by the previous plan", "applying the previous plan")
_ZERO = _Answer("n_zero", "by zero", "applying zero, within the bounds")
_ANSWERS = (_RETRIED, _RESCUED, _BEST, _PREVIOUS, _ZERO)


_ANYHOW = 1_000  # problems


class Fallback:
    """Answers the problems that a solver did not solve.

    In this order:

    1. *Retry*: a problem that was only tried from its plan is solved from all starts.
    2. *Rescue*, if wished: ipopt solves it, from the best plan found and from a start of its own.
    3. *The best plan found* so far, by violation of hard constraints, then by cost: it is a rollout of the model with
       inputs within their bounds. It is applied unless the previous plan violates the hard constraints less.
    4. *The previous plan*, shifted: where no plan was found that is finite.
    5. Zero, within the bounds.

    Violations are only compared with each other, so that no unit matters; each solver says what it takes for none.

    Args:
        mpc: The problem.
        rescue: ``"ipopt"``, or None for no rescue.
        rescue_time: Time that ipopt may take for a problem, in s.

    Attributes:
        stats: Counts of all solves.
        most_retried: Which share of the problems is retried at most, beyond the first thousand; all by default.
        level: At which level the log tells of what was not solved.

    Raises:
        UnknownIdError: For another rescue.
        InvalidArgumentError: For a time that is not positive.
    """

    mpc: MPC
    rescue_time: float
    most_retried: float

    def __init__(self, mpc: MPC, rescue: str | None = None, rescue_time: float = 1.0) -> None:
        if rescue is not None and rescue not in RESCUES:
            raise UnknownIdError.of("rescue", rescue, RESCUES)
        if not 0.0 < rescue_time < np.inf:
            raise InvalidArgumentError("rescue_time", expected="a positive number of seconds", actual=str(rescue_time))
        self.mpc, self.rescue, self.rescue_time = mpc, rescue, float(rescue_time)
        self.stats: SolverStats = SolverStats()
        self.most_retried, self._n_tried_again = 1.0, 0
        self.level = logging.WARNING
        self._rescuer: IpoptSolver | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Everything but ipopt's program; a copy builds its own when it needs one."""
        return self.__dict__ | {"_rescuer": None}

    def answer(self, solver: Solver, x: Array, warm_start: Plan, solution: Solution) -> tuple[Array, Plan]:
        """First inputs ``(B, nu)`` and the plan for the next step; where a solve failed, as said above.

        Args:
            solver: What solved.
            x: Initial states, ``(B, nx)``.
            warm_start: The previous plan, shifted; NaN where there is none.
            solution: What was found.
        """
        partial = solution.stats.get("partial", False)
        self.stats.n_solves += 0 if partial else len(x)
        self.stats.count(solution)
        if solution.success.all():
            return solution.u0, solution.plan.shifted(self.mpc)
        rows = np.flatnonzero(~solution.success)
        self.stats.n_failures += 0 if partial else len(rows)
        states, before = x[rows], warm_start.rows(rows)
        found = _Found(solver, states, Plan(solution.x[rows].copy(), solution.u[rows].copy()), solution.value[rows])
        reasons = np.array(solution.words)[rows]
        tried = np.broadcast_to(solution.stats.get("all_starts", False), len(x))[rows]
        again = before.known & ~tried
        if self._n_tried_again > _ANYHOW + self.most_retried * self.stats.n_solves:
            again[:] = False
        self._n_tried_again += int(again.sum())
        retried = found.improve(again, lambda some: self._solve(solver, states[some], None))
        rescued = np.zeros_like(retried)
        if self.rescue is not None and not isinstance(solver, IpoptSolver):
            rescued = found.improve(~retried, lambda some: self._solve(self._oracle, states[some], found.part(some)))
        best = found.usable
        if solver.constrained:
            best &= ~(before.known & (solver.violation(states, before.u) < found.violation))
        best |= retried | rescued
        for answer, chosen in (
            (_RETRIED, retried),
            (_RESCUED, rescued),
            (_BEST, best & ~(retried | rescued)),
            (_PREVIOUS, before.known & ~best),
            (_ZERO, ~(before.known | best)),
        ):
            if not partial:
                self._told(answer, chosen, reasons)
        return self._applied(solution, rows, best, found.plan, before)

    def _solve(self, solver: Solver, x: Array, warm_start: Plan | None) -> Solution:
        solution = solver.solve(x, warm_start=warm_start)
        self.stats.count(solution)
        return solution

    @property
    def _oracle(self) -> IpoptSolver:
        if self._rescuer is None:
            self._rescuer = IpoptSolver(self.mpc, n_starts=1, max_time=self.rescue_time)
        return self._rescuer

    def _told(self, answer: _Answer, chosen: NDArray[np.bool_], reasons: NDArray[np.str_]) -> None:
        """Counts an answer, and logs the first of its kind."""
        n, before = int(chosen.sum()), getattr(self.stats, answer.counter)
        setattr(self.stats, answer.counter, before + n)
        if n and not before:
            told = ", ".join(sorted(set(reasons[chosen].tolist())))
            level = logging.INFO if answer is _RETRIED else self.level
            logger.log(level, "An MPC was not solved (%s): %s.", told, answer.logged)

    def _applied(
        self, solution: Solution, rows: NDArray[np.intp], best: NDArray[np.bool_], found: Plan, before: Plan
    ) -> tuple[Array, Plan]:
        """What the policy answers: solutions, and in ``rows`` the plan found or the one before, or zero."""
        low, high = np.asarray(self.mpc.action_low), np.asarray(self.mpc.action_high)
        chosen = best[:, None, None]
        x, u = np.where(chosen, found.x, before.x), np.where(chosen, found.u, before.u)
        y = solution.multipliers  # nothing is known of those of failures, nor of what was found instead
        every = Plan(solution.x.copy(), solution.u.copy(), None if y is None else y.copy())
        every.x[rows], every.u[rows] = x, np.clip(u, low, high)
        inputs = every.u[:, 0].copy()
        nothing = ~Plan(x, u).known
        inputs[rows[nothing]] = np.clip(0.0, low, high)
        plan = every.shifted(self.mpc)
        plan.x[rows[nothing]] = plan.u[rows[nothing]] = np.nan
        if plan.multipliers is not None:
            plan.multipliers[rows] = np.nan
        return inputs, plan


class _Found:
    """The best plans found for some problems.

    Args:
        solver: Says how much a plan violates.
        x: Initial states, ``(n, nx)``.
        plan: The first plans, written to.
        value: What they cost, ``(n,)``.
    """

    def __init__(self, solver: Solver, x: Array, plan: Plan, value: Array) -> None:
        self._solver, self._x, self.plan = solver, x, plan
        self._value = self._costs(plan, value)
        self.violation = self._violations(x, plan.u)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Where there is a plan of finite numbers and of finite cost."""
        return np.isfinite(self._value)

    def part(self, some: NDArray[np.bool_]) -> Plan:
        """Some of the plans, those that are not usable as none."""
        plan = self.plan.select(self.usable)
        return plan.rows(some)

    def improve(self, some: NDArray[np.bool_], solve: Callable[[NDArray[np.bool_]], Solution]) -> NDArray[np.bool_]:
        """Solves some of the problems again and takes over what is better; returns which are solved now."""
        solved = np.zeros(len(some), dtype=bool)
        if not some.any():
            return solved
        solution, rows = solve(some), np.flatnonzero(some)
        value, violation = self._costs(solution.plan, solution.value), self._violations(self._x[rows], solution.u)
        old_value, old_violation = self._value[rows], self.violation[rows]
        less = (violation < old_violation) | ((violation == old_violation) & (value < old_value))
        better = solution.success | (np.isfinite(value) & (less | ~np.isfinite(old_value)))
        for kept, new in (
            (self.plan.x, solution.x),
            (self.plan.u, solution.u),
            (self._value, value),
            (self.violation, violation),
        ):
            kept[rows[better]] = new[better]
        solved[rows] = solution.success
        return solved

    def _costs(self, plan: Plan, value: Array) -> Array:
        """What plans cost, inf for those that hold NaN or inf."""
        return np.where(plan.known & np.isfinite(value), value, np.inf)

    def _violations(self, x: Array, u: Array) -> Array:
        return self._solver.violation(x, u) if self._solver.constrained else np.zeros(len(x))
