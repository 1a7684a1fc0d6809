"""What would make a model predict a log: other units, exchanged columns, signs, another sampling time.

The model is first given its best parameters within their bounds. Where it then still predicts much worse than a linear
regression on the same columns, the log is read in other ways, each a guess at what may have been mistaken. One that
makes a bad prediction a good one is evidence; a model that is merely wrong is none, since no reading helps it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.mpc.integrators import Scheme
from mpcoffline.mpc.scaling import increments_scale

from .findings import Excerpt, Finding, nominal_costs
from .identification import OneStepProblem, Rows, without_jumps
from .units import FACTORS, OFFSETS, in_words

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
_PRIOR = 1e-3
_ITERATIONS, _ITERATIONS_HEAVY = 8, 4
_PATIENCE = 6
_HEAVY = 1_500  # instructions of the map, as of many substeps
_MOST_PARAMETERS = 100
_FAILED = 1e3
_AS_MUCH = 0.3
_LONGER = (2.0, 5.0, 10.0, 60.0, 100.0, 1e3, 3600.0)
_LATE, _NO_LATER = 0.3, 0.1  # logarithms; right logs come to 0.1 and less
_TINY = 1e-3


class Reading(NamedTuple):
    """Rows as they may have been meant.

    Attributes:
        x: States, ``(m, n)``.
        u: Inputs, then the present signals, ``(m, nu + n_signals)``.
        reached: States after them, ``(m, n)``.
        cost: Logged costs, ``(m,)``.
        u_next: Inputs of the rows after, beside the signals of the same; NaN where there is none.
    """

    x: Array
    u: Array
    reached: Array
    cost: Array
    u_next: Array


_Columns = tuple[tuple[int, ...], tuple[int, ...]]  # of states and of inputs


class Guess(NamedTuple):
    """One way to read the log otherwise: what it is about, in words, and how."""

    name: str
    expected: str
    words: str
    hint: str
    read: Callable[[Reading], Reading]
    columns: int = 1  # how many it changes: of guesses that explain as much, the one of fewest


class Judged(NamedTuple):
    """How well a reading is predicted.

    Attributes:
        errors: Mean absolute errors in units of the motion, ``(n + 1,)``; the last is the cost's.
        floor: What a regression leaves; errors below it are no worse than it, ``(n + 1,)``.
        moved: How far the parameters had to go, in scaled coordinates.
    """

    errors: Array
    floor: Array
    moved: float

    @property
    def good(self) -> NDArray[np.bool_]:
        """Which errors a rough model may have, ``(n + 1,)``."""
        return (self.errors <= _GOOD) | (self.errors <= _BESIDE_LINEAR * self.floor)


def model(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """Whether the log, read otherwise, is what the model predicts; signals are taken as they are."""
    reading, n = _rows(log, mpc.nu), mpc.layout.n_states
    if len(reading.x) < max(_FEW, 5 * (n + mpc.nu)):
        return
    judge = _Judge(mpc, reading)
    plain = judge.identified(reading)
    if plain.good[:n].all() and plain.moved < _FAR and plain.errors[-1] < _NO_COST:
        yield from _late(judge, reading, plain)
        return
    plain = judge.identified(reading, _PATIENCE)  # it may not have come to its end
    guesses = _promising(judge, reading, _guesses(mpc))
    found = [(guess, judge.identified(guess.read(reading))) for guess in guesses]
    found += [(_sampled(mpc.model.dt, k), _Judge(each, reading).identified(reading)) for k, each in _faster(mpc)]
    gains = [_gain(plain, judged) for _, judged in found]
    if gains and max(gains) > 0.0:
        # Of those that explain as much the one that changes least, and of these the one whose errors are smallest.
        best = [each for each, gain in zip(found, gains, strict=True) if gain > max(gains) - _AS_MUCH]
        fewest = min(guess.columns for guess, _ in best)
        guess, judged = min(
            (each for each in best if each[0].columns == fewest),
            key=lambda each: float(np.log(each[1].errors + _TINY).sum()),
        )
        yield _finding(guess, plain, judged, mpc)
    else:
        yield from _late(judge, reading, plain)


def _late(judge: _Judge, reading: Reading, plain: Judged) -> Iterator[Finding]:
    """A finding where each action stands a row too late: small errors become smaller with the action of the row after.

    In a log that is right they become larger.
    """
    if not np.isfinite(reading.u_next).all():
        return
    found = judge.identified(reading._replace(u=reading.u_next))
    ratio = np.log(plain.errors[:-1] + _TINY) - np.log(found.errors[:-1] + _TINY)
    if ratio.sum() > _LATE and ratio.min() > -_NO_LATER:
        i = int(np.argmax(ratio))
        actual = (
            f"actions of the row before: with each row's action taken from the next, the model leaves"
            f" {found.errors[i]:.1%} of observation {i}'s motion unexplained instead of {plain.errors[i]:.1%}"
        )
        hint = "The action of a row is what was applied from its s on, until its s+."
        yield Finding("actions", "actions of the same row", actual, hint)


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
    return Finding(guess.name, guess.expected, actual, guess.hint)


def _rows(log: Excerpt, nu: int) -> Reading:
    """Some of the rows, those with a row after them where there are enough."""
    u_next = np.full_like(log.u, np.nan)
    u_next[:-1][log.together] = log.u[1:][log.together]
    u_next[:, nu:] = log.u[:, nu:]
    use = np.flatnonzero(~log.ended)
    followed = use[np.isfinite(u_next[use]).all(axis=1)]
    if len(followed) >= _FEW:
        use = followed
    use = use[np.unique(np.linspace(0, len(use) - 1, min(_ROWS, len(use))).astype(np.intp))] if len(use) else use
    return Reading(log.x[use], log.u[use], log.reached[use], log.cost[use], u_next[use])


class _Judge:
    """How well a model predicts readings."""

    def __init__(self, mpc: MPC, reading: Reading) -> None:
        self._mpc = mpc
        self._problem = OneStepProblem(mpc, Rows(reading.x, reading.u, reading.reached))
        self._adapts = 0 < self._problem.free.size <= _MOST_PARAMETERS
        heavy = mpc.plant_function.n_instructions() > _HEAVY
        self.tried, self._iterations = (_TRIED_HEAVY, _ITERATIONS_HEAVY) if heavy else (_TRIED, _ITERATIONS)

    def nominal(self, readings: list[Reading]) -> list[Array]:
        """Errors of many readings at theta_0, ``(n + 1,)`` each: one call of the model."""
        x, u = (np.concatenate([getattr(r, name) for r in readings]) for name in ("x", "u"))
        parts = np.split(self._problem.model.predict(x, u, self._mpc.theta), len(readings))
        return [
            self._errors((part - r.reached) / (p := self._on(r)).scale, p, r)
            for part, r in zip(parts, readings, strict=True)
        ]

    def identified(self, reading: Reading, patience: int = 1) -> Judged:
        """Errors with the best parameters within their bounds, found in ``patience`` times the usual iterations."""
        problem, moved = self._on(reading), 0.0
        errors = problem.errors(self._mpc.theta)
        rows, _ = without_jumps(problem.rows, errors * problem.scale)  # wrapped angles
        problem.rows = rows
        errors = problem.errors(self._mpc.theta)
        if self._adapts:
            try:
                z = problem.descend(np.zeros(problem.free.size), _PRIOR, patience * self._iterations).z
            except InvalidDataError:  # the reading is none that the model can take
                pass
            else:
                errors, moved = problem.errors(problem.theta(z)), float(np.abs(z).max())
        floor = np.append(np.maximum(_linear(problem.rows, reading.u), _FLOOR), _COST_FLOOR)
        return Judged(self._errors(errors, problem, reading), floor, moved)

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
    """Those that do best at theta_0, in the order given."""
    some = Reading(*(part[::4] for part in reading))
    reads = [guess.read(some) for guess in guesses]
    errors = judge.nominal(reads)
    scores = [
        float(np.log(np.maximum(error, _FLOOR)).mean()) if np.isfinite(read.reached).all() else np.inf
        for error, read in zip(errors, reads, strict=True)
    ]
    chosen = np.sort(np.argsort(scores, kind="stable")[: judge.tried])
    return [guesses[i] for i in chosen]


def _guesses(mpc: MPC) -> list[Guess]:
    """All of them, the simplest first."""
    nx, nu = mpc.layout.n_states, mpc.nu
    found = [*_signs(nx, nu), *_exchanges(nx, nu), *_sampling(mpc.model.dt)]
    single: list[_Columns] = [((i,), ()) for i in range(nx)] + [((), (j,)) for j in range(nu)]
    pairs: list[_Columns] = [(pair, ()) for pair in combinations(range(nx), 2)] if nx > 2 else []
    mixed: list[_Columns] = [((i,), (j,)) for i in range(nx) for j in range(nu)]
    whole: list[_Columns] = [(tuple(range(nx)), ())] if nx > 1 else []
    whole += [((), tuple(range(nu)))] if nu > 1 else []
    for xs, us in single + whole:
        found += [_scaled(xs, us, factor, 0.0) for factor in FACTORS]
    for xs, us in pairs:
        found += [_scaled(xs, us, factor, 0.0) for factor in FACTORS[:6]]
    for xs, us in single + whole + mixed + [(tuple(range(nx)), tuple(range(nu)))]:
        found += [_scaled(xs, us, 1.0, offset) for offset in OFFSETS]
    return sorted(found, key=lambda guess: guess.columns)


def _scaled(xs: tuple[int, ...], us: tuple[int, ...], factor: float, offset: float) -> Guess:
    def read(r: Reading) -> Reading:
        x, u, reached = r.x.copy(), r.u.copy(), r.reached.copy()
        x[:, xs], reached[:, xs] = factor * x[:, xs] + offset, factor * reached[:, xs] + offset
        u[:, us] = factor * u[:, us] + offset
        return r._replace(x=x, u=u, reached=reached)

    names = [f"observation {i}" for i in xs] + [f"action {j}" for j in us]
    name = " and ".join(names)
    words = f"{name} {'is' if len(names) == 1 else 'are'} {in_words(factor, offset)}"
    return Guess(name, "data in the model's units", words, "Are data and model in the same unit?", read, len(names))


def _signs(nx: int, nu: int) -> Iterator[Guess]:
    hint = "Which direction counts as positive?"
    for j in range(nu):

        def read_u(r: Reading, j: int = j) -> Reading:
            u = r.u.copy()
            u[:, j] *= -1.0
            return r._replace(u=u)

        yield Guess(f"action {j}", "the model's sign", f"the sign of action {j} is flipped", hint, read_u)
    for i in range(nx):

        def read_x(r: Reading, i: int = i) -> Reading:
            x, reached = r.x.copy(), r.reached.copy()
            x[:, i] *= -1.0
            reached[:, i] *= -1.0
            return r._replace(x=x, reached=reached)

        yield Guess(f"observation {i}", "the model's sign", f"the sign of observation {i} is flipped", hint, read_x)


def _exchanges(nx: int, nu: int) -> Iterator[Guess]:
    expected, hint = "columns in the model's order", "Compare the order of the columns with that of the model."
    for a, b in combinations(range(nx), 2):

        def read_states(r: Reading, a: int = a, b: int = b) -> Reading:
            order = list(range(nx))
            order[a], order[b] = b, a
            return r._replace(x=r.x[:, order], reached=r.reached[:, order])

        names = f"observations {a} and {b}"
        yield Guess(names, expected, f"{names} are exchanged", hint, read_states)
    for a, b in combinations(range(nu), 2):

        def read_inputs(r: Reading, a: int = a, b: int = b) -> Reading:
            order = list(range(nu))
            order[a], order[b] = b, a
            return r._replace(u=r.u[:, order])

        names = f"actions {a} and {b}"
        yield Guess(names, expected, f"{names} are exchanged", hint, read_inputs)
    for i in range(nx):
        for j in range(nu):

            def read_both(r: Reading, i: int = i, j: int = j) -> Reading:
                x, u, reached = r.x.copy(), r.u.copy(), r.reached.copy()
                x[:, i], u[:, j], reached[:, i] = r.u[:, j], r.x[:, i], r.u_next[:, j]
                return r._replace(x=x, u=u, reached=reached)

            names = f"observation {i} and action {j}"
            yield Guess(names, expected, f"{names} are exchanged", hint, read_both)


def _sampling(dt: float) -> Iterator[Guess]:
    for factor in _LONGER:
        yield _sampled(dt, factor)
        yield _sampled(dt, 1.0 / factor)


def _sampled(dt: float, factor: float) -> Guess:
    def read(r: Reading) -> Reading:
        return r._replace(reached=r.x + (r.reached - r.x) / factor)

    words = f"the log's sampling time is about {factor * dt:.3g} s ({factor:.3g} times as long)"
    hint = "Give the model the log's dt, in the unit of time of its equations."
    return Guess("dt", f"a log sampled every {dt:g} s, as the model says", words, hint, read)


def _faster(mpc: MPC) -> Iterator[tuple[float, MPC]]:
    """The MPC with its equations over shorter sampling times: a long step of theirs is no multiple of a short one."""
    model = mpc.model
    if model.ode is None or model.scheme is None:
        return
    for factor in _LONGER:
        shorter = copy.copy(model)
        shorter.dt = model.dt / factor
        substeps = 2 if model.scheme == Scheme("rk4") else 1  # another scheme, so that the map is made anew
        yield 1.0 / factor, mpc.replace(model=shorter.with_scheme(Scheme("rk4", substeps)))
