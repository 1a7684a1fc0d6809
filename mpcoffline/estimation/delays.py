"""Dead time of the inputs, found in a log: whole sampling steps, each input its own."""

from __future__ import annotations

from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.memory import rows_before
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

from .identification import OneStepProblem
from .rows import FULL_TURN, Rows, without_jumps

_ROWS = 6_000  # of the log that are looked at
_FEW_ROWS = 1_000  # of them, for a descent
_PIECE = 100  # rows that are held out together, at most
_HELD_OUT = 3  # of so many pieces one
_FEWEST = 200  # rows of a log that can tell
_ITERATIONS = 20  # of the descent with the model's own dead time
_FEWER_ITERATIONS = 5  # of the others, which begin where the best so far ended
_NEAR_BOUND = 1e-2  # in scaled coordinates
_PRIOR = 1e-8  # of the scaled coordinates: keeps them where nothing else does
_LEAST_GAIN = 0.05  # of the one-step error
_PROMISING = 0.99  # of the one-step error, by linear regression
_SIGMAS, _CHANCE = 3.0, 0.00135  # the same in standard errors and as a probability
_WINDOW = 15  # steps of the check over many, and rows of what counts as one observation of a difference
_FEWEST_WINDOWS = 8  # for a standard error
_NO_WORSE = 1.01
_EXACT = 1e-3  # spreads of an increment: smaller errors count as this
_LOST = 1e3  # spreads: larger ones count as this
_RANGE, _PATIENCE = 8, 4  # steps that are tried in any case, and beyond the best
_ROUNDS = 4


@dataclass(frozen=True)
class DelaySearch:
    """What a log says of dead time.

    Attributes:
        delay: In sampling steps, ``(nu,)``; the model's own where nothing beats it.
        given: The model's own, ``(nu,)``.
        gain: The one-step error on held-out rows, relative to that with ``given``.
        longest: How far the search went, ``(nu,)``; nowhere where the log is too short to tell.
    """

    delay: tuple[int, ...]
    given: tuple[int, ...]
    gain: float
    longest: tuple[int, ...]

    @property
    def found(self) -> bool:
        """Whether the log says something else than the model."""
        return self.delay != self.given

    def __str__(self) -> str:
        if not self.found:
            return f"dead time of {list(self.delay)} steps, as given; no better one up to {list(self.longest)}"
        return (
            f"dead time of {list(self.delay)} steps: held-out one-step errors are {self.gain:.2g} times those"
            f" with {list(self.given)}"
        )


def find_delays(mpc: MPC, table: TransitionTable, *, seed: int = 0) -> DelaySearch:
    """Finds the dead time with which the model, identified anew, predicts rows best that it was not identified on.

    One input after the other, until nothing changes. Another dead time counts where it makes the one-step error at
    least 5 % smaller, by more than three standard errors of the difference (over stretches of 15 rows, both models on
    the same), and predictions over 15 steps no worse. The search along an input goes eight steps far, farther where
    the errors depend on older inputs or keep falling, and never beyond a third of a typical stretch of the log. A dead
    time with which a regression on the linearised model explains no more is passed over.

    Args:
        mpc: The MPC; what its model says of dead time is what others have to beat.
        table: Transitions of observations, in the order of time within each episode.
        seed: Seeds the choice of what is held out.

    Returns:
        What was found; the model's own dead time where the log has too few consecutive rows to tell.

    Raises:
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    table.check_fits(mpc.ny, mpc.nu)
    given = best = mpc.layout.delay
    scan = Scan(mpc, excerpt(table, _ROWS, seed), seed)
    visited = [0] * mpc.nu
    if not scan.tells(given):
        return DelaySearch(given, given, 1.0, tuple(visited))
    for _ in range(_ROUNDS):
        before = best
        for i in range(mpc.nu):
            best, reached = scan.along(best, i)
            visited[i] = max(visited[i], reached)
        if best == before or mpc.nu == 1:
            break
    return DelaySearch(best, given, scan.gain(best, given), tuple(visited))


class _Errors(NamedTuple):
    """Errors of one model.

    Attributes:
        theta: Its parameters.
        one: Squares of its one-step errors, ``(n, nx)`` in spreads of the increments; NaN where inputs are not known.
        z: Its parameters in scaled coordinates.
    """

    theta: Array
    one: Array
    z: Array


class Scan:
    """Models identified with one dead time or another, compared on the same held-out rows."""

    def __init__(self, mpc: MPC, table: TransitionTable, seed: int) -> None:
        columns, n = table.values(), mpc.layout.n_states
        self._x, self._reached = columns.observations[:, :n], columns.next_observations[:, :n]
        self._u, self._signals = columns.actions, columns.observations[:, mpc.layout.present]
        self._before = rows_before(table)
        starts = self._before % _PIECE == 0
        piece = np.cumsum(starts) - 1
        order = np.random.default_rng(seed).permutation(int(piece[-1]) + 1)
        self._held_out = np.asarray(order[piece] % _HELD_OUT == 0)
        ends = np.append(self._before[1:] == 0, True)
        lengths = np.sort(1 + self._before[ends])
        typical = lengths[np.searchsorted(np.cumsum(lengths), lengths.sum() / 2)]  # half of the rows are in longer ones
        self._cap = int(typical) // 3
        self._spread = np.where(self._x.std(axis=0) > 0.0, self._x.std(axis=0), 1.0)
        self._known: dict[tuple[float, ...], _Errors] = {}
        self._problem = OneStepProblem(mpc, Rows(self._x, self._acting(mpc.layout.delay), self._reached))
        missed = self._problem.errors(mpc.theta) * self._problem.scale
        rows, self._angles = without_jumps(self._problem.rows, missed)
        self._reached = rows.reached
        if self._angles:
            self._problem = OneStepProblem(mpc, rows)
        self._z = np.zeros(len(self._problem.free))

    def tells(self, delay: tuple[float, ...]) -> bool:
        """Whether there are enough rows to compare dead times at all."""
        if self._cap < 1 or len(self._x) < _FEWEST:
            return False
        rows = np.isfinite(self.errors(delay).one).all(axis=1)
        return bool((rows & ~self._held_out).any() and len(self._windows(rows & self._held_out)[0]) >= _FEWEST_WINDOWS)

    def along(self, best: tuple[int, ...], i: int) -> tuple[tuple[int, ...], int]:
        """The best dead times that differ in one input at most, and how far was looked."""
        chosen, lowest, current = best, 1.0, best
        d, end = 0, min(self._cap, max(_RANGE, best[i] + _PATIENCE, self._oldest(best, i) + _PATIENCE))
        while d <= end:
            candidate = (*current[:i], d, *current[i + 1 :])
            score = self.gain(candidate, current) if self._promises(candidate, current) else 1.0
            if score < lowest:
                chosen, lowest, end = candidate, score, min(self._cap, max(end, d + _PATIENCE))
            d += 1
        if chosen == current or not self.better(chosen, current):
            return current, end
        self._z = self.errors(chosen).z
        return chosen, end

    def _promises(self, delay: tuple[float, ...], than: tuple[float, ...]) -> bool:
        """Whether identification with a dead time may pay, as the model linearised about the present parameters says.

        Their best values for it are those of a linear regression, without bounds and prior: more than any model gets.
        """
        if delay in self._known or not len(self._z):
            return True
        rows = np.flatnonzero((self._before >= max(*delay, *than)) & ~self._held_out)
        rows = rows[:: max(1, len(rows) // _FEW_ROWS)]
        left = []
        for each in (delay, than):
            some = self._problem.on(Rows(self._x[rows], self._acting(each)[rows], self._reached[rows]))
            errors, jacobian = some.linearised(self._z)
            slopes = jacobian.reshape(errors.size, -1)
            size = np.sqrt(np.sum(slopes**2, axis=0))
            slopes = slopes / np.where(size > 0.0, size, 1.0)  # of a gain near zero, too, as a wrong dead time makes it
            best = np.linalg.lstsq(slopes, errors.ravel(), rcond=1e-10)[0]
            left.append(float(np.sum((errors.ravel() - slopes @ best) ** 2)))
        return left[0] <= _PROMISING**2 * left[1]

    def gain(self, delay: tuple[float, ...], than: tuple[float, ...]) -> float:
        """The one-step error relative to that with another dead time, on held-out rows that both know."""
        squares, others = self._compared(delay, than)
        return float(np.sqrt(squares.mean() / others.mean()))

    def _compared(self, delay: tuple[float, ...], than: tuple[float, ...]) -> tuple[Array, Array]:
        """Mean squares of windows ``(w,)`` of both; each coordinate in units of the error of the second."""
        first, second = self.errors(delay).one, self.errors(than).one
        rows = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1) & self._held_out
        unit = np.maximum(second[rows].mean(axis=0), _EXACT**2)
        numbers, count = self._windows(rows)
        total = (
            np.bincount(np.repeat(np.arange(len(count)), count), (part[rows][numbers] / unit).mean(axis=1))
            for part in (first, second)
        )
        sums, other_sums = total
        return sums / count.mean(), other_sums / count.mean()

    def _windows(self, rows: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Order of the chosen rows, and lengths of the windows that they are cut into, in that order."""
        window = np.cumsum(self._before % _WINDOW == 0)[rows]
        return np.arange(int(rows.sum())), np.unique(window, return_counts=True)[1]

    def better(self, delay: tuple[float, ...], than: tuple[float, ...]) -> bool:
        """Whether a dead time is to be believed rather than another one."""
        squares, others = self._compared(delay, than)
        if not (self.gain(delay, than) <= 1.0 - _LEAST_GAIN and _larger(others, squares)):
            return False
        return self._ahead(delay, than) <= _NO_WORSE * self._ahead(than, delay)

    def errors(self, delay: tuple[float, ...]) -> _Errors:
        """The model identified with a dead time, and its errors."""
        if delay not in self._known:
            valid = self._before >= max(delay)
            acting = self._acting(delay)
            train = np.flatnonzero(valid & ~self._held_out)
            train = train[:: max(1, len(train) // _FEW_ROWS)]
            some = self._problem.on(Rows(self._x[train], acting[train], self._reached[train]))
            z = self._descended(some, _FEWER_ITERATIONS if self._known else _ITERATIONS)
            theta = self._problem.theta(z)
            every = self._problem.on(Rows(self._x, acting, self._reached))
            missed = np.nan_to_num(every.errors(theta), nan=_LOST, posinf=_LOST, neginf=-_LOST)
            one = np.where(valid[:, None], np.clip(missed, -_LOST, _LOST) ** 2, np.nan)
            self._known[delay] = _Errors(theta, one, z)
            if len(self._known) == 1:
                self._z = z
        return self._known[delay]

    def _descended(self, some: OneStepProblem, iterations: int) -> Array:
        """The coordinates that fit some rows best: from the best so far, and from theta_0 where those hit a bound."""
        if not len(self._z):
            return self._z
        stuck = np.minimum(self._z - some.low, some.high - self._z).min() < _NEAR_BOUND
        starts = [self._z, np.zeros_like(self._z)] if stuck else [self._z]
        return min((some.descend(z, _PRIOR, iterations) for z in starts), key=attrgetter("cost")).z

    def _acting(self, delay: tuple[float, ...]) -> Array:
        """The inputs that act in each row, and its signals, ``(n, nu + n_signals)``; anything where not known."""
        rows = np.arange(len(self._u))
        inputs = np.stack([self._u[np.maximum(rows - int(d), 0), i] for i, d in enumerate(delay)], axis=1)
        return np.hstack([inputs, self._signals])

    def _ahead(self, delay: tuple[float, ...], other: tuple[float, ...]) -> float:
        """Mean square error over 15 steps without correction, in spreads of the states, from where both know enough."""
        last = np.flatnonzero(self._held_out & (self._before >= _WINDOW - 1 + max(*delay, *other)))
        last = last[:: max(1, len(last) // _FEW_ROWS)]
        acting, theta = self._acting(delay), self.errors(delay).theta
        x, total = self._x[last - _WINDOW + 1], 0.0
        for row in range(-_WINDOW + 1, 1):
            x = self._problem.model.predict(x, acting[last + row], theta)
            missed = x - self._reached[last + row]
            for i in self._angles:
                missed[:, i] -= FULL_TURN * np.round(missed[:, i] / FULL_TURN)
            missed = np.nan_to_num(missed / self._spread, nan=_LOST, posinf=_LOST, neginf=-_LOST)
            total += float(np.mean(np.clip(missed, -_LOST, _LOST) ** 2))
        return total / _WINDOW if len(last) else 0.0

    def _oldest(self, delay: tuple[int, ...], i: int) -> int:
        """The oldest value of an input that the errors follow more than half as much as they follow any."""
        model = self.errors(delay)
        rows = np.flatnonzero(self._before >= max(self._cap, max(delay)))
        if len(rows) < _FEWEST:
            return 0
        acting = self._acting(delay)
        every = self._problem.on(Rows(self._x[rows], acting[rows], self._reached[rows]))
        missed = np.nan_to_num(every.errors(model.theta), nan=0.0, posinf=0.0, neginf=0.0)
        known = np.hstack([np.ones((len(rows), 1)), _standard(np.hstack([self._x[rows], acting[rows]]))])
        past = np.stack([self._u[rows - d, i] for d in range(self._cap + 1)], axis=1)
        past, missed = (v - known @ np.linalg.lstsq(known, v, rcond=None)[0] for v in (past, missed))
        size = np.sqrt(np.outer(np.sum(past**2, axis=0), np.sum(missed**2, axis=0)))
        with np.errstate(divide="ignore", invalid="ignore"):
            followed = np.abs(np.nan_to_num(past.T @ missed / size)).max(axis=1)
        clear = followed > max(0.5 * followed.max(), 4.0 / np.sqrt(len(rows)))
        return int(np.flatnonzero(clear).max(initial=0))


def _larger(first: Array, second: Array) -> bool:
    """Whether the first ``(w,)`` are larger than the second beyond chance: in the mean, or in nearly every pair.

    An input that moves now and then tells in few windows, whose mean scatters: there the signed ranks count (Wilcoxon,
    Biometrics Bulletin 1, 1945).
    """
    difference = first - second
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    if difference.mean() > _SIGMAS * error:
        return True
    return bool(difference.any() and scipy.stats.wilcoxon(difference, alternative="greater").pvalue < _CHANCE)


def _standard(columns: Array) -> Array:
    """Columns ``(n, m)`` about their mean, in units of their spread; one that is a number is zero."""
    about, spread = columns - columns.mean(axis=0), columns.std(axis=0)
    return np.asarray(np.divide(about, spread, out=np.zeros_like(about), where=spread > 0.0))
