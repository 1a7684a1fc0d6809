"""Contradictions that single columns of a log show: rows out of step, columns that do not move, costs, ranges."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

from .findings import Excerpt, Finding, nominal_costs, predicted
from .units import CONVERSIONS, FACTORS, in_words

_FEW = 20  # rows below which nothing but the sizes is compared
_LAGS = 20
_SEEN = 4.5  # t of an effect that is there, of some hundreds that are looked at
_A_THIRD = 14.0  # t that the model's effect would have, where a third of it would be seen
_NO_TESTS = 1e-3  # share of an input's spread that does not follow from the state
_SURE = 10.0  # standard errors
_UNITS = 30.0  # times: more than any parameter is off
_FAR = 3.0  # ranges of the data


def alignment(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """Whether s+ is of the row after, not of the same one, the one before or the one after next."""
    if len(log) < _FEW:
        return
    size = 1e-6 * np.ptp(log.x, axis=0)

    def same(a: Array, b: Array) -> NDArray[np.bool_]:
        return np.asarray((np.abs(a - b) <= size).all(axis=1))

    x, reached, pairs = log.x, log.reached, log.adjacent
    moves = pairs & ~same(x[:-1], x[1:])
    if moves.sum() < _FEW // 2:
        return
    hint = "Build s+ as observations[1:] and s as observations[:-1] of each episode."
    if same(x, reached).all():
        actual = f"the same row's observations in all of {len(x)} rows looked at"
        yield Finding("next_observations", "the observations one step later", actual, hint, "error", misread=True)
        return
    forward = same(reached[:-1], x[1:])[moves].mean()
    backward = same(reached[1:], x[:-1])[moves].mean()
    two = moves[:-1] & moves[1:]
    skipping = same(reached[:-2], x[2:])[two].mean() if two.any() else 0.0
    for share, words in ((backward, "one step earlier"), (skipping, "two steps later")):
        if share > 0.9 and forward < 0.1:
            actual = f"those of {words} in {share:.0%} of the rows looked at"
            yield Finding("next_observations", "the observations one step later", actual, hint, "error", misread=True)


def episodes(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """Whether rows follow each other."""
    if len(log) >= _FEW and log.adjacent.any() and not log.together.any():
        yield Finding(
            "episodes",
            "rows that follow each other",
            "episodes of one step throughout: no row's s+ is the next row's s",
            "Keep rows in time order and pass episode_ids, if they were logged so: noise and delays can only be told"
            " from neighbours.",
        )


def costs(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """Whether costs vary."""
    if np.ptp(log.cost) == 0.0:
        statistics = log.table.statistics()
        if statistics.low.costs == statistics.high.costs:
            actual = f"all costs are {log.cost[0]:g}, so they do not tell what is good"
            yield Finding("costs", "costs that differ", actual, "Is it the right column?")


def rewards(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """Whether costs rise where the MPC's do."""
    own = nominal_costs(mpc, log.z, log.a)
    use = np.isfinite(own) & ~log.ended
    if use.sum() < 2 * _FEW or np.ptp(own[use]) == 0.0 or np.ptp(log.cost[use]) == 0.0:
        return
    r = float(scipy.stats.spearmanr(own[use], log.cost[use]).statistic)
    if r < -0.5:
        yield Finding(
            "costs",
            "costs that are high where the MPC's stage cost is",
            f"costs that are low there (rank correlation {r:.2f})",
            "Is it a reward? Everything here minimises: pass minus the reward.",
        )


def states(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """Whether what the model moves is seen to move."""
    still = np.flatnonzero(np.ptp(np.concatenate([log.x, log.reached]), axis=0) == 0.0)
    if len(log) < _FEW or not len(still):
        return
    low, high = (each.observations for each in (log.table.statistics().low, log.table.statistics().high))
    change = np.median(np.abs(predicted(mpc, log.x, log.u) - log.x), axis=0)
    for i in still.tolist():
        value = log.x[0, i]
        if low[i] == high[i] and change[i] > 1e-9 * abs(value):
            actual = f"{value:g} in all rows, while the model moves it by {change[i]:.3g} a step"
            hint = "Is it the right column, and its sensor connected?"
            yield Finding(f"observation {i}", "a state that moves", actual, hint)


def rows(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """Whether there are as many numbers as parameters."""
    n, n_parameters = len(log.table), int(mpc.space.mask(("cost", "model")).sum())
    if n * (mpc.layout.n_states + 1) < 3 * n_parameters:
        expected = f"at least {-(-3 * n_parameters // (mpc.layout.n_states + 1))} rows for {n_parameters} parameters"
        hint = "Record more, or give fewer parameters (what is a plain number in the model is not learned)."
        yield Finding("rows", expected, str(n), hint)


def ranges(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """References and bounds of states that data of another unit would meet."""
    if len(log) < _FEW:
        return
    low, high = log.x.min(axis=0), log.x.max(axis=0)
    reference = mpc.reference
    if reference is not None:
        matters = _matters(mpc, log)
        matters[list(getattr(mpc.stage_cost, "tracks", {}))] = False  # there it is the distance from a signal
        for i in np.flatnonzero(matters & (low < high)).tolist():
            yield from _apart(f"observation {i}", "the reference", reference[i], reference[i], low[i], high[i])
    for bounds in mpc.state_bounds:
        bottom, top = (np.asarray(each)[: len(low)] for each in (bounds.low, bounds.high))
        for i in np.flatnonzero(np.isfinite(bottom) & np.isfinite(top) & (low < high)).tolist():
            yield from _apart(f"observation {i}", f"bounds {bounds.name!r}", bottom[i], top[i], low[i], high[i])


def _apart(name: str, what: str, bottom: float, top: float, low: float, high: float) -> Iterator[Finding]:
    """A finding where the data are far from [bottom, top], and in another unit would not be."""
    spread = high - low

    def meets(a: float, b: float, margin: float) -> bool:
        return low - margin * spread <= b and a <= high + margin * spread

    if meets(bottom, top, _FAR):
        return
    others = [(factor, 0.0) for factor in FACTORS if top != 0.0] + list(CONVERSIONS)
    for factor, offset in others:
        if meets((bottom - offset) / factor, (top - offset) / factor, 0.1):
            words = in_words(factor, offset)
            at = f"{top:g}" if bottom == top else f"{bottom:g} to {top:g}"
            actual = f"data from {low:.4g} to {high:.4g}, which would meet it if they were {words}"
            hint = "Are data and MPC in the same unit?"
            yield Finding(name, f"data near {what}, {at}", actual, hint, misread=True)
            return


def _matters(mpc: MPC, log: Excerpt) -> NDArray[np.bool_]:
    """Which states the nominal stage cost looks at, ``(n,)``."""
    z, a = log.z[:_FEW], log.a[:_FEW]
    base = nominal_costs(mpc, z, a)
    spread = np.ptp(log.x, axis=0)
    moved = (z + size * (np.arange(z.shape[1]) == i) for i, size in enumerate(spread))
    return np.array([bool((nominal_costs(mpc, each, a) != base).any()) for each in moved])


def inputs(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """Whether inputs vary, and do something, now or some steps later."""
    if len(log) < _FEW:
        return
    constant = np.ptp(log.u, axis=0) == 0.0
    for j in range(mpc.nu):
        name = f"action {j}"
        if constant[j]:
            statistics = log.table.statistics()
            if statistics.low.actions[j] == statistics.high.actions[j]:
                actual = f"{log.u[0, j]:g} in all rows: the log does not tell what it does"
                yield Finding(name, "an input that varies", actual, "Record steps of it, or leave it out of the model.")
        elif len(log) >= 5 * _FEW:
            yield from _nothing(mpc, log, j, name)


def gains(mpc: MPC, log: Excerpt) -> Iterator[Finding]:
    """Whether an input does as much as the model says, but for what parameters may be off."""
    if len(log) < 5 * _FEW:
        return
    for j in range(mpc.nu):
        effect = _Effect.of(mpc, log, j)
        i = int(np.argmax(effect.surely))
        if effect.surely[i] == 0.0 or abs(effect.seen[i]) < _SURE * effect.error[i]:
            continue
        ratio = effect.seen[i] / effect.claimed[i]
        if abs(ratio) > _UNITS:
            actual = f"one that does {ratio:.3g} times as much to observation {i}"
            hint = "Are data and model in the same unit?"
            yield Finding(f"action {j}", "an input that does about what the model says", actual, hint, misread=True)


class _Effect(NamedTuple):
    """What an input does to each state in a step, beside what follows from the states and the other inputs.

    Attributes:
        own: What of the input does not follow from these, ``(m,)``.
        share: That as a share of its spread.
        motion: What of the states' motion does not, ``(m, nx)``.
        claimed: The model's effect, ``(nx,)``; 0 where it is not finite.
        seen: The log's, ``(nx,)``.
        error: Its standard error, ``(nx,)``.
    """

    own: Array
    share: float
    motion: Array
    claimed: Array
    seen: Array
    error: Array

    @classmethod
    def of(cls, mpc: MPC, log: Excerpt, j: int) -> _Effect:
        """The effect of input j."""
        z = np.column_stack([log.x, np.delete(log.u, j, axis=1)])
        spread = z.std(axis=0)
        z = (z - z.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
        basis = np.column_stack([np.ones(len(z)), z, z**2])
        first, second = np.triu_indices(z.shape[1], 1)
        if len(z) > 10 * (basis.shape[1] + len(first)):
            basis = np.column_stack([basis, z[:, first] * z[:, second]])
        left = np.column_stack([log.u[:, j], log.reached - log.x])
        left = left - basis @ np.linalg.lstsq(basis, left, rcond=None)[0]
        own, motion = left[:, 0], left[:, 1:]
        held = log.u.copy()
        held[:, j] = log.u[:, j].mean()
        claimed = predicted(mpc, log.x, log.u) - predicted(mpc, log.x, held)
        claimed = np.where(np.isfinite(claimed).all(axis=0), claimed, 0.0)
        power = float(own @ own) or 1.0
        error = motion.std(axis=0) / np.sqrt(power)
        return cls(own, own.std() / log.u[:, j].std(), motion, own @ claimed / power, own @ motion / power, error)

    @property
    def surely(self) -> Array:
        """How many standard errors the model's effect would be away from none, ``(nx,)``."""
        return np.asarray(np.abs(self.claimed) / np.where(self.error > 0.0, self.error, np.inf))


def _nothing(mpc: MPC, log: Excerpt, j: int, name: str) -> Iterator[Finding]:
    """A finding where an input has no effect, although a third of what the model says would be seen."""
    effect = _Effect.of(mpc, log, j)
    if effect.share < _NO_TESTS:
        actual = f"one that follows from the state but for {effect.share:.0e} of its spread"
        hint = "Add test signals to it while recording: what it does cannot be told from what the state does."
        yield Finding(name, "an input with test signals", actual, hint)
        return
    if effect.surely.max() < _A_THIRD:
        return
    own, motion = effect.own, effect.motion
    run = np.concatenate([[0], np.cumsum(~log.together)])
    for lag in range(min(_LAGS, len(own) - 5)):
        later = run[lag:] == run[: len(run) - lag]  # of one episode
        a, b = own[: len(own) - lag][later], motion[lag:][later]
        if len(a) < _FEW:
            break
        r = (a @ b) / np.sqrt((a @ a) * (b * b).sum(axis=0) + np.finfo(float).tiny)
        if np.max(np.abs(r) * np.sqrt(len(a))) > _SEEN:
            return
    seen = f"what the model says would be seen at {effect.surely.max():.0f} times its standard error"
    actual = f"no effect on any state in the next {_LAGS} steps ({seen})"
    hint = "Is it the column of what was applied to the plant?"
    yield Finding(name, "an input that does something", actual, hint, misread=True)
