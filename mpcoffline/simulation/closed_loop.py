"""Closed loops on all members of an ensemble at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpcoffline.control.course import Course
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc.layout import Layout
from mpcoffline.solvers import Plan

from .ensemble import Ensemble
from .logged_cost import LoggedCost

_RUN_AWAY = 30.0  # spreads of the data: a state this far out has left what any model of them knows
_END = 0.1  # share of the steps at the end by which success is judged
_SETTLED = 0.1  # of the log's mean cost above its cheapest


@dataclass(frozen=True)
class Simulation:
    """A controller in closed loop with every member of the ensemble from every start.

    Attributes:
        cost: Undiscounted cost of each episode above the cheapest logged cost, ``(members, starts)``.
        success: Whether the mean cost of the last tenth of the steps was small, ``(members, starts)``.
        lost: Whether the state ran away, ``(members, starts)``.
        states: States with the identified model, past inputs included, ``(starts, T + 1, nx)``.
        actions: Inputs with the identified model, ``(starts, T, nu)``.
    """

    cost: Array
    success: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    states: Array
    actions: Array

    @property
    def mean_cost(self) -> Array:
        """Mean over the starts, ``(members,)``."""
        return np.asarray(self.cost.mean(axis=1))


def simulate(
    policy: MPCPolicy,
    ensemble: Ensemble,
    cost: LoggedCost,
    table: TransitionTable,
    starts: Array,
    n_steps: int,
    signals: Array | None = None,
) -> Simulation:
    """Runs a controller on all members from all starts; all MPCs of a step are solved in one batch.

    A plant's state that runs away (30 spreads of the data) stays where it was and costs as much as the dearest logged
    transition from then on.

    Args:
        policy: The controller.
        ensemble: The models.
        cost: The stage cost.
        table: The data, for scales.
        starts: ``(starts, nx)``: observations, and the past inputs that the table's states hold.
        n_steps: Length of an episode.
        signals: What comes from outside after each step, ``(starts, n_steps, ny - n_states)``, see
            :func:`signals_along`; none by default.
    """
    columns = table.values()
    middle, spread = columns.observations.mean(axis=0), columns.observations.std(axis=0)
    reach = np.abs(columns.observations - middle).max(axis=0) + _RUN_AWAY * spread
    reach = np.where(spread > 0.0, reach, np.inf)
    reach[policy.mpc.layout.n_states :] = np.inf  # inputs have bounds of their own; a log may hardly use them
    dearest = float(columns.costs.max())
    ny, outside = policy.mpc.ny, slice(policy.mpc.layout.n_states, policy.mpc.ny)
    n, (s, nx) = len(ensemble), starts.shape
    x = np.broadcast_to(starts, (n, s, nx)).copy()
    lost = np.zeros((n, s), dtype=bool)
    costs, states, actions = [], [x[0].copy()], []
    course: Plan | Course | None = None
    if policy.mpc.nx == nx > ny:  # the policy knows what was applied before, as it would in the midst of an episode
        unknown = Plan.none(n * s, policy.mpc)
        course = Course(unknown.x, unknown.u, x.reshape(-1, nx)[:, ny:])
    for k in range(n_steps):
        flat = x.reshape(-1, nx)
        u, course = policy.predict(flat[:, :ny], state=course)
        u = np.asarray(u, dtype=np.float64)
        stage = cost(flat, u).reshape(n, s)
        costs.append(np.where(lost, dearest, stage) - cost.low)
        reached = ensemble.step(x, u.reshape(n, s, -1))
        lost |= ~(np.abs(reached - middle) < reach).all(axis=2)
        x = np.where(lost[:, :, None], x, reached)
        if signals is not None:
            x[:, :, outside] = signals[:, k]
        states.append(x[0].copy())
        actions.append(u.reshape(n, s, -1)[0])
    each = np.stack(costs, axis=2)
    end = max(1, round(_END * n_steps))
    small = _SETTLED * (float(columns.costs.mean()) - cost.low)
    return Simulation(
        each.sum(axis=2),
        (each[:, :, -end:].mean(axis=2) <= small) & ~lost,
        lost,
        np.stack(states, axis=1),
        np.stack(actions, axis=1),
    )


def initial_rows(table: TransitionTable, count: int, seed: int) -> NDArray[np.intp]:
    """Rows in which the log's own episodes began, at random; further rows where there are too few episodes."""
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(table.episodes.firsts)[:count]
    if len(chosen) < count:
        chosen = np.concatenate([chosen, rng.integers(len(table), size=count - len(chosen))])
    return np.sort(chosen)


def initial_states(table: TransitionTable, count: int, seed: int) -> Array:
    """The states in these rows, ``(count, nx)``."""
    return np.asarray(table.take(initial_rows(table, count, seed)).observations, dtype=np.float64)


def signals_along(table: TransitionTable, rows: NDArray[np.intp], n_steps: int, layout: Layout) -> Array:
    """The signals that were logged after some rows, ``(count, n_steps, ny - n_states)``: one after each step.

    Where an episode ends before, its signals go on as they would along a horizon.
    """
    n, ny, length = layout.n_states, layout.ny, len(table)
    moved = layout.sources[: ny - n] - n
    reached, ids = table.next_observations[:, n:ny], table.episode_ids
    now = np.asarray(table.observations[rows, n:ny], dtype=np.float64)
    found, goes_on = [], np.ones(len(rows), dtype=bool)
    for k in range(n_steps):
        row = np.minimum(rows + k, length - 1)
        goes_on &= (rows + k < length) & (ids[row] == ids[rows])
        now = np.where(goes_on[:, None], reached[row], now[:, moved])
        found.append(now)
    return np.stack(found, axis=1)
