"""Whether a model's structure is the plant's: how well it predicts many steps of episodes that it was not fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

from .identification import OneStepProblem
from .multi_step import MultiStepProblem, Windows
from .smoothing import NEGLIGIBLE
from .trajectories import Trajectories

HORIZON = 25  # steps of the fit that the identified model is compared with
CHECKED = (15, 50)  # steps that are predicted
WORSE = 0.1  # share of the error after the most steps by which a wrong structure shows

_SHORTEST = 5  # steps from which on more than one step is predicted
_STARTS = 5  # windows begin so many times a length
_FEWEST = 8  # windows that anything is said of
_HELD_OUT = 0.25
_UNEVEN = 0.1  # by which the share of the rows may differ from it
_PIECES = 20  # of the rows, at least, where episodes are cut
_FEW_EPISODES = 4
_CLEAR = 2.0  # standard errors beyond which a difference is no chance
_ROWS = 3_000
_OPERATIONS = 1e6  # of the model and its derivatives in a pass over the rows
_LEAST_ROWS = 500
_ITERATIONS = 20
_SETTLED = 1e-3  # relative decrease of the error: it is a tenth that matters


@dataclass(frozen=True)
class MultiStepCheck:
    """How well a model predicts held-out episodes open loop from a measured state, in spreads of the states.

    Attributes:
        steps: After how many steps, ``(15, 50)``, or what the stretches of the log allow.
        errors: Root mean square error of the identified model after so many steps.
        refitted: The same of the parameters that predict 25 steps of the other episodes best.
        tried: What of the structure was varied, in words.
    """

    steps: tuple[int, ...]
    errors: tuple[float, ...]
    refitted: tuple[float, ...]
    tried: tuple[str, ...] = ()

    @property
    def gain(self) -> float:
        """Share of the error over the most steps that other parameters would save; 0 where they save nothing."""
        return max(0.0, 1.0 - self.refitted[-1] / self.errors[-1]) if self.errors[-1] > 0.0 else 0.0

    @property
    def suspicious(self) -> bool:
        """Whether that is more than a tenth of errors that matter: structure, dead time or integrator are wrong.

        A right model predicts one step and many with the same parameters; on a plant that multiplies errors, what is
        off by next to nothing after a few steps is right whatever comes after many.
        """
        return self.gain > WORSE and min(self.errors) > NEGLIGIBLE

    def having_tried(self, *what: str) -> MultiStepCheck:
        """The same, with more that was varied."""
        return replace(self, tried=(*self.tried, *what))

    def __str__(self) -> str:
        """What it says, in a sentence or two."""
        parts = (f"{error:.2g} after {n} steps" for n, error in zip(self.steps, self.errors, strict=True))
        text = f"On held-out episodes the identified model is off by {', '.join(parts)} (in spreads)."
        if not self.suspicious:
            return text
        tried = f"Tried: {'; '.join(self.tried)}." if self.tried else "None of them was varied."
        return (
            f"{text} Other parameters would save {self.gain:.0%} of it: the structure of the model, a dead time or its"
            f" integrator is not the plant's. {tried}"
        )


def check_structure(
    mpc: MPC, found: Trajectories, episodes: NDArray[np.integer[Any]], theta: Array, *, spread: float, seed: int
) -> MultiStepCheck | None:
    """Compares the identified model with the one that predicts many steps best.

    Args:
        mpc: The MPC; its parameters are theta_0.
        found: The log.
        episodes: The episode of each of its rows, ``(n,)``.
        theta: The identified parameters.
        spread: Standard deviation of the prior in scaled coordinates.
        seed: Seeds the choice of episodes.

    Returns:
        The comparison; None where the log has no stretches long enough, or the model no parameters.
    """
    longest = int(found.valid.sum(axis=1).max())
    coordinates = OneStepProblem(mpc, found.rows())
    if longest < _SHORTEST or not coordinates.free.size:
        return None
    length = min(HORIZON, longest)
    windows = Windows.of(found, length, length, full=False)
    held_out = HeldOut.of(episodes, seed)
    windows = windows.chosen(~held_out.of_rows(windows.rows))
    if len(windows) < _FEWEST:
        return None
    problem = MultiStepProblem(mpc, windows, coordinates, spread)
    rows = int(np.clip(_OPERATIONS / problem.operations, _LEAST_ROWS, _ROWS))
    if len(windows) * length > rows:
        few = np.random.default_rng(seed).permutation(len(windows))[: max(_FEWEST, rows // length)]
        problem = MultiStepProblem(mpc, windows.chosen(np.sort(few)), coordinates, spread)
    z, *_ = problem.fitted(coordinates.z(theta), _ITERATIONS, _SETTLED)
    steps, errors, refitted = [], [], []
    for n in sorted({min(n, longest) for n in CHECKED}):
        tested = Windows.of(found, n, max(1, n // _STARTS), full=True)
        tested = tested.chosen(held_out.of_rows(tested.rows))
        if len(tested) >= _FEWEST:
            problem = MultiStepProblem(mpc, tested, coordinates, spread)
            steps.append(n)
            ends = [_squares(problem, parameters) for parameters in (coordinates.z(theta), z)]
            errors.append(float(np.sqrt(ends[0].mean())))
            refitted.append(float(np.sqrt(ends[1].mean())))
    return MultiStepCheck(tuple(steps), tuple(errors), tuple(refitted)) if steps else None


def _squares(problem: MultiStepProblem, z: Array) -> Array:
    """Mean square error after the last step from the measured start, of each window ``(W,)``."""
    last = problem.simulated(z, problem.windows.y[0], slopes=False).error[-1]
    return np.asarray(np.mean(last**2, axis=1))


class HeldOut(NamedTuple):
    """Episodes that nothing is fitted to; the last rows where there are hardly any episodes.

    Where episodes are a few long stretches and many fragments, as in the log of a plant in operation, a quarter of them
    may be hardly any row, or nearly all: then pieces of episodes, so many that they are a quarter of the rows.

    Attributes:
        rows: Whether a row of the table is one of them, ``(n,)``.
    """

    rows: NDArray[np.bool_]

    @classmethod
    def of(cls, episodes: NDArray[np.integer[Any]], seed: int) -> HeldOut:
        """A quarter of the episodes, or of the rows.

        Args:
            episodes: The episode of each row, ``(n,)``.
            seed: Seeds the choice.
        """
        ids = np.unique(episodes)
        if len(ids) < _FEW_EPISODES:
            return cls(np.arange(len(episodes)) >= (1.0 - _HELD_OUT) * len(episodes))
        rng = np.random.default_rng(seed)
        rows = np.isin(episodes, rng.permutation(ids)[: max(1, round(_HELD_OUT * len(ids)))])
        if abs(float(rows.mean()) - _HELD_OUT) <= _UNEVEN:
            return cls(rows)
        begins = np.append(True, episodes[1:] != episodes[:-1])
        first = np.maximum.accumulate(np.where(begins, np.arange(len(episodes)), 0))
        within = (np.arange(len(episodes)) - first) // -(-len(episodes) // _PIECES)
        piece = np.cumsum(begins | np.append(False, within[1:] != within[:-1])) - 1
        order = rng.permutation(int(piece[-1]) + 1)
        enough = int(np.searchsorted(np.cumsum(np.bincount(piece)[order]), _HELD_OUT * len(episodes))) + 1
        return cls(np.isin(piece, order[:enough]))

    def of_rows(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether these are held out."""
        return np.asarray(self.rows[rows])


def clearly_negative(differences: Array, groups: NDArray[np.integer[Any]]) -> bool:
    """Whether differences are below zero on average, beyond two standard errors; those of one group count as one."""
    ids, group = np.unique(groups, return_inverse=True)
    if len(ids) < _FEW_EPISODES:
        group = np.arange(len(differences)) * 20 // max(len(differences), 1)
    count = np.bincount(group)
    means = np.bincount(group, weights=differences)[count > 0] / count[count > 0]
    return len(means) > 1 and bool(means.mean() < -_CLEAR * means.std(ddof=1) / np.sqrt(len(means)))
