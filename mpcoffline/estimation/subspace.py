"""A linear model from nothing but a log of outputs and inputs, for plants of which nobody has equations."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.core.threads import one_blas_thread
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable

from .scaled_episodes import ScaledEpisodes
from .sensors import listed, steps_late
from .structure import clearly_negative

AHEAD = 15  #: Steps that are predicted to judge a model, or as many as episodes allow.

_LAGS = (1, 2, 3, 4, 6, 8, 12, 16, 24)  # of outputs and inputs that an output is regressed on
_ROWS_A_NUMBER = 3  # that are the least to learn it from
_LONGEST_DELAY = 15
_FOLDS, _PIECES = 4, 8  # longer episodes than this part of the rows are cut
_NEGLIGIBLE = 1e-3  # spreads: no model is better for missing less, as of a log without noise
_AS_GOOD, _NEAR = 1.02, 1.2  # times the least error: simpler models are taken as far as this; if that may be chance
_RIDGE = 1e-9  # of the largest variance of a regressor
_ORDERS = (*range(1, 9), 10, 12, 16)  # numbers of states
_WINDOWS = 2_000  # that judge a model
_FEW = 3  # episodes, below which their beginnings say little of others'
_ABSURD = 1e6  # spreads: what runs away counts as this


@dataclass(frozen=True)
class LinearModel:
    """``x+ = A x + B u_late + E d + b``, ``y = C x + c``, of what was logged, in its units; states have spread 1.

    Attributes:
        A: ``(nx, nx)``.
        B: ``(nx, nu)``, of inputs that acted ``delay`` steps late.
        E: ``(nx, n_signals)``; zero for a signal that moves nothing.
        b: ``(nx,)``.
        C: ``(ny, nx)``.
        c: ``(ny,)``.
        K: What one step's error of the outputs says of the next state, ``(nx, ny)``.
        delay: Dead time of each input in steps, ``(nu,)``.
        inputs: Their means over the log, ``(nu,)``.
        noise: Standard deviation of the error of a prediction by one step, ``(ny,)``.
        start: Mean of the states where episodes begin, ``(nx,)``.
        start_spread: Their standard deviation, ``(nx,)``.
        missed: How far each output is from what was predicted 15 steps before (or as many as episodes allow) on
            episodes held out, in its spread, ``(ny,)``.
        steps: So many.
    """

    A: Array
    B: Array
    E: Array
    b: Array
    C: Array
    c: Array
    K: Array
    delay: tuple[int, ...]
    inputs: Array
    noise: Array
    start: Array
    start_spread: Array
    missed: Array
    steps: int

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.A)

    def __str__(self) -> str:
        """What it is, in a sentence or two."""
        late = f", inputs {steps_late(self.delay)}" if any(self.delay) else ""
        return (
            f"A linear model with {self.order} {'state' if self.order == 1 else 'states'}{late}, from the log alone."
            f" {self.steps} steps ahead it misses outputs of episodes held out by {listed(100.0 * self.missed)} % of"
            " their spread. It knows nothing beyond where the log has been, and no curvature there."
        )


@one_blas_thread()
def linear_model(
    log: TransitionTable, n_outputs: int, signals: Sequence[int] = (), delay: Sequence[int | None] = (), seed: int = 0
) -> LinearModel:
    """A linear state-space model of a log, by a predictor-based subspace method.

    Outputs are regressed on ``p`` past outputs, inputs and signals, which is consistent where a controller made the
    log, too. What these predict of the future has, beyond noise, the rank of the plant's state: a singular value
    decomposition gives states, and least squares the model of them (Chiuso, "The role of vector autoregressive modeling
    in predictor-based subspace identification", Automatica 43, 2007). Lags, dead times, the number of states, and which
    signals move anything, are what predicts 15 steps of episodes held out; of models as good within 2 % the simplest.

    Args:
        log: Transitions whose observations are the outputs, then the columns of signals.
        n_outputs: How many outputs there are.
        signals: Columns of the observation that may move the plant: the present values of signals.
        delay: Dead time of each input in steps, ``(nu,)``; None for one that is looked for, as all are by default.
        seed: Chooses what is held out: episodes, or pieces of long ones.

    Raises:
        InvalidArgumentError: For columns that are not there, or dead times of another number than inputs.
        InvalidDataError: If an output never moves, or rows are too few.
    """
    given = tuple(delay) or (None,) * log.nu
    if len(given) != log.nu:
        raise InvalidArgumentError("delay", expected=f"{log.nu} numbers or None", actual=str(given))
    columns = [*range(n_outputs), *signals]
    if not columns or not 0 < n_outputs <= log.ny or max(columns) >= log.ny or min(columns) < 0:
        raise InvalidArgumentError("columns", expected=f"some of {log.ny} of the observation", actual=str(columns))
    return _Search(ScaledEpisodes.of(log, n_outputs, signals), given, seed).model()


class _Part(NamedTuple):
    """Rows with a past: regressors, the output, and where they are."""

    past: Array  # (n, lags * (ny + nw)): [y, w] of one step before, two, ...
    now: Array  # (n, ny)
    episode: NDArray[np.intp]
    step: NDArray[np.intp]


class _Fitted(NamedTuple):
    """A model in scaled coordinates."""

    A: Array
    B: Array  # of what acts, the one included
    C: Array
    c: Array
    K: Array
    state: Array  # x = past @ state
    noise: Array

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.A)


class _Tried(NamedTuple):
    """What models of one kind miss on episodes held out."""

    order: int
    lags: int
    delay: tuple[int, ...]
    errors: Array  # squares after the most steps, (windows, ny)
    episodes: NDArray[np.intp]  # of each window

    @property
    def error(self) -> float:
        """Root mean square."""
        return float(np.sqrt(self.errors.mean()))


class _Search:
    """Which lags, dead times, signals and number of states predict best."""

    def __init__(self, data: ScaledEpisodes, given: Sequence[int | None], seed: int) -> None:
        self._data, self._given = data, given
        lengths = [len(each) for each in data.w]
        self._folds = np.split(_folds(data.episodes_of_rows, seed), np.cumsum(lengths)[:-1])
        self._longest = max(lengths)
        self.steps = min(AHEAD, max(1, self._longest // 3))
        n_signals = data.w[0].shape[1] - data.nu

        def numbers(lags: int) -> int:
            return lags * int(data.y[0].shape[1] + data.nu + n_signals) + 1

        def rows(lags: int) -> int:
            return sum(max(0, length - lags) for length in lengths)

        self._lags = [
            p for p in _LAGS if 2 * p + self.steps <= self._longest and rows(p) >= _ROWS_A_NUMBER * numbers(p)
        ]
        if not self._lags:
            hint = "Log more, or describe the plant by equations: these need fewer numbers."
            expected = f"{_ROWS_A_NUMBER * numbers(1)} rows at least, in episodes of 3 steps or more"
            actual = f"{rows(1)} in episodes of up to {self._longest} steps"
            raise InvalidDataError("log", expected=expected, actual=actual, hint=hint)

    def model(self) -> LinearModel:
        """The best one, fitted to all episodes, in units."""
        n_signals = self._data.w[0].shape[1] - self._data.nu
        delay, moving = tuple(given or 0 for given in self._given), np.ones(n_signals, dtype=bool)
        best = self._best(delay, moving)
        unknown = [i for i, given in enumerate(self._given) if given is None]
        for i in unknown * (2 if len(unknown) > 1 else 1):
            delays = ((*delay[:i], d, *delay[i + 1 :]) for d in range(min(_LONGEST_DELAY, self._longest // 4) + 1))
            delay = _simplest([self._best(each, moving, [best.lags]) for each in delays]).delay
        best = self._best(delay, moving) if unknown else best
        for j in range(n_signals):
            less = moving & (np.arange(n_signals) != j)
            without = self._best(delay, less)
            if not _clearly_worse(without, best):
                moving, best = less, without
        acting = self._data.late(delay, moving)
        (whole,) = self._fitted(self._part(best.lags, acting), best.lags, [best.order], acting)
        return self._in_units(whole, best, acting, moving)

    def _best(self, delay: tuple[int, ...], moving: NDArray[np.bool_], lags: Sequence[int] = ()) -> _Tried:
        """The simplest kind of model of those that predict best."""
        acting = self._data.late(delay, moving)
        tried = [each for p in lags or self._lags for each in self._tried(p, delay, acting)]
        if not tried:
            actual = "stretches of which none is left where another is held out"
            raise InvalidDataError("log", expected="rows to fit and others to judge by", actual=actual)
        return _simplest(tried)

    def _tried(self, lags: int, delay: tuple[int, ...], acting: list[Array]) -> list[_Tried]:
        """Models of all orders: each quarter of the episodes is predicted by what the others gave."""
        errors: dict[int, list[Array]] = {order: [] for order in _ORDERS}
        episodes = []
        for fold in range(_FOLDS):
            fit, held_out = (self._part(lags, acting, fold, judging=judging) for judging in (False, True))
            if len(fit.now) <= fit.past.shape[1]:
                return []
            windows = self._windows(held_out)
            episodes.append(held_out.episode[windows])
            for model in self._fitted(fit, lags, _ORDERS, acting):
                errors[model.order].append(self._missed(model, held_out, windows, acting))
        return [
            _Tried(order, lags, delay, np.concatenate(found), np.concatenate(episodes))
            for order, found in errors.items()
            if len(found) == _FOLDS
        ]

    def _part(self, lags: int, acting: list[Array], fold: int = -1, *, judging: bool = False) -> _Part:
        """Rows with so many steps before them: those that judge in a fold, or all others."""
        parts = []
        for e, (y, w) in enumerate(zip(self._data.y, acting, strict=True)):
            steps = np.arange(lags, len(w))
            steps = steps[(self._folds[e][steps] == fold) == judging]
            past = [np.hstack([y[steps - j], w[steps - j, :-1]]) for j in range(1, lags + 1)]
            parts.append((np.hstack(past), y[steps], np.full(len(steps), e), steps))
        return _Part(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def _fitted(self, fit: _Part, lags: int, orders: Sequence[int], acting: list[Array]) -> list[_Fitted]:
        """Models of these orders; fewer where the past says of the future no more than fewer numbers."""
        ny = fit.now.shape[1]
        H = _least_squares(np.hstack([fit.past, np.ones((len(fit.past), 1))]), fit.now)[:-1]  # (lags * width, ny)
        width = len(H) // lags
        ahead = np.zeros((len(H), lags * ny))  # what the past says of so many steps, if nothing follows
        for i in range(lags):
            ahead[: len(H) - i * width, i * ny : (i + 1) * ny] = H[i * width :]
        variances, directions = np.linalg.eigh(ahead.T @ np.cov(fit.past, rowvar=False) @ ahead)
        sizes, directions = np.sqrt(np.maximum(variances[::-1], 0.0)), directions[:, ::-1]
        w = np.concatenate([acting[e][k] for e, k in _runs(fit.episode, fit.step)])
        going = np.flatnonzero((np.diff(fit.step) == 1) & (np.diff(fit.episode) == 0))
        found = []
        for n in orders:
            if n <= len(sizes) and sizes[n - 1] > _RIDGE * sizes[0]:
                state = ahead @ directions[:, :n] / sizes[:n]
                x = fit.past @ state
                *C, c = _least_squares(np.hstack([x, np.ones((len(x), 1))]), fit.now)
                errors = fit.now - x @ np.array(C) - c
                maps = _least_squares(np.hstack([x, w, errors])[going], x[going + 1]).T
                A, B, K = np.split(maps, [n, n + w.shape[1]], axis=1)
                found.append(_Fitted(A, B, np.array(C).T, c, K, state, errors.std(axis=0)))
        return found

    def _windows(self, part: _Part) -> NDArray[np.intp]:
        """From which rows is predicted: the same ones, whatever the lags, so that models can be compared."""
        lengths = np.array([len(each) for each in self._data.w])
        some = (part.step + part.episode) % max(1, int(lengths.sum()) // _WINDOWS) == 0
        late = part.step >= self._lags[-1]
        return np.flatnonzero(some & late & (part.step + self.steps <= lengths[part.episode]))

    def _missed(self, model: _Fitted, part: _Part, windows: NDArray[np.intp], acting: list[Array]) -> Array:
        """Squared errors some steps ahead."""
        lengths = np.array([len(each) for each in acting])
        starts = np.cumsum(lengths) - lengths
        e, k = part.episode[windows], part.step[windows]
        x, w = part.past[windows] @ model.state, np.concatenate(acting)
        with np.errstate(over="ignore", invalid="ignore"):
            for j in range(self.steps):
                x = x @ model.A.T + w[starts[e] + k + j] @ model.B.T
            y = np.concatenate(self._data.y)[starts[e] + e + k + self.steps]
            squares = (y - x @ model.C.T - model.c) ** 2
        return np.asarray(np.nan_to_num(np.minimum(squares, _ABSURD), nan=_ABSURD))

    def _in_units(self, model: _Fitted, judged: _Tried, acting: list[Array], moving: NDArray[np.bool_]) -> LinearModel:
        (y_mean, y_spread), (w_mean, w_spread), nu = self._data.y_scale, self._data.w_scale, self._data.nu
        B = model.B[:, :-1] / w_spread * np.append(np.ones(nu), moving)
        start, spread = _beginnings(model, self._data, acting, judged.lags)
        return LinearModel(
            A=model.A,
            B=B[:, :nu],
            E=B[:, nu:],
            b=model.B[:, -1] - B @ w_mean,
            C=y_spread[:, None] * model.C,
            c=y_mean + y_spread * model.c,
            K=model.K / y_spread,
            delay=judged.delay,
            inputs=w_mean[:nu],
            noise=y_spread * model.noise,
            start=start,
            start_spread=spread,
            missed=np.sqrt(judged.errors.mean(axis=0)),
            steps=self.steps,
        )


def _simplest(tried: Sequence[_Tried]) -> _Tried:
    """Of those that are as good as the best, one of the fewest states.

    That is within 2 %, or within a fifth where episodes held out do not say for sure that it is worse.
    """
    best = min(tried, key=lambda each: each.error)
    least = max(best.error, _NEGLIGIBLE)
    near = [each for each in tried if each.error <= _NEAR * least]
    good = [each for each in near if each.error <= _AS_GOOD * least or not _clearly_worse(each, best)]
    return min(good, key=lambda each: (each.order, each.error))


def _clearly_worse(one: _Tried, other: _Tried) -> bool:
    """Whether models predict worse, beyond chance: paired window by window, those of an episode counting as one."""
    return clearly_negative((other.errors - one.errors).mean(axis=1), one.episodes)


def _folds(episodes: NDArray[np.intp], seed: int) -> NDArray[np.intp]:
    """The quarter ``(n,)`` that each row is held out with: of whole episodes, or of pieces of long ones."""
    n = len(episodes)
    begins = np.append(True, episodes[1:] != episodes[:-1])
    within = (np.arange(n) - np.maximum.accumulate(np.where(begins, np.arange(n), 0))) // -(-n // _PIECES)
    piece = np.cumsum(begins | np.append(False, within[1:] != within[:-1])) - 1
    order = np.random.default_rng(seed).permutation(int(piece[-1]) + 1)
    before = np.cumsum(np.bincount(piece)[order]) - np.bincount(piece)[order]
    fold = np.empty(len(order), dtype=np.intp)
    fold[order] = before * _FOLDS // n
    return np.asarray(fold[piece])


def _least_squares(inputs: Array, outputs: Array) -> Array:
    """Ridge regression: next to none, but where inputs hang together."""
    gram = inputs.T @ inputs
    ridge = _RIDGE * np.diag(gram).max() * np.eye(len(gram))
    return np.asarray(np.linalg.solve(gram + ridge, inputs.T @ outputs))


def _runs(episode: NDArray[np.intp], step: NDArray[np.intp]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """The steps of each episode, in their order."""
    for e, rows in itertools.groupby(range(len(episode)), key=lambda k: int(episode[k])):
        yield e, step[list(rows)]


def _beginnings(model: _Fitted, data: ScaledEpisodes, acting: list[Array], lags: int) -> tuple[Array, Array]:
    """Mean and spread of the states where episodes begin: by least squares on their first outputs, before a prior."""
    n, found, left = len(model.A), list[Array](), np.zeros((len(model.A),) * 2)
    noise = np.maximum(model.noise, _NEGLIGIBLE)
    for y, w in zip(data.y, acting, strict=True):
        forced, seen = np.zeros(n), np.eye(n)
        rows, values = [], []
        for k in range(min(len(w), max(2 * n, lags)) + 1):
            rows.append(model.C @ seen / noise[:, None])
            values.append((y[k] - model.C @ forced - model.c) / noise)
            if k < len(w):
                forced, seen = model.A @ forced + model.B @ w[k], model.A @ seen
        H, v = np.vstack(rows), np.concatenate(values)
        covariance = np.linalg.inv(H.T @ H + np.eye(n))  # states have spread 1 over the log
        found.append(covariance @ H.T @ v)
        left += covariance / len(data.y)
    starts = np.array(found)
    spread = np.ones(n) if len(starts) < _FEW else np.sqrt(starts.var(axis=0) + np.diag(left))
    return starts.mean(axis=0), spread
