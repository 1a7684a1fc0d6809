"""Which of some controllers is best on the models of a log: what is clearly worse leaves early."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, Self

import numpy as np

from mpcoffline.core.executors import Executor, Serial
from mpcoffline.core.parallel import chosen, n_cpus
from mpcoffline.mpc import MPC

from .episodes import Controller, Episodes
from .quick import quick_policy
from .trials import Surroundings, Trials

FIRST = "MPC_1"
_ROUNDS = (1 / 8, 1 / 3, 5 / 8)  # of the usual starts until the end of each; what is left judges
_CLEAR = 2.0  # standard errors
_TRIFLE = 0.01  # of the gain over MPC_1: what is better by less is no better
_TOGETHER = 4  # MPCs whose closed loops are stepped together: much faster, and something is told in between
_JUDGED = 3  # of the best at most, one after the other
_VARIED = (3, 1)  # of so many of the best, variants are tried after each of the first rounds
_STAY = (math.inf, 6, 4)  # so many at most after each round, and the preferred one
_LABOUR = 4.0  # times the solver's iterations of the best one, for nothing


def choose(
    mpcs: dict[str, MPC],
    around: Surroundings,
    variants: Callable[[Mapping[str, MPC], int], Mapping[str, MPC]] = lambda mpcs, turn: {},
    tell: Callable[[int, int, str], None] = lambda *what: None,
    preferred: str = "",
) -> tuple[Trials, str]:
    """Tries MPCs on the models of the log and names the best.

    In rounds, each with more starts: after each, those leave that cost clearly more than the best, or take their solver
    over four times its iterations; from the second one on, what comes after the six best, then the four best. Where the
    last one leaves several that are not alike, all usual starts choose and the spare ones judge.
    The best has the least mean cost on the median model, of those that have a vote; but first comes the preferred one,
    where nothing has shown it to be worse. It is taken if it costs no more than ``"MPC_1"`` by both regressions of the
    cost, and the starts that are left do not say otherwise (:meth:`Trials.improves`), else the next best is asked;
    where no model has a vote, ``"MPC_1"`` stays.

    What acts in a round does so in groups of four: here, or as jobs of the executor that ``$MPCOFFLINE_EXECUTOR``
    names, which gives the same numbers.

    Args:
        mpcs: By name, the first one ``"MPC_1"``; variants that were tried join them.
        around: Where they are tried; at most two thirds of its starts are used to choose.
        variants: What is tried, too, of the three best after the first round (turn 0), of the best after the next (1).
        tell: Is told how many starts of how many are done, and what is tried.
        preferred: Which one is taken where no other is clearly better; it goes on as long as that is so.

    Returns:
        The trials, and the name of the best.
    """
    usual = around.usual
    trials = Trials.none(list(mpcs), around)
    if not trials.votes.any():
        return trials.judged_from(0), FIRST
    with Stage(around, usual, tell) as stage:
        return _chosen(trials, mpcs, around, variants, stage, preferred)


def _chosen(
    trials: Trials,
    mpcs: dict[str, MPC],
    around: Surroundings,
    variants: Callable[[Mapping[str, MPC], int], Mapping[str, MPC]],
    stage: Stage,
    preferred: str,
) -> tuple[Trials, str]:
    """The rounds of :func:`choose`."""
    usual, left, begin = around.usual, list(mpcs), 0
    ends = sorted({max(1, round(usual * share)) for share in _ROUNDS})
    stage.add(mpcs)

    def act(names: list[str], starts: slice) -> None:
        stage.act(names, trials, starts)

    def going_on(end: int, turn: int = 0) -> list[str]:
        labour = {name: stage.iterations(name) for name in left}
        good, most = _still_good(trials, left, end, preferred, labour), _STAY[min(turn, len(_STAY) - 1)]
        return [name for place, name in enumerate(good) if place < most or name == preferred]

    for turn, end in enumerate(ends):
        act(left, slice(begin, end))
        if turn < len(_VARIED):  # what is better may be better still
            good = going_on(end)[: _VARIED[turn]]
            more = variants({name: mpcs[name] for name in good}, turn)
            mpcs.update(more)
            stage.add(more)
            trials, left = trials.with_names(list(more)), [*left, *more]
            act(list(more), slice(0, end))
        left, begin = [FIRST, *going_on(end, turn)], end
        if left == [FIRST]:
            return trials.judged_from(begin), FIRST
    total = usual
    if len(left) > 2 and len(around.rows) > usual:
        act(left, slice(begin, usual))
        left, begin, total = [FIRST, *going_on(usual, len(ends))], usual, len(around.rows)
    act([FIRST], slice(begin, total))
    chosen = FIRST
    for name in sorted(left[1:], key=lambda name: name != preferred)[:_JUDGED]:
        act([name], slice(begin, total))
        if trials.judged_from(begin).improves(name):
            chosen = name
            break
    return trials.judged_from(begin), chosen


def various_first(around: Surroundings, mpc: MPC) -> Surroundings:
    """The same with the usual starts in an order of which each beginning is as various as the whole.

    Controllers often differ by rare starts alone, from which one swings up and another never does. Early rounds would
    not see them, and take for no better what is. So the starts are sorted by what they cost under an MPC, and taken
    from the dearest on in the order of van der Corput: then the middle, then the quarters, and so on.

    Args:
        around: Where controllers are tried.
        mpc: By whose cost on the median model starts are sorted.
    """
    if not around.models.votes.any():
        return around
    (done,) = around.act([around.seeing(quick_policy(mpc))], slice(0, around.usual))
    cost = np.median(done.cost[around.models.votes], axis=0)
    dearest = np.argsort(-np.where(np.isnan(cost), np.inf, cost), kind="stable")
    digits = max(1, (len(cost) - 1).bit_length())
    reversed_digits = [int(f"{i:0{digits}b}"[::-1], 2) for i in range(len(cost))]
    order = dearest[np.argsort(reversed_digits)]
    return around.reordered(np.append(order, np.arange(around.usual, len(around.rows))))


class Stage:
    """Where MPCs act, a group at a time: here, or in the workers of an executor.

    Args:
        around: What happens to them.
        usual: How many starts there are, as is told.
        tell: Is told how many starts of how many are done, and what is tried; at the end, that all are.
    """

    def __init__(self, around: Surroundings, usual: int, tell: Callable[[int, int, str], None]) -> None:
        self._around, self._usual, self._tell = around, usual, tell
        self._mpcs: dict[str, MPC] = {}
        self._acting = _Acting(around)
        self._spent: dict[str, tuple[int, int]] = {}  # iterations, starts
        self._pool: Executor[_Act, list[Episodes]] | None = None
        kind = chosen(default="serial")
        if kind is not Serial:
            self._pool = kind(self._acting, n_cpus())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._pool is not None:
            self._pool.close()
        if kind is None:
            self._tell(self._usual, self._usual, "")

    def add(self, mpcs: Mapping[str, MPC]) -> None:
        """Further ones, by name."""
        self._mpcs.update(mpcs)

    def act(self, names: list[str], trials: Trials, starts: slice) -> None:
        """Puts what some do from some of the starts into the trials.

        Raises:
            JobError: If a worker fails, or is lost again and again.
        """
        groups = [names[i : i + _TOGETHER] for i in range(0, len(names), _TOGETHER)]
        jobs = {", ".join(some): _Act({name: self._mpcs[name] for name in some}, starts) for some in groups}
        if self._pool is None:
            for told, job in jobs.items():
                self._tell(starts.start, self._usual, told)
                self._put(dict(zip(job.mpcs, self._acting(job), strict=True)), trials, starts)
            return
        self._tell(starts.start, self._usual, "; ".join(jobs))
        for told, done in self._pool.run(jobs):
            self._put(dict(zip(jobs[told].mpcs, done, strict=True)), trials, starts)

    def _put(self, done: dict[str, Episodes], trials: Trials, starts: slice) -> None:
        trials.put(done, self._around, starts)
        for name, episodes in done.items():
            iterations, count = self._spent.get(name, (0, 0))
            self._spent[name] = iterations + episodes.iterations, count + episodes.cost.shape[1]

    def iterations(self, name: str) -> float:
        """How many iterations of its solver an MPC has taken so far, a start."""
        iterations, count = self._spent[name]
        return iterations / count


class _Act(NamedTuple):
    """A job: MPCs that act together from some of the starts."""

    mpcs: dict[str, MPC]
    starts: slice


class _Acting:
    """Does jobs; whoever does several keeps the solvers."""

    def __init__(self, around: Surroundings) -> None:
        self._around = around
        self._policies: dict[str, Controller] = {}

    def __call__(self, job: _Act) -> list[Episodes]:
        for name, mpc in job.mpcs.items():
            if name not in self._policies:
                self._policies[name] = self._around.seeing(quick_policy(mpc))
        return self._around.act([self._policies[name] for name in job.mpcs], job.starts)


def _still_good(trials: Trials, names: list[str], end: int, preferred: str, labour: Mapping[str, float]) -> list[str]:
    """Those, but MPC_1, that are not clearly worse than the best; the best first, or the preferred one if as good.

    Of those that are alike, the first; none that takes much more labour, iterations a start, than the best: whoever
    hands it out would wait for nothing.
    """
    differences = {name: trials.differences(name)[trials.votes][:, :end] for name in names}
    score = {name: float(np.median(each.mean(axis=1))) for name, each in differences.items()}
    best = min(names, key=lambda name: score[name])
    trifle = _TRIFLE * abs(score[best])

    def near(name: str) -> bool:
        if name != best and labour[name] > _LABOUR * max(labour[best], 1.0):
            return False
        gap = differences[name] - differences[best]
        mean, error = gap.mean(axis=1), gap.std(axis=1) / np.sqrt(end)
        return bool(np.mean(mean > np.maximum(_CLEAR * error, trifle)) <= 0.5)

    def order(name: str) -> float:
        return -np.inf if name == preferred and score[name] <= score[best] + trifle else score[name]

    kept: list[str] = []
    for name in sorted((name for name in names if name != FIRST and near(name)), key=order):
        others = (differences[name] - differences[other] for other in kept)
        if not any(float(np.abs(gap).mean()) <= trifle for gap in others):
            kept.append(name)
    return kept
