"""The verdict: is the proposed controller better than MPC_1, and than what runs today, on the models of the log?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mpcoffline.core.text import figure, listed
from mpcoffline.core.types import Array
from mpcoffline.simulation.trials import Trials

from .differences import SURE, TODAY, Difference, Today, outvoted, paired, starts_of, whole_episodes
from .withholding import NO_MODEL_PREDICTS, gone_wrong, runaway

Verdict = Literal["recommend", "try with care", "keep MPC_1"]

_LEAST = 0.005  # of the spread of MPC_1's costs over the starts: a smaller gain is none
_MANY_STARTS = 2_000
_ALIKE = 2.0  # models whose gains differ by less than this factor give it a size
_FAILED = 0.01


@dataclass(frozen=True)
class Judgement:
    """A verdict and what it rests on.

    Attributes:
        verdict: ``"recommend"``, ``"try with care"`` or ``"keep MPC_1"``.
        reasons: Why, and what would change it; the decisive one first.
        proposal: The controller that was judged.
        first: Its cost minus that of MPC_1; None where no model has a vote.
        today: It against the controller that made the log.
        expected: Lowest, middle and highest mean cost of an episode that the models let expect, as they are and less
            what they have wrong of the controller that made the log; NaN where no model has a vote.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    proposal: str
    first: Difference | None
    today: Today
    expected: tuple[float, float, float]


@np.errstate(invalid="ignore")  # of costs that are not finite nothing follows
def decide(
    trials: Trials,
    proposal: str,
    *,
    failed: float = 0.0,
    choice: Trials | None = None,
) -> Judgement:
    """The verdict and why.

    All figures are differences of costs of the same start on the same model, in the unit of the logged cost; only
    models with a vote count. Recommended is a controller that is cheaper than MPC_1 beyond two standard errors, by both
    regressions of the cost, on all of them but one (of four or more: an outlier is named, not obeyed), and cheaper than
    what runs today by more than models and log disagree about that, unless it is lost more often than MPC_1. Costs
    ``a L + b`` with a > 0 give the verdict of L.

    Args:
        trials: MPC_1, the proposal, perhaps the clone of today's controller, on the models of the log.
        proposal: Name of the controller that is judged; ``"MPC_1"`` where nothing better was found.
        failed: Share of the proposal's problems that were not solved at first.
        choice: The trials in which the proposal was chosen, if they are others: what else was tried.

    Returns:
        The judgement.
    """
    today, expected = Today.of(trials, proposal), _expected(trials, proposal)
    if not trials.votes.any():
        return Judgement("keep MPC_1", (NO_MODEL_PREDICTS,), proposal, None, today, expected)
    if proposal == trials.names[0]:
        reasons = (_nothing_better(choice or trials), *_of_today(today, trials, proposal))
        return Judgement("keep MPC_1", reasons, proposal, Difference.of(trials, proposal, proposal), today, expected)
    first = Difference.of(trials, proposal, trials.names[0])
    lost = runaway(trials, proposal)
    doubts = () if lost is None else (lost,)
    told = [*_of_today(today, trials, proposal), *gone_wrong(trials, proposal), *_failures(failed)]
    if not _gains(first, trials):
        return Judgement("keep MPC_1", (_no_gain(first, trials), *told, *doubts), proposal, first, today, expected)
    if today.known and today.worse:
        return Judgement("keep MPC_1", (*told, _gain(first, trials), *doubts), proposal, first, today, expected)
    clear = first.agreed and not doubts and (today.better or not today.known)
    reasons = (_gain(first, trials), *_objections(first, trials), *doubts, *told)
    if clear:
        reasons = (*reasons, _to_see(expected))
    return Judgement("recommend" if clear else "try with care", reasons, proposal, first, today, expected)


def _gains(first: Difference, trials: Trials) -> bool:
    """Whether the median model says that the controller is cheaper, beyond two standard errors and a trifle."""
    k = first.middle
    return bool(first.high[k] < 0.0 and -first.mean[k] > _LEAST * _spread(trials, first, k))


def _spread(trials: Trials, first: Difference, k: int) -> float:
    """Standard deviation over the starts of MPC_1's cost on voting model k."""
    costs = _costs(trials, trials.names[0], first, k)
    return float(np.nanstd(costs)) if np.isfinite(costs).any() else 0.0


def _level(trials: Trials, name: str, first: Difference, k: int) -> float:
    """Mean cost on voting model k."""
    costs = _costs(trials, name, first, k)
    return float(np.nanmean(costs)) if not np.isnan(costs).all() else np.nan


def _costs(trials: Trials, name: str, first: Difference, k: int) -> Array:
    """Costs of a controller on voting model k from the starts of a difference."""
    return np.asarray(trials.of(name)[trials.votes][k][starts_of(trials, first.name)])


def _expected(trials: Trials, proposal: str) -> tuple[float, float, float]:
    """See :class:`Judgement`: the models but one on either side, with two standard errors of a mean over the starts.

    And what the median model lets expect by the other regression of the cost, and less what it said too much of the
    controller that made the log; but no less than an episode can cost at all.
    """
    costs = trials.of(proposal)[trials.votes][:, whole_episodes(trials)]
    mean, error = paired(costs, np.zeros_like(costs))
    known = np.isfinite(mean) & np.isfinite(error)
    if not known.any():
        return np.nan, np.nan, np.nan
    order, out = np.sort(mean[known]), outvoted(int(known.sum()))
    kept, doubt = order[out : len(order) - out], SURE * float(np.median(error[known]))
    ends = [float(kept[0]) - doubt, float(kept[-1]) + doubt]
    middle, second = float(np.median(order)), trials.second[trials.names.index(proposal)][trials.votes]
    other = np.median(paired(second[:, whole_episodes(trials)], np.zeros_like(costs))[0][known])
    ends += [float(other) - doubt, float(other) + doubt] if np.isfinite(other) else []
    today = Today.of(trials, proposal)
    off = np.flatnonzero(np.isfinite(today.disagreement) & np.isfinite(today.disagreement_error))
    if len(off):
        k = off[np.argsort(today.disagreement[off], kind="stable")[len(off) // 2]]
        doubt += SURE * float(today.disagreement_error[k])
        ends += [middle - float(today.disagreement[k]) + sign * doubt for sign in (-1.0, 1.0)]
    return max(min(ends), trials.floor), middle, max(ends)


# ---------------------------------------------------------------- sentences


def _number(value: float) -> str:
    return figure(value, 4)


def _size(first: Difference, k: int) -> str:
    """How large the difference on model k is, with its doubt."""
    size, doubt = abs(first.mean[k]), SURE * first.error[k]
    surely = max(-first.high[k], first.low[k])
    if surely > 0.0 and not size > doubt:
        return f"{figure(size)} (surely {figure(surely, 2)}, the rest is a matter of few starts)"
    return f"{figure(size)} " + (f"+- {figure(doubt, 2)}" if np.isfinite(doubt) else "(from too few starts)")


def _called(name: str) -> str:
    """A candidate's name inside a sentence: with commas it would read as two."""
    return repr(name) if "," in name else name


def _gain(first: Difference, trials: Trials) -> str:
    """By how much the median model says that it is better; a size only where the models agree about it."""
    k, n = first.middle, len(first)
    levels = " -> ".join(_number(_level(trials, name, first, k)) for name in (trials.names[0], first.name))
    kept = np.sort(first.mean)[: n - outvoted(n)]  # but for the one that is dearest
    alike = kept[-1] < 0.0 and kept[0] / kept[-1] < _ALIKE
    size = "" if alike else f" The models do not agree about the size ({figure(kept[0])} to {figure(kept[-1])})."
    starts = int(starts_of(trials, first.name).sum())
    return (
        f"{_called(first.name)} costs {_size(first, k)} less than {trials.names[0]} an episode of"
        f" {trials.n_steps} steps ({levels}, median model, {starts} starts), beyond two standard"
        f" errors on {int(first.better.sum())} of {n} models that predict the log.{size}"
    )


def _no_gain(first: Difference, trials: Trials) -> str:
    k, name = first.middle, _called(first.name)
    mean, n = first.mean[k], int(starts_of(trials, first.name).sum())
    if np.isnan(mean):
        return f"{name} could not be simulated from any start: nothing is known of it."
    if first.low[k] > 0.0:
        return (
            f"{name} costs {_size(first, k)} more than {trials.names[0]} an episode of {trials.n_steps} steps"
            f" on the median model: dearer beyond two standard errors on {int(first.worse.sum())} of {len(first)}. Look"
            " at the candidates for another one, or record data where the learned MPC goes."
        )
    if mean == first.error[k] == 0.0:
        return (
            f"{name} costs as much as {trials.names[0]} from each of {n} starts on the median model: in"
            " simulations there is no gain, and what a trial would show is open."
        )
    text = (
        f"{name} costs {_size(first, k)} {'less' if mean < 0.0 else 'more'} than {trials.names[0]} an"
        f" episode of {trials.n_steps} steps on the median model: no clear gain."
    )
    if first.high[k] < 0.0:
        return f"{text} It is less than {_LEAST:.1%} of how much the starts differ: both are as good."
    needed = n * (SURE * first.error[k] / abs(mean)) ** 2 if mean < 0.0 else np.inf
    if needed < _MANY_STARTS:
        return f"{text} About {int(np.ceil(needed / 10.0)) * 10} starts would decide (n_starts=)."
    return text


def _nothing_better(trials: Trials) -> str:
    """Why the learner handed out MPC_1."""
    others = [name for name in trials.names[1:] if name != TODAY]
    tried = [Difference.of(trials, name, trials.names[0]) for name in others]
    if not tried:
        return f"{trials.names[0]} is the only candidate."
    if not trials.votes.any():  # in the choice; of other models some have one here
        return NO_MODEL_PREDICTS
    best = min(tried, key=lambda each: np.nan_to_num(each.mean[each.middle], nan=np.inf))
    k, n = best.middle, int(starts_of(trials, best.name).sum())
    gain = f"{_size(best, k)} {'less' if best.mean[k] < 0.0 else 'more'} an episode"
    if best.high[k] < 0.0:  # it left before the starts that judge, or another went there
        return (
            f"The choice kept {trials.names[0]}. Of {len(tried)} candidates, {_called(best.name)} costs {gain} on the"
            f" median model from {n} starts, on {int(best.better.sum())} of {len(best)} models clearly, but no other"
            f" starts have judged it: candidate={best.name!r} hands it out, for diagnose to do so."
        )
    return (
        f"Nothing that was learned is clearly better than {trials.names[0]}: the best of {len(tried)} candidates,"
        f" {_called(best.name)}, costs {gain} on the median model."
    )


def _objections(first: Difference, trials: Trials) -> tuple[str, ...]:
    """Models that do not agree, by name, and what to do where they are more than one."""
    objecting = np.flatnonzero(~first.better)
    if not len(objecting):
        return ()
    names = listed([f"{first.models[k]} ({figure(first.mean[k], sign=True)})" for k in objecting], 4)
    if first.agreed:
        return (f"One of {len(first)} models says otherwise, {names}: an outlier, named and not obeyed.",)
    by_cost = (first.high < 0.0) & ~first.better
    if by_cost.sum() > len(objecting) / 2:
        return (
            f"With the other regression of the logged cost the gain is not clear on {int(by_cost.sum())} of"
            f" {len(first)} models: what is gained may be an error of the cost that is simulated. Write the plant's"
            " stage cost as that of the MPC; it is used as it is where it agrees with the log.",
        )
    return (
        f"{len(objecting)} of {len(first)} models do not confirm it: {names}. More starts (n_starts=) where their"
        " differences are small; else record data where the learned MPC goes, by trials under supervision, and fit"
        " again.",
    )


def _of_today(today: Today, trials: Trials, name: str) -> tuple[str, ...]:
    """The comparison with the controller that made the log, and MPC_1's where that is worse than today's, too."""
    if not today.known:
        return (
            (f"What runs today cannot be compared: no logged episode is {trials.n_steps} steps long (n_steps=).",)
            if len(today.low)
            else ()
        )
    low, high = today.middle
    name = _called(name)
    logged = f"what runs today ({_number(today.logged)} in the log)" if np.isfinite(today.logged) else "what runs today"
    span = " to ".join(figure(end, sign=True) for end in (low, high))
    if today.better:
        return (f"{name} is better than {logged}: {span} an episode.",)
    worse, also = today.worse, ""
    if worse or today.dearer:
        also = " MPC_1 is, too." if name != trials.names[0] and Today.of(trials, trials.names[0]).dearer else ""
    if worse:
        return (
            f"{name} is worse than {logged}: {span} an episode, whether by the log or by a clone.{also} Keep"
            " what runs today.",
        )
    gap = float(np.nanmedian(today.disagreement)) if np.isfinite(today.disagreement).any() else 0.0
    if abs(gap) > 0.5 * (high - low):
        why = (
            f"on the models a clone of that controller costs {figure(abs(gap))} {'more' if gap > 0.0 else 'less'} than"
            " what was logged. A model that explains this would decide"
        )
    else:
        why = "the episodes differ too much from each other: more of them in the log, or a trial, would decide"
    rather = " It is rather worse." if today.dearer else ""
    return (f"{name} against {logged}: {span} an episode, which is not clear; {why}.{rather}{also}",)


def _failures(failed: float) -> tuple[str, ...]:
    if failed <= _FAILED:
        return ()
    return (
        f"{failed:.1%} of its problems were not solved at first in these simulations, where a plan at hand was"
        " applied. Smooth what has corners in the model, or rescue='ipopt'.",
    )


def _to_see(expected: tuple[float, float, float]) -> str:
    low, middle, high = expected
    return (
        f"The plant may still differ: begin with supervised trials. Expected is a mean of {_number(middle)} an episode,"
        f" {_number(low)} to {_number(high)} by what models and log say; more than that would contradict them."
    )


def costs_of(judgement: Judgement, trials: Trials) -> tuple[tuple[str, Array], ...]:
    """Today, MPC_1 and the proposal: lowest, middle and highest mean cost of an episode, ``(3,)`` each."""
    today = judgement.today
    logged = today.logged + SURE * today.logged_error * np.array([-1.0, 0.0, 1.0])
    rows = [("today", np.maximum(logged, trials.floor))]
    rows.append((trials.names[0], np.array(_expected(trials, trials.names[0]))))
    if judgement.proposal != trials.names[0]:
        rows.append((judgement.proposal, np.array(judgement.expected)))
    return tuple(rows)
