"""Logged episodes of outputs: filtered and smoothed side by side."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

from .observer import Estimate, OutputModel

_log = logging.getLogger(__name__)

_CHUNK = 200  # episodes smoothed at a time


class OutputPoint(NamedTuple):
    """What a filter needs to know, in units; or several, ``(m, 1, ...)``.

    Attributes:
        theta: All parameters of the MPC, ``(size,)``.
        noise: Standard deviation of each output's error, ``(n_outputs,)``.
        process: That of what the model misses of each state, ``(n_states,)``.
        start: Mean of the first states, ``(n_states,)``.
    """

    theta: Array
    noise: Array
    process: Array
    start: Array


class OutputEpisodes(NamedTuple):
    """Episodes side by side, padded to one length, time first.

    Attributes:
        y: Outputs, NaN behind the end, ``(T + 1, E, n_outputs)``.
        acting: What acts in each step, ``(T, E, nu + n_signals)``.
        lengths: Steps of each, ``(E,)``.
        rows: Its first row in the table, ``(E,)``.
    """

    y: Array
    acting: Array
    lengths: NDArray[np.intp]
    rows: NDArray[np.intp]

    def some(self, rows: int, longest: int, seed: int) -> OutputEpisodes:
        """Beginnings of random episodes, about this many rows, of so many steps at most where these suffice."""
        order = np.random.default_rng(seed).permutation(len(self.lengths))
        longest = max(longest, rows // len(order))
        lengths = np.minimum(self.lengths, longest)
        chosen = np.sort(order[: max(1, int(np.searchsorted(np.cumsum(lengths[order]), rows)) + 1)])
        T = int(lengths[chosen].max())
        y = self.y[: T + 1, chosen].copy()
        y[np.arange(T + 1)[:, None] > lengths[chosen]] = np.nan
        return OutputEpisodes(y, self.acting[:T, chosen], lengths[chosen], self.rows[chosen])


def output_episodes(mpc: MPC, log: TransitionTable, n_outputs: int, *, held: bool = False) -> OutputEpisodes:
    """The episodes of a log whose observations are outputs, then signals.

    Args:
        mpc: Has the dead time of each input.
        log: The log.
        n_outputs: How many there are.
        held: Whether inputs before an episode, which act in it where there is dead time, were its first ones: as after
            a gap. The usual ones by default: as after a standstill.

    Raises:
        InvalidArgumentError: For another number of columns.
        InvalidDataError: If an output never moves, or episodes are too short to see a state in them.
    """
    layout, columns = mpc.layout, log.values()
    expected = n_outputs + layout.ny - layout.n_states
    if log.ny != expected or log.nu != layout.nu:
        raise InvalidArgumentError(
            "log",
            expected=f"{n_outputs} outputs, {expected - n_outputs} columns of signals and {layout.nu} inputs",
            actual=f"{log.ny} observations and {log.nu} actions",
        )
    _, firsts, lengths = log.episodes
    order = np.argsort(firsts)
    firsts, lengths = firsts[order], lengths[order]
    least = -(-layout.n_states // n_outputs)
    if int(lengths.max()) < least:
        raise InvalidDataError(
            "log",
            expected=f"episodes of {least} steps at least, to see {layout.n_states} states in",
            actual=str(lengths),
        )
    still = np.flatnonzero(np.ptp(columns.observations[:, :n_outputs], axis=0) == 0.0)
    if len(still):
        raise InvalidDataError(
            "log", expected="outputs that move", actual=f"output {still[0]} is one number throughout"
        )
    T, E = int(lengths.max()), len(lengths)
    y, acting = np.full((T + 1, E, n_outputs), np.nan), np.zeros((T, E, len(layout.acting)))
    usual = mpc.usual_input
    for e, (first, length) in enumerate(zip(firsts, lengths, strict=True)):
        rows = slice(first, first + length)
        y[:length, e] = columns.observations[rows, :n_outputs]
        y[length, e] = columns.next_observations[first + length - 1, :n_outputs]
        for i, delay in enumerate(layout.delay):
            before = columns.actions[first, i] if held else usual[i]
            late = np.concatenate([np.full(delay, before), columns.actions[rows, i]])[:length]
            acting[:length, e, i] = late
        present = layout.present - layout.n_states + n_outputs
        acting[:length, e, layout.nu :] = columns.observations[rows][:, present]
    return OutputEpisodes(y, acting, np.asarray(lengths, dtype=np.intp), np.asarray(firsts, dtype=np.intp))


class Filtered(NamedTuple):
    """A step of the filter over all stretches, a row for each: with m points, all stretches of each in turn.

    Attributes:
        known: With the outputs of the step.
        e: Innovations, ``(rows, n_outputs)``, 0 of outputs that are not there.
        S: Their variances, 1 of these.
        predicted: Before the outputs of the next step; in the last one what is known.
        F: The slopes of that, ``(rows, n, n)``; in the last one those of the step before.
    """

    known: Estimate
    e: Array
    S: Array
    predicted: Estimate
    F: Array

    @property
    def evidence(self) -> Array:
        """Minus the log likelihood, ``(rows,)``, but for a constant."""
        return np.asarray(0.5 * (self.e**2 / self.S + np.log(self.S)).sum(axis=1))


def filtered_outputs(model: OutputModel, data: OutputEpisodes, found: OutputPoint, spread: Array) -> Iterator[Filtered]:
    """The filter over all stretches, step by step; points ``(m, 1, size)`` in place of one go side by side."""
    T, E = data.acting.shape[:2]
    lead = found.theta.shape[:-2]
    m = int(np.prod(lead)) if lead else 1

    def every(values: Array) -> Array:
        """One row for each stretch of each point."""
        rows = values.reshape(m, 1, -1) if lead else values.reshape(1, 1, -1)
        return np.broadcast_to(rows, (m, E, rows.shape[-1])).reshape(m * E, -1)

    def diagonal(values: Array) -> Array:
        return every(values)[:, :, None] ** 2 * np.eye(values.shape[-1])

    theta, Q, variances = every(found.theta), diagonal(found.process), every(found.noise) ** 2
    known = Estimate(every(found.start).copy(), np.tile(np.diag(spread**2), (m * E, 1, 1)))
    acting, F = None, Q  # nobody knows what acted before an episode
    for k in range(T + 1):
        here, e, S = model.corrected_in_turn(known, np.tile(data.y[k], (m, 1)), variances, acting)
        known = here
        if k < T:
            acting = np.tile(data.acting[k], (m, 1))
            known, F = model.ahead(here, acting, theta, Q)
        yield Filtered(here, e, S, known, F)


def smoothed_states(
    model: OutputModel, data: OutputEpisodes, found: OutputPoint, spread: Array
) -> tuple[list[Array], Array]:
    """States of each episode, ``(length + 1, n_states)`` each, and the share of each variance that outputs remove.

    That is, in the later half of an episode, of the variance that there would be without them.
    """
    states: list[Array] = []
    left, without, Q = np.zeros(len(spread)), np.zeros(len(spread)), np.diag(found.process**2)
    for part in _parts(data):
        steps = list(filtered_outputs(model, part, found, spread))
        blind = np.tile(np.diag(spread**2), (len(part.lengths), 1, 1))
        for k, step in enumerate(steps):
            late = (k <= part.lengths) & (2 * k >= part.lengths)
            left += np.einsum("bii->bi", step.known.P)[late].sum(axis=0)
            without += np.einsum("bii->bi", blind)[late].sum(axis=0)
            blind = step.F @ blind @ step.F.swapaxes(1, 2) + Q
        x = [step.known.x for step in steps]
        for k in range(len(part.acting) - 1, -1, -1):
            known, _, _, predicted, F = steps[k]
            gain = np.linalg.solve(predicted.P + _ridge(predicted.P), F @ known.P).swapaxes(1, 2)
            going = (k < part.lengths)[:, None]
            x[k] = x[k] + np.where(going, (gain @ (x[k + 1] - predicted.x)[:, :, None])[:, :, 0], 0.0)
        whole = np.stack(x)
        states += [whole[: length + 1, i] for i, length in enumerate(part.lengths)]
    share = np.divide(left, without, out=np.zeros_like(left), where=without > 0.0)
    return states, 1.0 - np.clip(np.nan_to_num(share), 0.0, 1.0)


def missed_ahead(model: OutputModel, data: OutputEpisodes, found: OutputPoint, spread: Array, steps: int) -> Array:
    """How far outputs are from what the model says of them some steps before, in what they move in these steps.

    Predicted is from the filter's estimates, every so many steps, with the inputs that followed: ``(n_outputs,)``, the
    roots of mean squares; about 1 for a model that knows no more than that they stay, NaN where nothing is that long.
    """
    n = data.y.shape[2]
    missed, moved, count = np.zeros(n), np.zeros(n), np.zeros(n)
    for part in _parts(data):
        history = [step.known for step in filtered_outputs(model, part, found, spread)]
        for first in range(0, len(part.acting) - steps + 1, steps):
            known = history[first]
            for k in range(first, first + steps):
                known = model.ahead(known, part.acting[k], found.theta, np.zeros_like(known.P[0]))[0]
            last = part.y[first + steps]
            off, change = last - model.seen(known.x, part.acting[first + steps - 1]), last - part.y[first]
            both = np.isfinite(off) & np.isfinite(change)
            missed += np.where(both, off**2, 0.0).sum(axis=0)
            moved += np.where(both, change**2, 0.0).sum(axis=0)
            count += both.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(count > 0, np.sqrt(missed / moved), np.nan))


def _ridge(P: Array) -> Array:
    """What keeps a covariance of an exact model regular."""
    return np.asarray(1e-12 * np.einsum("bii->b", P)[:, None, None] * np.eye(P.shape[-1]))


def _parts(data: OutputEpisodes) -> Iterator[OutputEpisodes]:
    """Some episodes at a time, in their order."""
    for begin in range(0, len(data.lengths), _CHUNK):
        some = slice(begin, begin + _CHUNK)
        T = int(data.lengths[some].max())
        yield OutputEpisodes(data.y[: T + 1, some], data.acting[:T, some], data.lengths[some], data.rows[some])


def with_states(log: TransitionTable, states: list[Array], data: OutputEpisodes, n_outputs: int) -> TransitionTable:
    """The log with states in place of outputs; without episodes that the model cannot follow, as they run away in it.

    Raises:
        InvalidDataError: If it can follow none.
    """
    columns, n = log.values(), states[0].shape[1]
    s, after = np.empty((len(log), n)), np.empty((len(log), n))
    for first, length, x in zip(data.rows, data.lengths, states, strict=True):
        s[first : first + length], after[first : first + length] = x[:-1], x[1:]
    signals, later = (part[:, n_outputs:] for part in (columns.observations, columns.next_observations))
    lost = [not np.isfinite(x).all() for x in states]
    if all(lost):
        hint = "Is its structure right, and does start_spread say where episodes begin?"
        raise InvalidDataError("log", expected="an episode that the model can follow", actual="none", hint=hint)
    if any(lost):
        _log.warning("%d of %d episodes are left out: in the model they run away", sum(lost), len(lost))
    followed = np.repeat(~np.array(lost), data.lengths)
    kept = np.concatenate([np.arange(first, first + n) for first, n in zip(data.rows, data.lengths, strict=True)])
    kept = np.sort(kept[followed])
    return TransitionTable.from_arrays(
        np.hstack([s, signals])[kept],
        columns.actions[kept],
        columns.costs[kept],
        np.hstack([after, later])[kept],
        columns.terminations[kept],
        log.episode_ids[kept],
        name=log.name,
    )
