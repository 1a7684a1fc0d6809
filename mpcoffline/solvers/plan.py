"""What a solver found, as the warm start of the next solve."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

# A plan can wait where it moves less than half as fast as at its end; it rests where it moves less than a tenth as fast
# as it ever does.
_OF_LAST, _OF_LARGEST = 0.25, 0.01  # of the squares


class Plan(tuple[Array, ...]):
    """State and input trajectories, the warm start of the next solve; a row of NaN stands for "no warm start".

    A tuple of two arrays; of three, where the problem has limits and the solver knows their multipliers.

    Args:
        x: States, ``(B, N + 1, nx)``.
        u: Inputs, ``(B, N, nu)``.
        multipliers: ``(B, N + 4, n)`` for n elements of limits: of the stages 0 ... N, then their weights now and at
            first, and what they are measured by, which all are the solver's own; None or rows of NaN where nothing is
            known of them.
    """

    __slots__ = ()

    def __new__(cls, x: Array, u: Array, multipliers: Array | None = None) -> Self:
        """The arrays as they are."""
        return super().__new__(cls, (x, u) if multipliers is None else (x, u, multipliers))

    def __getnewargs__(self) -> tuple[Array, ...]:
        """For copies and pickles."""
        return tuple(self)

    @property
    def x(self) -> Array:
        """States."""
        return self[0]

    @property
    def u(self) -> Array:
        """Inputs."""
        return self[1]

    @property
    def multipliers(self) -> Array | None:
        """Of limits, if they are known."""
        return self[2] if len(self) > 2 else None

    @classmethod
    def none(cls, n_problems: int, mpc: MPC) -> Plan:
        """A plan that warm-starts nothing."""
        x = np.full((n_problems, mpc.horizon + 1, mpc.nx), np.nan)
        return cls(x, np.full((n_problems, mpc.horizon, mpc.nu), np.nan))

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which rows hold a plan, ``(B,)``."""
        if not len(self.u):
            return np.zeros(0, dtype=bool)
        # Zero times NaN or inf is NaN: one product a row, several times faster than looking at each number.
        with np.errstate(invalid="ignore"):
            x, u = (a.reshape(len(a), -1) @ np.zeros(a[0].size) for a in self[:2])
            return np.asarray(x + u == 0.0)

    def shifted(self, mpc: MPC | None = None) -> Plan:
        """The plan one step later. The step that it lacks is a pause: at its end, or on its way where that rests.

        An optimal plan may stay where the stage cost is low, and leave that place towards its end only, for where the
        terminal cost is low (a turnpike). Each plan leaves as many steps before its end, and so one step later.

        Args:
            mpc: The problem: then a plan also waits where it moves, but half as fast as at its end, and at a lower
                stage cost. (The best a plant can do for long may be no rest: what it holds may be used up slowly.)
        """
        last = self.u.shape[1]
        pause = pauses(self.x, None if mpc is None else partial(self._cheaper, mpc))
        arrays = [np.concatenate([a[:, 1 : last + 1], a[:, last:]], axis=1) for a in self[::2]]
        arrays.insert(1, np.concatenate([self.u[:, 1:], self.u[:, -1:]], axis=1))
        waits = np.flatnonzero(pause < last)
        if len(waits):
            behind = (np.arange(last + 1) >= pause[waits, None])[:, :, None]
            for new, old in zip(arrays, self, strict=True):
                n = min(last + 1, new.shape[1])
                new[waits, :n] = np.where(behind[:, :n], old[waits, :n], new[waits, :n])
        return Plan(*arrays)

    def _cheaper(self, mpc: MPC, rows: NDArray[np.intp], steps: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether steps cost less than the last ones."""
        at, end = (mpc.stage_costs(self.x[rows, k], self.u[rows, k]) for k in (steps, -1))
        return np.asarray(at < end)

    def rows(self, chosen: NDArray[Any]) -> Plan:
        """Some of the rows."""
        return Plan(*(array[chosen] for array in self))

    def select(self, keep: NDArray[np.bool_]) -> Plan:
        """The plan with the other rows forgotten."""
        arrays = [array.copy() for array in self]
        for array in arrays:
            array[~keep] = np.nan
        return Plan(*arrays)


@np.errstate(over="ignore", invalid="ignore")  # a plan that explodes waits nowhere
def pauses(
    x: Array, cheaper: Callable[[NDArray[np.intp], NDArray[np.intp]], NDArray[np.bool_]] | None = None
) -> NDArray[np.intp]:
    """Where trajectories ``(B, N + 1, nx)`` can wait for a step, ``(B,)``: N but where one rests before.

    Each state is measured by its own largest step. (Where a swing turns, it is slow as well, but neither does it rest
    nor is that a cheap place.)

    Args:
        x: The trajectories.
        cheaper: Says of rows, and of a step in each, ``(n,)``, whether waiting there costs less than at the end.
    """
    last = x.shape[1] - 1
    if last < 3:
        return np.full(len(x), last)
    steps = x[:, 1:] - x[:, :-1]
    steps *= steps
    largest = steps.max(axis=1)
    moved: Array = np.einsum(
        "bkn,bn->bk", steps, np.divide(1.0, largest, out=np.zeros_like(largest), where=largest > 0.0)
    )
    about = moved[:, :-1] + moved[:, 1:]
    slowest = about.argmin(axis=1)
    least = about[np.arange(len(x)), slowest]
    waits = least < 2.0 * _OF_LAST * moved[:, -1]
    rests = least < 2.0 * _OF_LARGEST * x.shape[2]
    open_ones = np.flatnonzero(waits & ~rests)
    if cheaper is None or not len(open_ones):
        waits &= rests
    else:
        waits[open_ones] = cheaper(open_ones, slowest[open_ones] + 1)
    return np.asarray(np.where(waits, slowest + 1, last))
