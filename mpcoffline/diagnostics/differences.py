"""What controllers cost more or less than each other on models of a log: paired differences, in the cost's own unit."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.simulation.trials import Trials

SURE = 2.0  # standard errors
TODAY = "today"  # the clone of the controller that made the log
_ENOUGH = 5  # starts
_OUTVOTED = 4  # votes from which on one of them may be an outlier
_FENCE = 3.0  # interquartile ranges


@dataclass(frozen=True)
class Difference:
    """Cost of a controller minus that of another, an entry for each model that has a vote.

    ::

        mean_m = mean_s J(controller, m, s) - J(other, m, s)        the same model, the same start
        error_m = std_s (...) / sqrt(number of starts)

    Attributes:
        name: Of the controller.
        models: Names of the models.
        mean: Mean over the starts, ``(n,)``.
        error: Its standard error, inf for a single start, ``(n,)``.
        low: What it is at least, by two standard errors (see :func:`bounds`), ``(n,)``.
        high: What it is at most, ``(n,)``.
        second_high: What it is at most with another regression of the logged cost, ``(n,)``.
    """

    name: str
    models: tuple[str, ...]
    mean: Array
    error: Array
    low: Array
    high: Array
    second_high: Array

    @classmethod
    def of(cls, trials: Trials, name: str, other: str) -> Difference:
        """From trials, on the starts by which the controller is judged."""
        i, k = trials.names.index(name), trials.names.index(other)
        starts, votes = starts_of(trials, name), trials.votes
        own, second = ([costs[j][votes][:, starts] for j in (i, k)] for costs in (trials.cost, trials.second))
        models = tuple(model for model, vote in zip(trials.models, votes, strict=True) if vote)
        return cls(name, models, *paired(*own), *bounds(*own), bounds(*second)[1])

    def __len__(self) -> int:
        """Number of models."""
        return len(self.models)

    @property
    def middle(self) -> int:
        """The median model; of two the one where the controller is dearer."""
        return int(np.argsort(self.mean, kind="stable")[len(self) // 2])

    @property
    def better(self) -> NDArray[np.bool_]:
        """On which models the controller is cheaper beyond two standard errors, by both regressions, ``(n,)``."""
        return (self.high < 0.0) & (self.second_high < 0.0)

    @property
    def worse(self) -> NDArray[np.bool_]:
        """On which models it is dearer beyond two standard errors, ``(n,)``."""
        return np.asarray(self.low > 0.0)

    @property
    def undecided(self) -> float:
        """How many times as many starts might tell whether it is cheaper; 1 where that is clear, inf where it is not.

        As the median model has it.
        """
        k = self.middle
        gain, doubt = -self.mean[k], SURE * self.error[k]
        return 1.0 if self.agreed or not abs(gain) < doubt else float((doubt / gain) ** 2) if gain > 0.0 else np.inf

    @property
    def agreed(self) -> bool:
        """Whether all models but one, if there are four or more, say that it is cheaper."""
        return len(self) > 0 and int(np.sum(~self.better)) <= outvoted(len(self))


@dataclass(frozen=True)
class Today:
    """A controller against the one that made the log, an entry for each model that has a vote.

    The log's own costs need no model, but levels are predicted worse than differences; a clone of the logged controller
    on the same models needs none of the log's costs, but is not quite that controller. By how much the two ways differ
    is the disagreement of models and log::

        by_log = J(controller) - logged,    by_clone = J(controller) - J(clone),    disagreement = by_log - by_clone

    Attributes:
        logged: Mean cost of the log's own episodes from the same starts; NaN where none is as long.
        logged_error: Its standard error.
        logged_spread: Standard deviation of these costs over the starts.
        low: What both differences are at least, by two standard errors (see :func:`bounds`), ``(n,)``.
        high: What they are at most, ``(n,)``.
        disagreement: J(clone) - logged, ``(n,)``; NaN without one of them.
        disagreement_error: Its standard error, ``(n,)``.
    """

    logged: float
    logged_error: float
    logged_spread: float
    low: Array
    high: Array
    disagreement: Array
    disagreement_error: Array

    @classmethod
    def of(cls, trials: Trials, name: str) -> Today:
        """From trials; of all starts of whole episodes, since today's controller had no part in any choice."""
        votes, whole = trials.votes, whole_episodes(trials)
        costs, returns = trials.of(name)[votes][:, whole], trials.returns[whole]
        known = returns[np.isfinite(returns)]
        ways = [bounds(costs, np.broadcast_to(returns, costs.shape))]
        disagreement = np.full(len(costs), np.nan), np.full(len(costs), np.nan)
        if TODAY in trials.names:
            clone = trials.of(TODAY)[votes][:, whole]
            ways.append(bounds(costs, clone))
            disagreement = paired(clone, np.broadcast_to(returns, clone.shape))
        ends = np.array(ways)  # (ways, 2, n)
        ends = np.where(np.isfinite(ends).all(axis=1, keepdims=True), ends, np.nan)
        low, high = np.fmin.reduce(ends[:, 0]), np.fmax.reduce(ends[:, 1])
        spread = float(known.std(ddof=1)) if len(known) > 1 else np.nan
        logged = float(known.mean()) if len(known) else np.nan
        return cls(logged, spread / np.sqrt(max(1, len(known))), spread, low, high, *disagreement)

    @property
    def known(self) -> bool:
        """Whether there is anything to compare with."""
        return len(self.low) > 0 and bool(np.isfinite(self.low).any())

    @property
    def better(self) -> bool:
        """Whether the controller is cheaper than today's beyond the disagreement, on all models but one."""
        return self.known and int(np.sum(~(self.high < 0.0))) <= outvoted(len(self.high))

    @property
    def worse(self) -> bool:
        """Whether it is dearer beyond the disagreement on most models."""
        return self.known and 2 * int(np.sum(self.low > 0.0)) > len(self.low)

    @property
    def dearer(self) -> bool:
        """Whether it is rather dearer, of what is between."""
        return self.known and float(np.nanmedian(self.low + self.high)) > 0.0

    @property
    def middle(self) -> tuple[float, float]:
        """Lowest and highest difference on the median model."""
        k = int(np.argsort(self.low + self.high, kind="stable")[int(np.isfinite(self.low).sum()) // 2])
        return float(self.low[k]), float(self.high[k])


@dataclass(frozen=True)
class Candidate:
    """A controller that was tried, against MPC_1 on the models with a vote.

    Attributes:
        name: Its name.
        cost: Mean cost of an episode on its median model.
        difference: Cost minus that of MPC_1, there.
        error: Standard error of the difference.
        agree: Number of models on which it is cheaper beyond two standard errors, by both regressions of the cost.
        of: Number of models.
        lost: Share of its episodes that were lost.
    """

    name: str
    cost: float
    difference: float
    error: float
    agree: int
    of: int
    lost: float


def candidates(trials: Trials) -> tuple[Candidate, ...]:
    """All controllers that were tried but MPC_1, the cheapest first; none where no model has a vote."""
    found = []
    for i, name in enumerate(trials.names[1:], 1):
        d, starts = Difference.of(trials, name, trials.names[0]), starts_of(trials, name)
        if len(d) and starts.any():
            k = d.middle
            cost, _ = paired(trials.cost[i][trials.votes][:, starts], np.zeros((len(d), int(starts.sum()))))
            lost = float(trials.lost[i][trials.votes][:, starts].mean())
            levels = float(cost[k]), float(d.mean[k]), float(d.error[k])
            found.append(Candidate(name, *levels, int(d.better.sum()), len(d), lost))
    return tuple(sorted(found, key=lambda each: np.nan_to_num(each.difference, nan=np.inf)))


def starts_of(trials: Trials, name: str) -> NDArray[np.bool_]:
    """The starts by which a controller is judged: those that had no part in the choice, where it was tried there.

    One that left the choice early was tried on others alone; all count where nothing was chosen.
    """
    tried = np.asarray(~np.isnan(trials.of(name)).all(axis=0))
    fresh = trials.judged & tried
    return fresh if fresh.any() else tried


def whole_episodes(trials: Trials) -> NDArray[np.bool_]:
    """The starts at which episodes of the log began, which tell what one costs; all where there are hardly any.

    Those whose episode is as long as a simulated one, where there are some: so that all costs are of the same starts.
    """
    begun = trials.begun if trials.begun.sum() > 1 else np.ones(len(trials.rows), dtype=bool)
    known = begun & np.isfinite(trials.returns)
    return known if known.sum() >= _ENOUGH else begun


def outvoted(n: int) -> int:
    """How many of n models may object and be named, not obeyed."""
    return 1 if n >= _OUTVOTED else 0


def bounds(costs: Array, others: Array) -> tuple[Array, Array]:
    """What the mean over the starts of costs ``(n, starts)`` minus others is at least and at most, ``(n,)`` each.

    Two standard errors about it. Where a few starts differ enormously (a pendulum that never swings up, a reactor that
    runs away), these make the error as large as the mean, however sure its sign is. What they save is counted as an
    ordinary large one for the upper bound, what they lose for the lower bound::

        mean(d) <= mean(max(d, floor)),  mean(d) >= mean(min(d, ceiling)),      whatever floor and ceiling are

    They are Tukey's outer fences, three interquartile ranges from the quartiles: what is normal has nothing beyond.
    """
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # where no start was tried
        difference = costs - others
        if not difference.size:
            return _two_errors(difference)
        first, third = np.nanquantile(difference, (0.25, 0.75), axis=1, keepdims=True, method="nearest")
        reach = _FENCE * (third - first)
        cut_gains, cut_losses = np.maximum(difference, first - reach), np.minimum(difference, third + reach)
        lows, highs = zip(*(_two_errors(each) for each in (difference, cut_gains, cut_losses)), strict=True)
        return np.fmax(lows[0], lows[2]), np.fmin(highs[0], highs[1])


def _two_errors(difference: Array) -> tuple[Array, Array]:
    mean, error = paired(difference, np.zeros_like(difference))
    return mean - SURE * error, mean + SURE * error


def paired(costs: Array, others: Array) -> tuple[Array, Array]:
    """Mean over the starts of costs ``(n, starts)`` minus others, and its standard error ``(n,)``.

    What was not tried is left out. Of fewer than two starts nothing is known: the error is inf, of none the mean NaN.
    """
    with np.errstate(invalid="ignore"):
        difference = costs - others
    tried = ~np.isnan(difference)
    count, kept = tried.sum(axis=1), np.where(tried, difference, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = kept.sum(axis=1) / count
        square = np.where(tried, (difference - mean[:, None]) ** 2, 0.0).sum(axis=1)
        error = np.sqrt(square / (count - 1) / count)
    return mean, np.where((count > 1) & np.isfinite(error), error, np.inf)
