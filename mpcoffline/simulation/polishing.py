"""Weights of a finished MPC moved by what its closed loops cost on models of the log: direct policy search."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

from .episodes import Episodes
from .quick import quick_policy
from .trials import Surroundings

_EVALUATIONS, _TOGETHER = 80, 8
_STARTS = 24  # of the surroundings that tune; the others judge
_SPREAD = 0.5  # of the first logarithms: factors of 1.6
_MOST = 0.2  # of how much costs differ from start to start: who promises more has found an error of the models
_SURE = 2.0  # standard errors

#: Gains of the weights tried so far, by the name of a search; what is put in may be written to a file.
Kept = MutableMapping[str, Array]


@dataclass(frozen=True)
class Polished:
    """What the search has found.

    Attributes:
        mpc: The MPC with the best weights.
        taken: Whether it is better beyond doubt where it was not tuned.
        gain: Mean cost of an episode less than before, on the median of the judging models.
        error: Its standard error.
        evaluations: How many sets of weights were tried.
        reason: Why it is taken, or why it is not, in a sentence.
    """

    mpc: MPC
    taken: bool
    gain: float
    error: float
    evaluations: int
    reason: str


def polished(
    mpc: MPC,
    around: Surroundings,
    seed: int = 0,
    tell: Callable[[int, int, str], None] = lambda *what: None,
    kept: Kept | None = None,
) -> Polished:
    """Moves stage and terminal weights so that closed loops on models of the log cost less.

    By CMA-ES (Hansen, arXiv:1604.00772; package ``cma``) over logarithms of factors: one for each row of the factor of
    each weight matrix, and one for each positive number of another cost. Model, references and networks stay. This
    solves MPCs, some hundred thousand, which the regressions of a fit never do.

    It is tuned on every other model and some starts, and taken if on each of the other models (on the same one from
    other starts, where one alone has a vote) it is better from the other starts beyond two standard errors, by both
    regressions of the cost. Gains above a fifth of how much costs differ from start to start are refused: the models'
    own errors are exploited most easily.

    Args:
        mpc: Where it begins.
        around: The models, their starts and all else that happens.
        seed: Of the search.
        tell: Is told how many of how many weights are tried, and what is done.
        kept: What an interrupted search has found: it goes on from there, and ends as if nothing had happened.

    Raises:
        InvalidArgumentError: If the package ``cma`` is not installed.
    """
    check_search()
    groups = scaled_together(mpc)
    votes = np.flatnonzero(around.models.votes)
    if not groups or not len(votes):
        return Polished(mpc, False, 0.0, np.inf, 0, "not polished: no weights to move, or no model to do it on")
    tuning, judging = around.on(votes[::2]), around.on(votes[1::2] if len(votes) > 1 else votes)
    some = slice(0, min(_STARTS, len(around.rows) // 2))
    base = tuning.act([tuning.seeing(quick_policy(mpc))], some)[0].cost.mean(axis=1)
    search = _search(max(2, len(groups)), seed)
    kept, name = {} if kept is None else kept, _name(mpc, around, seed)
    known = [gains for gains in kept.get(name, np.empty((0, _TOGETHER))) if gains.shape == (_TOGETHER,)]
    best, best_gain, count = mpc, 0.0, 0
    while count < _EVALUATIONS and not search.stop():
        drawn = search.ask()
        mpcs, batch = [_moved(mpc, groups, z) for z in drawn], count // _TOGETHER
        if batch == len(known):
            done = tuning.act([tuning.seeing(quick_policy(each)) for each in mpcs], some)
            known.append(np.array([_gain(base - each.cost.mean(axis=1)) for each in done]))
            kept[name] = np.stack(known)
        gains = known[batch]
        search.tell(drawn, (-gains).tolist())
        k, count = int(np.argmax(gains)), count + len(drawn)
        if gains[k] > best_gain:
            best, best_gain = mpcs[k], float(gains[k])
        tell(min(count, _EVALUATIONS), _EVALUATIONS, "weights")
    if best is mpc:
        return Polished(mpc, False, 0.0, np.inf, count, "not polished: no other weights cost less")
    tried = [judging.seeing(quick_policy(each)) for each in (mpc, best)]
    before, after = judging.act(tried, slice(some.stop, len(around.rows)))
    return _judged(best, before, after, count)


def scaled_together(mpc: MPC) -> list[NDArray[np.intp]]:
    """Coordinates of theta that one factor scales: a row of a weight's factor each, or a positive number of a cost."""
    groups: list[NDArray[np.intp]] = []
    first = 0
    for block in mpc.space.blocks:
        places = np.arange(first, first + block.theta.size)
        first += block.theta.size
        if block.group != "cost" or not block.theta.size:
            continue
        if block.kind == "psd":
            rows = np.repeat(np.arange(block.shape[0]), np.arange(1, block.shape[0] + 1))
            groups += [places[rows == i] for i in range(block.shape[0]) if np.any(block.theta[rows == i])]
        elif block.shape == () and block.low[0] >= 0.0 and block.theta[0] > 0.0:
            groups.append(places)
    return groups


def _moved(mpc: MPC, groups: list[NDArray[np.intp]], z: Array) -> MPC:
    theta = mpc.theta.copy()
    for places, logarithm in zip(groups, z, strict=False):  # of one weight alone the search has two numbers
        theta[places] *= np.exp(logarithm)
    return mpc.with_theta(np.clip(theta, mpc.space.low, mpc.space.high))


def check_search() -> None:
    """Refuses a search that cannot be made here.

    Raises:
        InvalidArgumentError: If the package ``cma`` is not installed.
    """
    if importlib.util.find_spec("cma") is None:
        hint = 'pip install "mpcoffline[polish]"'
        raise InvalidArgumentError("polish", expected="the package cma", actual="none installed", hint=hint)


def _search(size: int, seed: int) -> Any:
    import cma

    options = {"seed": seed + 1, "popsize": _TOGETHER, "verbose": -9, "maxfevals": _EVALUATIONS}
    return cma.CMAEvolutionStrategy(size * [0.0], _SPREAD, options)


def _name(mpc: MPC, around: Surroundings, seed: int) -> str:
    """What decides a search, as a short text."""
    described = mpc.to_json(), around.models.names, around.rows.tolist(), around.n_steps, seed
    return f"polish-{hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:16]}"


def _gain(gains: Array) -> float:
    """Of the models the median, the smaller one of two; nothing where one is not finite."""
    return float(np.sort(gains)[(len(gains) - 1) // 2]) if np.isfinite(gains).all() else -1e300


def _judged(mpc: MPC, before: Episodes, after: Episodes, count: int) -> Polished:
    """By the starts and models that had no part in it."""
    both = [(a - b, b) for a, b in ((before.cost, after.cost), (before.second, after.second))]
    clear, enough = [], np.sqrt(before.cost.shape[1])
    for gains, _ in both:
        mean, error = gains.mean(axis=1), gains.std(axis=1, ddof=1) / enough
        clear.append(bool((mean > _SURE * error).all()))
    gains = both[0][0]
    k = int(np.argsort(gains.mean(axis=1), kind="stable")[(len(gains) - 1) // 2])
    gain, error = float(gains[k].mean()), float(gains[k].std(ddof=1) / enough)
    result = Polished(mpc, False, gain, error, count, "")
    more = "less" if gain > 0.0 else "more"
    figures = f"{abs(gain):.3g} +- {_SURE * error:.2g} {more} an episode on the models that judge"
    if gain > _MOST * float(before.cost[k].std()):
        return replace(result, reason=f"not polished: other weights promise {figures}, too much to be true")
    if not all(clear):
        return replace(result, reason=f"not polished: other weights cost {figures}, which is no clear gain")
    return replace(result, taken=True, reason=f"polished: its weights cost {figures}")
