"""Which of some controllers is best on the models of a log: what is clearly worse leaves early."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping

import numpy as np
import torch

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.mpc import MPC
from mpcoffline.solvers import SOLVERS, CompilerError

from .trials import Surroundings, Trials

FIRST = "MPC_1"
_SLOW = 10.0  # times as fast as ipopt
_ROUNDS = (1 / 8, 1 / 3, 5 / 8)  # of the usual starts until the end of each; what is left judges
_CLEAR = 2.0  # standard errors
_TRIFLE = 0.01  # of the gain over MPC_1: what is better by less is no better
_TOGETHER = 4  # MPCs whose closed loops are stepped together: much faster, and something is told in between
_JUDGED = 3  # of the best at most, one after the other
_VARIED = (3, 1)  # of so many of the best, variants are tried after each of the first rounds


def choose(
    mpcs: dict[str, MPC],
    around: Surroundings,
    variants: Callable[[Mapping[str, MPC], int], Mapping[str, MPC]] = lambda mpcs, turn: {},
    tell: Callable[[int, int, str], None] = lambda *what: None,
    preferred: str = "",
) -> tuple[Trials, str]:
    """Tries MPCs on the models of the log and names the best.

    In rounds, each with more starts: after each, those leave that cost clearly more than the best. Where the last one
    leaves several that are not alike, all usual starts choose and the spare ones judge. The best has the least mean
    cost on the median model, of those that have a vote. It is taken if it costs no more than ``"MPC_1"`` by
    both regressions of the cost, and the starts that are left do not say otherwise (:meth:`Trials.improves`), else the
    next best is asked; where no model has a vote, ``"MPC_1"`` stays.

    Args:
        mpcs: By name, the first one ``"MPC_1"``; variants that were tried join them.
        around: Where they are tried; at most two thirds of its starts are used to choose.
        variants: What is tried, too, of the three best after the first round (turn 0), of the best after the next (1).
        tell: Is told how many starts of how many are done, and what is tried.
        preferred: Which one is taken where it is as good as the best, but for a hundredth of the gain.

    Returns:
        The trials, and the name of the best.
    """
    usual = around.usual
    ends = sorted({max(1, round(usual * share)) for share in _ROUNDS})
    trials = Trials.none(list(mpcs), around)
    if not trials.votes.any():
        return trials.judged_from(0), FIRST
    policies, left, begin = {name: quick_policy(mpc) for name, mpc in mpcs.items()}, list(mpcs), 0

    def act(names: list[str], starts: slice) -> None:
        for some in (names[i : i + _TOGETHER] for i in range(0, len(names), _TOGETHER)):
            tell(starts.start, usual, ", ".join(some))
            trials.fill({name: policies[name] for name in some}, around, starts)

    for turn, end in enumerate(ends):
        act(left, slice(begin, end))
        if turn < len(_VARIED):  # what is better may be better still
            good = _still_good(trials, left, end, preferred)[: _VARIED[turn]]
            more = variants({name: mpcs[name] for name in good}, turn)
            mpcs.update(more)
            policies.update({name: quick_policy(mpc) for name, mpc in more.items()})
            trials, left = trials.with_names(list(more)), [*left, *more]
            act(list(more), slice(0, end))
        left, begin = [FIRST, *_still_good(trials, left, end, preferred)], end
        if left == [FIRST]:
            tell(usual, usual, "")
            return trials.judged_from(begin), FIRST
    total = usual
    if len(left) > 2 and len(around.rows) > usual:
        act(left, slice(begin, usual))
        left, begin, total = [FIRST, *_still_good(trials, left, usual, preferred)], usual, len(around.rows)
    act([FIRST], slice(begin, total))
    chosen = FIRST
    for name in left[1 : 1 + _JUDGED]:
        act([name], slice(begin, total))
        if trials.judged_from(begin).improves(name):
            chosen = name
            break
    tell(usual, usual, "")
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
    (done,) = around.act([quick_policy(mpc)], slice(0, around.usual))
    cost = np.median(done.cost[around.models.votes], axis=0)
    dearest = np.argsort(-np.where(np.isnan(cost), np.inf, cost), kind="stable")
    digits = max(1, (len(cost) - 1).bit_length())
    reversed_digits = [int(f"{i:0{digits}b}"[::-1], 2) for i in range(len(cost))]
    order = dearest[np.argsort(reversed_digits)]
    return around.reordered(np.append(order, np.arange(around.usual, len(around.rows))))


def are_slow(policies: Iterable[MPCPolicy]) -> bool:
    """Whether one of them has a slow solver, as ipopt."""
    return min(policy.solver.relative_speed for policy in policies) < _SLOW


def quick_policy(mpc: MPC) -> MPCPolicy:
    """A policy whose solver is fast in batches with active bounds, too: ``"ddp"`` where it takes the problem.

    It takes as many threads as torch does, which change no digit.
    """
    if "ddp" in SOLVERS and not SOLVERS["ddp"].refuses(mpc):
        policy = MPCPolicy(mpc, "ddp", n_threads=torch.get_num_threads())
        with contextlib.suppress(CompilerError):
            _ = policy.solver
            return policy
    return MPCPolicy(mpc)


def _still_good(trials: Trials, names: list[str], end: int, preferred: str) -> list[str]:
    """Those, but MPC_1, that are not clearly worse than the best; the best first, or the preferred one if as good.

    Of those that are alike, the first.
    """
    differences = {name: trials.differences(name)[trials.votes][:, :end] for name in names}
    score = {name: float(np.median(each.mean(axis=1))) for name, each in differences.items()}
    best = min(names, key=lambda name: score[name])
    trifle = _TRIFLE * abs(score[best])

    def near(name: str) -> bool:
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
