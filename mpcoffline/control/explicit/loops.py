"""Closed loops on an MPC's own model, and what the MPC does in their states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mpcoffline.control.course import Course
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.mpc.labels import Label
from mpcoffline.solvers import Solver

_BLOCK = 2_000  # solves between two signs of life
_FAR = 10.0  # spreads of what the MPC meets: states farther out would teach what is never needed


class Teacher(Protocol):
    """What is distilled: :class:`mpcoffline.MPCPolicy`, as far as it is asked."""

    mpc: MPC
    observation_space: Any
    action_space: Any

    @property
    def solver(self) -> Solver:
        """Its solver."""

    @property
    def y_labels(self) -> tuple[Label, ...]:
        """What the coordinates of an observation are called."""

    def with_normalization(self, vec_env: None) -> Teacher:
        """The policy for observations in their units."""

    def predict(self, observation: Any, state: Any = None) -> tuple[NDArray[Any], Any]:
        """Inputs ``(B, nu)`` for observations ``(B, ny)``, and what the next call wants to know."""


Act = Callable[[Array], Array]


@dataclass(frozen=True)
class Loops:
    """Closed loops from several starts.

    Attributes:
        states: z along each, ``(T, n, nz)``; NaN once it is lost.
        actions: What was asked for, before noise, ``(T, n, nu)``.
        costs: Stage costs, ``(T, n)``; inf once it is lost.
    """

    states: Array
    actions: Array
    costs: Array

    def cost(self) -> Array:
        """What each loop costs, undiscounted, ``(n,)``."""
        return np.asarray(self.costs.sum(axis=0))

    def rows(self) -> tuple[Array, Array]:
        """States ``(m, nz)`` and actions ``(m, nu)`` of all steps that are not lost."""
        states, actions = (a.reshape(-1, a.shape[-1]) for a in (self.states, self.actions))
        known = np.isfinite(states).all(axis=1)
        return states[known], actions[known]

    def near(self, mean: Array, spread: Array) -> Array:
        """The states ``(m, nz)`` of all steps that are not far from a centre, in these spreads."""
        states, _ = self.rows()
        return states[(np.abs(states - mean) <= _FAR * spread).all(axis=1)]


def closed_loops(
    mpc: MPC,
    act: Act,
    states: Array,
    n_steps: int,
    *,
    noise: Array | float = 0.0,
    rng: np.random.Generator | None = None,
) -> Loops:
    """Runs a controller on the MPC's model.

    Args:
        mpc: The MPC.
        act: Inputs ``(n, nu)`` of states ``(n, nz)``, called once a step.
        states: Where to begin, ``(n, nz)``.
        n_steps: How many steps.
        noise: Standard deviation of what is added to the inputs, ``(nu,)``, within their bounds.
        rng: Draws the noise; None for none.
    """
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    seen, asked, costs = [], [], []
    z, lost = states, np.zeros(len(states), dtype=bool)
    for _ in range(n_steps):
        u = act(z)
        cost = mpc.stage_costs(z, u)
        lost |= ~np.isfinite(cost)
        seen.append(np.where(lost[:, None], np.nan, z))
        asked.append(u)
        costs.append(np.where(lost, np.inf, cost))
        applied = u if rng is None else np.clip(u + noise * rng.standard_normal(u.shape), low, high)
        reached = mpc.model(z, applied)
        lost |= ~np.isfinite(reached).all(axis=1)
        z = np.where(lost[:, None], states, reached)  # a lost one goes on where nothing overflows
    return Loops(np.array(seen), np.array(asked), np.array(costs))


def mpc_acting(teacher: Teacher) -> Act:
    """The MPC as it acts in a loop, from its plan of the step before: for one loop, and called once a step."""
    carried: list[Any] = [None]
    ny = teacher.mpc.ny

    def act(z: Array) -> Array:
        before = carried[0]
        if before is not None and z.shape[1] > ny:  # noise was added to what it remembers
            before = Course(before[0], before[1], z[:, ny:], *before[3:])
        actions, carried[0] = teacher.predict(z[:, :ny], before)
        return np.asarray(actions, dtype=np.float64)

    return act


def solved(solver: Solver, states: Array, told: Callable[[int], None]) -> tuple[Array, Array]:
    """The states that the MPC solves, and its inputs there, each the best of its plans from several starts.

    Args:
        solver: The MPC's.
        states: States, ``(n, nz)``.
        told: Called with how many were solved since.
    """
    kept, inputs = [], []
    for first in range(0, len(states), _BLOCK):
        block = states[first : first + _BLOCK]
        solution = solver.solve(block)
        kept.append(block[solution.success])
        inputs.append(solution.u0[solution.success])
        told(len(block))
    return np.concatenate(kept), np.concatenate(inputs)
