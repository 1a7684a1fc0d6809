"""Logged episodes as trajectories: stretches of consecutive rows, for what looks at more than one transition."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC
from mpcoffline.mpc.scaling import increments_scale, spread_of

from .identification import ABSURD
from .kalman import Linearised
from .one_step import OneStep
from .rows import Rows

_LENGTHS = (200, 100, 50, 25, 12)  # steps that a trajectory may have; longer ones are cut and filtered side by side
_CUT = 1e-3  # share of the pairs of measurements of one state that may be taken for a gap
_FULL_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Trajectories:
    """A table cut into stretches of consecutive rows, padded to one length, so that all are filtered side by side.

    Attributes:
        model: The one-step prediction.
        scale: Unit of each coordinate in the filter: its spread, 1 where it does not vary, ``(nx,)``.
        spread: Standard deviation of each coordinate in the table, ``(nx,)``.
        repeated: Whether s+ of a row and s of the next are two measurements, not one number.
        index: Row of the table of each transition, ``(E, T)``; its last row again where a stretch has ended.
        valid: Where that is no padding, ``(E, T)``.
        s: First measurement of each state, ``(E, T, nx)``, without jumps in angles.
        inputs: ``(E, T, nu)``.
        reached: Second measurement of the state after it, ``(E, T, nx)``.
        turns: What was added to s and to s+ to take the jumps out, ``(E, T, 2, nx)``.
    """

    model: OneStep
    scale: Array
    spread: Array
    repeated: bool
    index: NDArray[np.intp]
    valid: NDArray[np.bool_]
    s: Array
    inputs: Array
    reached: Array
    turns: Array

    @classmethod
    def of(cls, mpc: MPC, table: TransitionTable, unwrapped: tuple[int, ...]) -> Trajectories:
        """Cuts a table of what the plant's map is given into trajectories."""
        nx = table.ny
        columns = table.values()
        s, reached, spread = columns.observations, columns.next_observations, columns.observations.std(axis=0)
        unit = spread_of(s)
        difference = _wrapped(reached[:-1] - s[1:], unwrapped)
        within = (table.episode_ids[1:] == table.episode_ids[:-1]) & (columns.terminations[:-1] == 0.0)
        typical = np.median(np.abs(difference[within]), axis=0) if within.any() else np.zeros(nx)
        size = 1.4826 * typical + 1e-5 * unit
        goes_on = within & (np.sum((difference / size) ** 2, axis=1) <= scipy.stats.chi2(nx).isf(_CUT))
        index, valid = _stretches(goes_on)
        repeated = bool((typical > 1e-6 * spread).any())
        s, reached = s[index], reached[index]
        turns = np.zeros((*index.shape, 2, nx))
        for i in unwrapped:
            turns[:, :, 0, i] = np.unwrap(s[:, :, i], axis=1) - s[:, :, i]
            turns[:, :, 1, i] = -_FULL_TURN * np.round((reached - s - turns[:, :, 0])[:, :, i] / _FULL_TURN)
        s, reached = s + turns[:, :, 0], reached + turns[:, :, 1]
        model, scale = OneStep(mpc, mpc.space.mask(("model",))), unit
        return cls(model, scale, spread, repeated, index, valid, s, columns.actions[index], reached, turns)

    def thinned(self, rows: int, seed: int) -> Trajectories:
        """Some of the trajectories, with about this many rows."""
        lengths = self.valid.sum(axis=1)
        order = np.random.default_rng(seed).permutation(len(lengths))
        chosen = np.sort(order[: max(1, int(np.searchsorted(np.cumsum(lengths[order]), rows)))])
        names = ("index", "valid", "s", "inputs", "reached", "turns")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def rows(self) -> Rows:
        """The transitions, one after another."""
        return Rows(self.s[self.valid], self.inputs[self.valid], self.reached[self.valid])

    @property
    def counts(self) -> Array:
        """How often each state was measured, ``(T + 1, E)``."""
        counts = np.zeros((self.valid.shape[1] + 1, len(self.valid)))
        counts[:-1] += self.valid.T
        counts[1:] += self.valid.T
        return counts

    @property
    def measured(self) -> Array:
        """Mean measurement of each state in the filter's units, ``(T + 1, E, nx)``; zero where there is none."""
        total = np.zeros((*self.counts.shape, len(self.scale)))
        total[:-1] += np.where(self.valid[:, :, None], self.s, 0.0).swapaxes(0, 1)
        total[1:] += np.where(self.valid[:, :, None], self.reached, 0.0).swapaxes(0, 1)
        return np.asarray(total / np.maximum(self.counts, 1.0)[:, :, None] / self.scale)

    def linearised(self, theta: Array, about: Array) -> Linearised:
        """The filter's data with the model linearised about states ``(T + 1, E, nx)`` in the filter's units.

        Where the model is not finite, or moves by more than 1000 spreads of the increments, the trajectory is taken to
        stand still.
        """
        steps, n = self.valid.T.shape
        x, u = about[:-1].reshape(-1, len(self.scale)), self.inputs.swapaxes(0, 1).reshape(steps * n, -1)
        ahead, slopes, F = self.model.linearised(x * self.scale, u, theta)
        ahead, slopes, F = ahead / self.scale, slopes / self.scale[:, None], F * self.scale / self.scale[:, None]
        numbers = np.concatenate([part.reshape(len(x), -1) for part in (ahead, slopes, F)], axis=1)
        farthest = ABSURD * increments_scale(self.s[self.valid], self.reached[self.valid]) / self.scale
        bad = ~(np.isfinite(numbers).all(axis=1) & (np.abs(ahead - x) <= farthest).all(axis=1))
        ahead[bad], slopes[bad], F[bad] = x[bad], 0.0, np.eye(len(self.scale))
        parts = (part.reshape(steps, n, *part.shape[1:]) for part in (ahead, F, slopes))
        counts = self.counts if self.repeated else np.minimum(self.counts, 1.0)
        return Linearised(self.measured, counts, self.valid.T, about[:-1], *parts)


def _stretches(goes_on: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Rows of each trajectory ``(E, T)``, padded with its last row, and where they are no padding."""
    starts = np.concatenate([[0], np.flatnonzero(~goes_on) + 1])
    ends = np.concatenate([starts[1:], [len(goes_on) + 1]])
    lengths = ends - starts
    # The longest pieces that do not make the table mostly padding, where a few stretches are long and many short.
    longest = next((n for n in _LENGTHS if n * np.sum(-(-lengths // n)) <= 3 * lengths.sum()), _LENGTHS[-1])
    pieces = [
        (a, min(a + longest, end)) for start, end in zip(starts, ends, strict=True) for a in range(start, end, longest)
    ]
    first, last = np.array(pieces).T
    steps = np.arange((last - first).max())
    index = np.asarray(first[:, None] + steps)
    valid = index < last[:, None]
    return np.minimum(index, last[:, None] - 1), valid


def _wrapped(difference: Array, angles: tuple[int, ...]) -> Array:
    """The difference without full turns in the coordinates that are angles."""
    result = difference.copy()
    for i in angles:
        result[:, i] -= _FULL_TURN * np.round(result[:, i] / _FULL_TURN)
    return result
