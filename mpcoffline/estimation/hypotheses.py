"""What would make a model predict a log: other units, exchanged columns, signs, another sampling time.

The model is first given its best parameters within their bounds. Where it then still predicts much worse than a linear
regression on the same columns, the log is read in other ways, each a guess at what may have been mistaken. One that
makes a bad prediction a good one is evidence; a model that is merely wrong is none, since no reading helps it.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.mpc.integrators import MOST_SUBSTEPS, Scheme
from mpcoffline.mpc.scaling import increments_scale

from .findings import Excerpt, Finding, nominal_costs
from .guesses import LONGER, Guess, Reading, every_guess, sampled
from .identification import OneStepProblem
from .rows import Rows, without_jumps

_ROWS = 240
_FEW = 60
_GOOD = 0.5  # of the motion: what a model that is merely rough does better than
_BESIDE_LINEAR = 1.5  # or: as well as a regression, which knows no physics
_FLOOR = 0.1  # errors below are good, whatever they are
_COST_FLOOR = 0.3
_NO_COST = 0.8  # of the costs' spread
_GAIN = np.log(4.0)
_WORSE = np.log(1.5)
_FAR = 2.5  # scaled coordinates: parameters off by a factor 12
_TRIED, _TRIED_HEAVY = 10, 4
_OF_ONE_NAME = 2
_PRIOR = 1e-3
_ITERATIONS, _ITERATIONS_HEAVY = 8, 4
_PATIENCE = 6
_HEAVY = 1_500  # instructions of the map, as of many substeps
_MOST_PARAMETERS = 100
_FAILED = 1e3
_AS_MUCH = 0.3
_LATE, _NO_LATER = 0.3, 0.1  # logarithms; right logs come to 0.1 and less
_TINY = 1e-3
_MOVING = 0.05  # share of rows
_LEAST_MOVED = 0.2  # of two readings that explain as much, the one whose parameters stay
_ALIKE = 0.4  # logarithm that two parameters or more must be off by, for one pace to be the cause
_BY_CHANCE = 0.1  # that parameters off at random would share a pace
_PACES = 3  # that are looked at closely
_MOST_INSTRUCTIONS = 20_000


class Judged(NamedTuple):
    """How well a reading is predicted.

    Attributes:
        errors: Mean absolute errors in units of the motion, ``(n + 1,)``; the last is the cost's.
        floor: What a regression leaves; errors below it are no worse than it, ``(n + 1,)``.
        z: Where the parameters had to go, in scaled coordinates, ``(p,)``.
    """

    errors: Array
    floor: Array
    z: Array

    @property
    def moved(self) -> float:
        """How far the parameters had to go."""
        return float(np.abs(self.z).max(initial=0.0))

    @property
    def good(self) -> NDArray[np.bool_]:
        """Which errors a rough model may have, ``(n + 1,)``."""
        return (self.errors <= _GOOD) | (self.errors <= _BESIDE_LINEAR * self.floor)


def model(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """Whether the log, read otherwise, is what the model predicts; signals are taken as they are."""
    reading, n = _rows(log), mpc.layout.n_states
    if len(reading.x) < max(_FEW, 5 * (n + mpc.nu)):
        return
    judge = _Judge(mpc, reading)
    plain = judge.identified(reading)
    if (plain.errors[:n] <= _GOOD).all() and plain.moved < _FAR and plain.errors[-1] < _NO_COST:
        yield from list(_paced(mpc, reading, plain)) or _late(judge, reading, plain)
        return
    plain = judge.identified(reading, _PATIENCE)  # it may not have come to its end
    guesses = _promising(judge, reading, every_guess(mpc))
    found = [(guess, judge.identified(guess.read(reading))) for guess in guesses]
    found += [(sampled(mpc.model.dt, k), _Judge(each, reading).identified(reading)) for k, each in _other_paces(mpc)]
    gains = [_gain(plain, judged) for _, judged in found]
    if gains and max(gains) > 0.0:
        # Of those that explain as much the one that changes least, and of these the one whose errors are smallest, or
        # whose parameters stay.
        best = [each for each, gain in zip(found, gains, strict=True) if gain > max(gains) - _AS_MUCH]
        fewest = min(guess.columns for guess, _ in best)
        guess, judged = min(
            (each for each in best if each[0].columns == fewest),
            key=lambda each: float(np.log(each[1].errors + _TINY).sum()) + _LEAST_MOVED * each[1].moved,
        )
        yield _finding(guess, plain, judged, mpc)
    else:
        yield from list(_paced(mpc, reading, plain)) or _late(judge, reading, plain)


def _late(judge: _Judge, reading: Reading, plain: Judged) -> Iterator[Finding]:
    """A finding where each action stands a row too late: small errors become smaller with the action of the row after.

    In a log that is right they become larger.
    """
    if not np.isfinite(reading.u_next).all():
        return
    later = np.hstack([reading.u_next[:, : judge.nu], reading.u[:, judge.nu :]])
    found = judge.identified(reading._replace(u=later))
    ratio = np.log(plain.errors[:-1] + _TINY) - np.log(found.errors[:-1] + _TINY)
    if ratio.sum() > _LATE and ratio.min() > -_NO_LATER:
        i = int(np.argmax(ratio))
        actual = (
            f"actions of the row before: with each row's action taken from the next, the model leaves"
            f" {found.errors[i]:.1%} of observation {i}'s motion unexplained instead of {plain.errors[i]:.1%}"
        )
        hint = "The action of a row is what was applied from its s on, until its s+."
        yield Finding("actions", "actions of the same row", actual, hint, misread=True)


def _paced(mpc: MPC, reading: Reading, plain: Judged) -> Iterator[Finding]:
    """A finding where all rates are wrong by one factor: the parameters fit, but with another sampling time they stay.

    Of p parameters off at random, a share ratio^(p - 1) would be as near to one pace.
    """
    off = int((np.abs(plain.z) > _ALIKE).sum())
    if off < 2 or not (plain.errors[:-1] <= _GOOD).all():
        return
    size = float(np.sqrt(np.mean(plain.z**2)))
    best, nearest = 1.0, size * _BY_CHANCE ** (1.0 / (len(plain.z) - 1))
    for factor, other in _likely_paces(mpc, reading):
        found = _Judge(other, reading).identified(reading)
        left = float(np.sqrt(np.mean(found.z**2)))
        if left < nearest and _no_worse(found, plain):
            best, nearest = factor, left
    if best != 1.0:
        words = sampled(mpc.model.dt, best)
        actual = (
            f"data for which {off} parameters have to be off together, all rates by one factor, but by"
            f" {np.expm1(nearest):.0%} if {words.words}"
        )
        yield Finding(words.name, words.expected, actual, words.hint, misread=True)


def _no_worse(found: Judged, than: Judged) -> bool:
    return bool((found.errors <= np.maximum(than.errors, than.floor) * np.exp(_NO_LATER)).all())


def _gain(plain: Judged, found: Judged) -> float:
    """How much better, as the sum of logarithms; 0 where that is no evidence."""
    ratio = np.log(np.maximum(plain.errors, plain.floor)) - np.log(np.maximum(found.errors, found.floor))
    total = float(ratio.sum())
    if ratio.min() < -_WORSE:
        return 0.0
    if total > _GAIN and ratio.max() > 0.75 * _GAIN and found.good[ratio > _WORSE].all():
        return total
    nearer = plain.moved - found.moved  # as good a prediction, by parameters that need not go so far
    well = (plain.errors[:-1] <= _GOOD).all() and (found.errors[:-1] <= _GOOD).all()
    return nearer if well and plain.moved > _FAR and found.moved < 0.5 * plain.moved and nearer > _GAIN else 0.0


def _finding(guess: Guess, plain: Judged, found: Judged, mpc: MPC) -> Finding:
    ratio = np.maximum(plain.errors, plain.floor) / np.maximum(found.errors, found.floor)
    i = int(np.argmax(ratio))
    what = f"observation {i}'s motion" if i < mpc.layout.n_states else "the costs' spread, by the stage cost"
    if ratio[i] > 2.0:
        actual = (
            f"data of which the model, its parameters the best within their bounds, leaves {plain.errors[i]:.0%} of"
            f" {what} unexplained, but {found.errors[i]:.1%} if {guess.words}"
        )
    else:
        actual = (
            f"data that the model explains with parameters a factor {np.exp(plain.moved):.0f} from the given ones, but"
            f" {np.exp(found.moved):.1f} if {guess.words}"
        )
    return Finding(guess.name, guess.expected, actual, guess.hint, misread=True)


def _rows(log: Excerpt) -> Reading:
    """Some of the rows, those with a row after them where there are enough."""
    u_next = np.full_like(log.u, np.nan)
    u_next[:-1][log.together] = log.u[1:][log.together]
    use = np.flatnonzero(~log.ended)
    followed = use[np.isfinite(u_next[use]).all(axis=1)]
    if len(followed) >= _FEW:
        use = followed
    use = use[np.unique(np.linspace(0, len(use) - 1, min(_ROWS, len(use))).astype(np.intp))] if len(use) else use
    return Reading(log.x[use], log.u[use], log.reached[use], log.cost[use], u_next[use])


class _Judge:
    """How well a model predicts readings."""

    def __init__(self, mpc: MPC, reading: Reading) -> None:
        self._mpc, self.nu = mpc, mpc.nu
        self._problem = OneStepProblem(mpc, Rows(reading.x, reading.u, reading.reached))
        self._adapts = 0 < self._problem.free.size <= _MOST_PARAMETERS
        heavy = mpc.plant_function.n_instructions() > _HEAVY
        self.tried, self._iterations = (_TRIED_HEAVY, _ITERATIONS_HEAVY) if heavy else (_TRIED, _ITERATIONS)

    def nominal(self, readings: list[Reading]) -> list[tuple[Array, Array]]:
        """Errors of many readings at theta_0, ``(n + 1,)`` each, and of its motions times what fits best: one call."""
        x, u = (np.concatenate([getattr(r, name) for r in readings]) for name in ("x", "u"))
        parts = np.split(self._problem.model.predict(x, u, self._mpc.theta), len(readings))
        found = []
        for part, r in zip(parts, readings, strict=True):
            problem = self._on(r)
            errors = (part - r.reached) / problem.scale
            found.append((self._errors(errors, problem, r), self._errors(_fitted(part, r) / problem.scale, problem, r)))
        return found

    def identified(self, reading: Reading, patience: int = 1) -> Judged:
        """Errors with the best parameters within their bounds, found in ``patience`` times the usual iterations."""
        problem = self._on(reading)
        z = np.zeros(problem.free.size)
        errors = problem.errors(self._mpc.theta)
        rows, _ = without_jumps(problem.rows, errors * problem.scale)  # wrapped angles
        problem.rows = rows
        errors = problem.errors(self._mpc.theta)
        if self._adapts:
            try:
                z = problem.descend(z, _PRIOR, patience * self._iterations).z
            except InvalidDataError:  # the reading is none that the model can take
                pass
            else:
                errors = problem.errors(problem.theta(z))
        floor = np.append(np.maximum(_linear(problem.rows, reading.u), _FLOOR), _COST_FLOOR)
        return Judged(self._errors(errors, problem, reading), floor, z)

    def _on(self, reading: Reading) -> OneStepProblem:
        problem = copy.copy(self._problem)
        problem.rows = Rows(reading.x, reading.u, reading.reached)
        problem.scale = increments_scale(reading.x, reading.reached)
        return problem

    def _errors(self, errors: Array, problem: OneStepProblem, reading: Reading) -> Array:
        x, _, reached = problem.rows
        sizes = np.abs(np.nan_to_num(errors, nan=_FAILED, posinf=_FAILED, neginf=_FAILED)).mean(axis=0)
        motion = np.abs(reached - x).mean(axis=0) / problem.scale
        still = motion == 0.0
        relative = np.where(still, 0.0, np.minimum(sizes / np.where(still, 1.0, motion), _FAILED))
        return np.append(relative, _cost_error(self._mpc, reading))


def _cost_error(mpc: MPC, reading: Reading) -> float:
    """What the nominal stage cost leaves of the logged costs, in their mean absolute deviation; 0 for no evidence."""
    cost = reading.cost
    if not mpc.layout.is_plain:  # what is known of past inputs is not read otherwise
        return 0.0
    own = nominal_costs(mpc, reading.x, reading.u)
    if np.median(np.abs(cost - np.median(cost))) == 0.0:  # costs that hardly ever differ
        return 0.0
    if not np.isfinite(own).all() or np.ptp(own) == 0.0:
        return 1.0
    centred = own - own.mean()
    slope = max(0.0, float(centred @ (cost - cost.mean())) / float(centred @ centred))
    return float(min(1.0, np.abs(cost - cost.mean() - slope * centred).mean() / np.abs(cost - cost.mean()).mean()))


def _linear(rows: Rows, u: Array) -> Array:
    """What a regression of the motion on states and inputs, with squares and products if the rows allow, leaves of it.

    Returns:
        In units of the motion, ``(n,)``, as it would be on other rows.
    """
    z = np.column_stack([rows.x, u])
    spread = z.std(axis=0)
    z = (z - z.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    first, second = np.triu_indices(z.shape[1])
    basis = np.column_stack([np.ones(len(z)), z, z[:, first] * z[:, second]])
    if 4 * basis.shape[1] > len(z):
        basis = basis[:, : 1 + z.shape[1]]
    motion = rows.reached - rows.x
    left = np.abs(motion - basis @ np.linalg.lstsq(basis, motion, rcond=None)[0]).mean(axis=0)
    size = np.abs(motion).mean(axis=0) * np.sqrt(max(0.1, 1.0 - basis.shape[1] / len(z)))
    return np.asarray(left / np.where(size > 0.0, size, 1.0))


def _promising(judge: _Judge, reading: Reading, guesses: list[Guess]) -> list[Guess]:
    """Those that do best at theta_0, or would with other gains, in the order given."""
    some = Reading(*(part[::4] for part in reading))
    reads = [guess.read(some) for guess in guesses]
    errors, moves = judge.nominal(reads), [_moves(read, some) for read in reads]
    chosen: set[int] = set()
    for which, most in ((0, judge.tried), (1, judge.tried // 2)):
        scores = [
            float(np.log(np.maximum(error[which], _FLOOR)).mean()) if good else np.inf
            for error, good in zip(errors, moves, strict=True)
        ]
        chosen.update(_best(scores, [guess.name for guess in guesses], most))
    return [guesses[i] for i in sorted(chosen)]


def _best(scores: list[float], names: list[str], most: int) -> list[int]:
    """Places of the lowest scores, two of a name at most: many factors of one column say the same."""
    found: list[int] = []
    for i in np.argsort(scores, kind="stable").tolist():
        if np.isfinite(scores[i]) and sum(names[k] == names[i] for k in found) < _OF_ONE_NAME:
            found.append(i)
    return found[:most]


@np.errstate(over="ignore", invalid="ignore")
def _fitted(predicted: Array, r: Reading) -> Array:
    """What a gain, not below zero, and an offset leave of the predicted motion, ``(m, n)``; NaN where that explodes."""
    motion, own = (part - r.x for part in (r.reached, predicted))
    motion, own = motion - motion.mean(axis=0), own - own.mean(axis=0)
    power = (own**2).sum(axis=0)
    gain = np.maximum((own * motion).sum(axis=0) / np.where(power > 0.0, power, 1.0), 0.0)
    return np.asarray(gain * own - motion)


def _moves(read: Reading, plain: Reading) -> bool:
    """Whether a reading is complete, and moves what moves: a state that stands still is predicted by any model."""
    if not np.isfinite(read.reached).all():
        return False
    moving = [(r.reached != r.x).mean(axis=0) > _MOVING for r in (read, plain)]
    return bool((moving[0] | ~moving[1]).all())


def _likely_paces(mpc: MPC, reading: Reading) -> list[tuple[float, MPC]]:
    """Some paces at which the given parameters predict better, the best first: were a pace the cause, its own would."""
    scale = increments_scale(reading.x, reading.reached)

    def error(other: MPC) -> float:
        predicted = other.plant_function(reading.x.T, reading.u.T, other.theta).full().T
        return float(np.nan_to_num(np.abs(predicted - reading.reached) / scale, nan=_FAILED, posinf=_FAILED).mean())

    errors = [(error(other), factor, other) for factor, other in _other_paces(mpc)]
    better = sorted((each for each in errors if each[0] < error(mpc)), key=lambda each: each[0])
    return [(factor, other) for _, factor, other in better[:_PACES]]


def _other_paces(mpc: MPC) -> Iterator[tuple[float, MPC]]:
    """The MPC with its equations over other sampling times: a long step of theirs is no multiple of a short one."""
    model = mpc.model
    if model.ode is None or model.scheme is None:
        return
    heavy = mpc.plant_function.n_instructions()
    for longer in LONGER:
        for factor in (longer, 1.0 / longer):
            other = copy.copy(model)
            other.dt = model.dt * factor
            substeps = max(2, math.ceil(2.0 * factor))
            if heavy * substeps > _MOST_INSTRUCTIONS or substeps >= MOST_SUBSTEPS:
                continue
            if model.scheme == Scheme("rk4", substeps):
                substeps += 1  # another scheme, so that the map is made anew
            yield factor, mpc.replace(model=other.with_scheme(Scheme("rk4", substeps)))
