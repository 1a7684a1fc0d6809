"""A learned residual: what the identified model misses, as a small network that is added to it.

Where the model's structure is not the plant's, no parameters predict well. The network learns what the best of them
miss in one step, from a part of the episodes; it is bounded by the largest residual seen, and zero outside the data.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.threads import side_by_side
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

from .identification import OneStepProblem
from .multi_step import Windows, open_loop
from .plant import plant_rows
from .rows import Rows, without_jumps
from .small_network import Effort, SmallNetwork, fit_small_network
from .structure import HeldOut, clearly_negative
from .trajectories import Trajectories

logger = logging.getLogger(__name__)

HIDDEN = (16, 16)
STEPS = 15  # that are predicted open loop to judge it

_ROWS = 20_000
_LEAST = 1e-3  # of an increment: what is missed by less is not worth a network
_FEW = 4  # episodes, below which windows are compared
_ABSURD = 1e3
_DRAWN, _STEPS = 1_000, 40  # rows of a step, and steps, of a network that is one of several


@dataclass(frozen=True)
class Residual:
    """What is added to the plant's map in a model: ``f(x, u) + unit * network(x, u)``, u being the input that acts.

    Attributes:
        network: Maps (x, u) to the residual in spreads of the increments; None where nothing was learned.
        outputs: Which states have one, ``(nx,)``.
        unit: Spread of the increments, ``(nx,)``.
        taken: Whether held-out episodes say, beyond chance, that the model predicts one step and many better with it.
        share: The share of the squared one-step error on held-out episodes that it explains.
        one_step: Root mean square one-step error there in spreads of the increments, without and with it.
        far: The same after 15 steps open loop, in spreads of the states.
    """

    network: SmallNetwork | None
    outputs: NDArray[np.bool_]
    unit: Array
    taken: bool = False
    share: float = 0.0
    one_step: tuple[float, float] = (0.0, 0.0)
    far: tuple[float, float] = (0.0, 0.0)

    def __call__(self, x: Array, u: Array) -> Array:
        """The residual of states ``(B, nx)`` and inputs ``(B, nu)``, ``(B, nx)``."""
        result = np.zeros_like(x, dtype=np.float64)
        if self.network is not None:
            result[:, self.outputs] = self.network(np.hstack([x, u])) * self.unit[self.outputs]
        return result

    def expression(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """The same for symbols x ``(nx, 1)`` and u ``(nu, 1)``."""
        result = ca.SX.zeros(len(self.unit))
        if self.network is not None:
            result[np.flatnonzero(self.outputs).tolist()] = (
                self.network.expression(ca.vertcat(x, u)) * self.unit[self.outputs]
            )
        return result

    def __str__(self) -> str:
        """What it is worth, in a sentence."""
        if not self.taken:
            return "A learned residual was tried: held-out episodes do not ask for it."
        (one, one_after), (far, far_after) = self.one_step, self.far
        return (
            f"A learned residual explains {self.share:.0%} of what the identified model missed: on held-out episodes"
            f" one step is off by {one_after:.2g} increments instead of {one:.2g}, {STEPS} steps by {far_after:.2g}"
            f" spreads instead of {far:.2g}."
        )


def with_residual(mpc: MPC, residual: Residual) -> MPC:
    """The MPC with the residual added to its model; solvers, C and torch take it from the model's expression.

    Args:
        mpc: The MPC that the residual was fitted to.
        residual: The residual, taken or not.
    """
    x, u = (ca.SX.sym(name, size) for name, size in (("x", len(residual.unit)), ("u", len(mpc.layout.acting))))
    return mpc.replace(model=mpc.model.plus(ca.Function("residual", [x, u], [residual.expression(x, u)])))


def fit_residual(mpc: MPC, table: TransitionTable, seed: int = 0) -> Residual:
    """Learns what an identified model misses.

    A quarter of the episodes judges: a state keeps its residual if that lowers its one-step error there by more than
    two standard errors (paired, over episodes), and the whole is taken if one step and 15 steps open loop are better by
    as much.

    Example:
        >>> found = identify(mpc, table)
        >>> better = mpc.with_theta(found.theta)
        >>> residual = fit_residual(better, found.table)
        >>> better = with_residual(better, residual) if residual.taken else better

    Args:
        mpc: The MPC with the identified parameters.
        table: The transitions; without measurement noise, if there was any.
        seed: Seeds split and network.

    Returns:
        The residual, with what it is worth; nothing is changed.

    Raises:
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    table = plant_rows(mpc, table)
    missed = _Missed.of(mpc, table, seed)
    judged = HeldOut.of(missed.episodes, seed).rows
    outputs = np.sqrt(np.mean(np.clip(missed.errors, -_ABSURD, _ABSURD) ** 2, axis=0)) > _LEAST
    while outputs.any():
        residual = missed.learned(~judged, outputs, _drawn(np.random.default_rng(seed)))
        better = missed.gains(residual, judged)
        keep = outputs & better
        if (keep == outputs).all():
            return missed.judged(mpc, table, residual, judged, seed)
        outputs = keep
    return Residual(None, outputs, missed.unit)


def fit_residuals(mpc: MPC, table: TransitionTable, seed: int = 0, *, count: int = 5) -> tuple[Residual, ...]:
    """An ensemble: residuals from episodes drawn with replacement, each of which the log leaves possible.

    Args:
        mpc: The MPC with the identified parameters.
        table: The transitions, as in :func:`fit_residual`.
        seed: Seeds draws and networks.
        count: How many.

    Returns:
        The residuals; none is judged (``taken`` is False).
    """
    missed, rng = _Missed.of(mpc, plant_rows(mpc, table), seed), np.random.default_rng(seed)
    outputs = np.sqrt(np.mean(np.clip(missed.errors, -_ABSURD, _ABSURD) ** 2, axis=0)) > _LEAST
    if not count or not outputs.any():
        return (Residual(None, outputs, missed.unit),) * count
    ids, group = np.unique(missed.episodes, return_inverse=True)
    if len(ids) < _FEW:
        group = np.arange(len(group)) * 20 // len(group)
    members = list[tuple[_Missed, tuple[int, int]]]()
    for _ in range(count):
        drawn = rng.integers(group.max() + 1, size=group.max() + 1)
        rows = np.concatenate([np.flatnonzero(group == k) for k in drawn])
        members.append((missed.at(rows), _drawn(rng)))
    effort = Effort(rows=_DRAWN, steps=_STEPS)

    def learned(member: tuple[_Missed, tuple[int, int]], effort: Effort) -> Residual:
        own, seeds = member
        return own.learned(np.ones(len(own.errors), dtype=bool), outputs, seeds, effort)

    first = learned(members[0], effort)
    if first.network is not None:
        effort = effort._replace(decays=(first.network.decay,))  # the next ones would choose the same
    return first, *side_by_side([partial(learned, member, effort) for member in members[1:]])


def _drawn(rng: np.random.Generator) -> tuple[int, int]:
    """Seeds of the rows that say when to stop, and of the network."""
    return int(rng.integers(2**31)), int(rng.integers(2**31))


@dataclass(frozen=True)
class _Missed:
    """What a model misses in one step: inputs (x, u), errors in spreads of the increments, episodes of the rows."""

    inputs: Array
    errors: Array
    episodes: NDArray[np.integer[Any]]
    unit: Array

    @classmethod
    def of(cls, mpc: MPC, table: TransitionTable, seed: int) -> _Missed:
        """On the table, or on some rows of a large one, without jumps of wrapped angles."""
        sample = table.sample(_ROWS, seed)
        columns = sample.values()
        rows = Rows(columns.observations, columns.actions, columns.next_observations)
        centre = table.centring.centre[: table.ny]
        problem = OneStepProblem(mpc, rows, centre)
        rows, unwrapped = without_jumps(rows, problem.errors(mpc.theta) * problem.scale)
        if unwrapped:
            problem = OneStepProblem(mpc, rows, centre)
        errors = -problem.errors(mpc.theta)
        good = (np.abs(errors) < _ABSURD).all(axis=1)
        inputs = np.hstack([rows.x, rows.u])
        return cls(inputs[good], errors[good], sample.episode_ids[good], problem.scale)

    def at(self, rows: NDArray[np.intp]) -> _Missed:
        """Some of the rows."""
        return _Missed(self.inputs[rows], self.errors[rows], self.episodes[rows], self.unit)

    def learned(
        self,
        rows: NDArray[np.bool_],
        outputs: NDArray[np.bool_],
        seeds: tuple[int, int],
        effort: Effort | None = None,
    ) -> Residual:
        """The network of some of the rows; a quarter of their episodes says when to stop."""
        stop = HeldOut.of(self.episodes[rows], seeds[0]).rows
        inputs, errors = self.inputs[rows], self.errors[rows][:, outputs]
        parts = ((inputs[part], errors[part]) for part in (~stop, stop))
        return Residual(fit_small_network(next(parts), next(parts), HIDDEN, seeds[1], effort), outputs, self.unit)

    def gains(self, residual: Residual, rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which states are predicted better on these rows, beyond chance, ``(nx,)``."""
        before, after = self._squares(residual, rows)
        return np.array([clearly_negative(a - b, self.episodes[rows]) for a, b in zip(after.T, before.T, strict=True)])

    def judged(
        self, mpc: MPC, table: TransitionTable, residual: Residual, rows: NDArray[np.bool_], seed: int
    ) -> Residual:
        """The residual with what it is worth on episodes held out."""
        before, after = self._squares(residual, rows)
        share = 1.0 - float(after.sum() / max(before.sum(), np.finfo(np.float64).tiny))
        one_step = float(np.sqrt(before.mean())), float(np.sqrt(after.mean()))
        found = Trajectories.of(mpc, table.take(np.flatnonzero(np.isin(table.episode_ids, self.episodes[rows]))), ())
        steps = min(STEPS, int(found.valid.sum(axis=1).max()))
        windows = Windows.of(found, steps, steps, full=True)
        ends = [np.mean(open_loop(m, windows)[-1] ** 2, axis=1) for m in (mpc, with_residual(mpc, residual))]
        return Residual(
            residual.network,
            residual.outputs,
            residual.unit,
            clearly_negative(after.mean(axis=1) - before.mean(axis=1), self.episodes[rows])
            and clearly_negative(ends[1] - ends[0], np.arange(len(windows))),
            share,
            one_step,
            (float(np.sqrt(ends[0].mean())), float(np.sqrt(ends[1].mean()))),
        )

    def _squares(self, residual: Residual, rows: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Squared errors without and with it, ``(rows, nx)`` each."""
        x, u = np.split(self.inputs[rows], [len(self.unit)], axis=1)
        return self.errors[rows] ** 2, (self.errors[rows] - residual(x, u) / self.unit) ** 2
