"""The condition of Theorem 1, doi:10.1109/TAC.2019.2913768: the policy keeps V finite on the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mpcoffline.control.course import Course
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.learning import ValueFunction
from mpcoffline.mpc import MPC, QuadraticCost
from mpcoffline.mpc.scaling import spread_of
from mpcoffline.solvers import Plan, Solver

_NEIGHBOURS = 100
_FLAT = 0.05  # of the widest: a direction in which the neighbours of the reference vary less is no direction of motion
_STEP = 1e-3  # of the data's spread, for differences
_APART = 0.1  # spreads from the reference: where loops begin that show whether they stay
_N_STEPS = 100
_LEFT = 3.0  # times as far as at the beginning
_ELSEWHERE = 1.0  # spreads: a loop that comes to rest nearer has an offset, but is stable
_AT_REST = 0.01  # spreads in the last tenth of the steps


@dataclass(frozen=True)
class TheoremCheck:
    """Theorem 1 asks that the optimal policy keeps V finite along the model.

    Attributes:
        value_growth: Largest V along the learned policy's rollouts on its own model, over the largest in the data;
            both above the smallest in the data. Inf where a rollout runs away.
        outside: Share of these states that are outside the data's support.
        eigenvalues: Moduli of the closed loop of learned policy and own model, linearised at the reference, largest
            first; empty where there is no reference, or the policy fails there. Signals are held and have none.
        leaves: Whether one of them is above 1 and the closed loop, simulated from near the reference, leaves it.
    """

    value_growth: float
    outside: float
    eigenvalues: tuple[float, ...]
    leaves: bool = False


@dataclass(frozen=True)
class WeightCheck:
    """Eigenvalues of a learned weight matrix, in spreads of what it weighs, smallest first.

    Attributes:
        name: ``"W"`` or ``"R"``.
        before: Of the nominal MPC.
        after: Of the learned one.
    """

    name: str
    before: tuple[float, ...]
    after: tuple[float, ...]


def value_growth(value: ValueFunction, table: TransitionTable, states: Array, lost: bool) -> float:
    """See :class:`TheoremCheck`; states ``(n, nx)`` of rollouts."""
    if lost or not np.isfinite(states).all():
        return np.inf
    logged = value.predict(table.take(slice(None, None, max(1, len(table) // 10_000))).observations)
    return float((value.predict(states).max() - logged.min()) / (float(np.ptp(logged)) or np.inf))


def closed_loop_eigenvalues(mpc: MPC, solver: Solver, table: TransitionTable, reference: Array) -> tuple[float, ...]:
    """Moduli of the eigenvalues of df/dx + df/du K at the reference, K by differences of the policy.

    Only along directions in which the logged states near the reference do vary: with [cos, sin] as state there is one
    that the plant never takes. Signals are held, whatever the loop does.
    """
    spread, own, kept = _directions(mpc, table, reference)
    step = _STEP * spread
    moved = reference + np.concatenate([np.diag(step)[own], -np.diag(step)[own]])
    found = solver.solve(np.concatenate([reference[None], moved]))
    if not found.success.all():
        return ()
    reached = mpc.model(moved, found.u0[1:])[:, own]
    jacobian = (reached[: own.sum()] - reached[own.sum() :]).T / (2.0 * step[own]) / spread[own, None] * spread[own]
    moduli = np.abs(np.linalg.eigvals(kept @ jacobian @ kept.T)) if np.isfinite(jacobian).all() else np.array([np.nan])
    return tuple(float(v) for v in np.sort(moduli)[::-1]) if np.isfinite(moduli).all() else ()


def leaves_reference(policy: MPCPolicy, table: TransitionTable, reference: Array) -> bool:
    """Whether the closed loop of a policy on its own model, begun a tenth of a spread beside the reference, leaves it.

    It does where it ends three times as far away and still moves, or rests more than a spread away.

    Args:
        policy: The policy; signals stay what they are at the reference.
        table: The transitions of its states, for scales.
        reference: The state of the MPC at rest, ``(nx,)``.
    """
    mpc = policy.mpc
    spread, own, kept = _directions(mpc, table, reference)
    beside = np.zeros((2 * len(kept), mpc.nx))
    beside[:, own] = np.concatenate([kept, -kept]) * _APART * spread[own]
    z = reference + beside
    plan = Plan.none(len(z), mpc)
    course: Plan | Course = Course(plan.x, plan.u, z[:, mpc.ny :], plan.multipliers) if mpc.layout.n_memory else plan
    path = [z]
    for _ in range(_N_STEPS):
        u, course = policy.predict(z[:, : mpc.ny], state=course)
        z = mpc.model(z, u.astype(np.float64))
        if not np.isfinite(z).all():
            return True
        path.append(z)
    last = ((np.stack(path[-_N_STEPS // 10 :]) - reference) / spread)[:, :, own] @ kept.T
    away, moving = np.linalg.norm(last, axis=2).min(axis=0), np.ptp(last, axis=0).max(axis=1) > _AT_REST
    return bool(((away > _LEFT * _APART) & (moving | (away > _ELSEWHERE))).any())


def _directions(mpc: MPC, table: TransitionTable, reference: Array) -> tuple[Array, NDArray[np.bool_], Array]:
    """Spread of each coordinate ``(nx,)``, which of them are the loop's own, no signals, and the directions of motion.

    These are rows of unit length in the own coordinates, in spreads, ``(k, n_own)``.
    """
    s = table.observations.astype(np.float64)
    spread, own = spread_of(s), np.ones(mpc.nx, dtype=bool)
    own[mpc.layout.n_states : mpc.ny] = False
    off = ((s - reference) / spread)[:, own]
    near = np.argsort(np.sum(off**2, axis=1))[:_NEIGHBOURS]
    _, sizes, directions = np.linalg.svd(off[near], full_matrices=False)
    return spread, own, directions[sizes > _FLAT * sizes.max(initial=0.0)]


def weight_checks(nominal: MPC, learned: MPC, table: TransitionTable) -> tuple[WeightCheck, ...]:
    """Eigenvalues of W and R before and after, in spreads of the data, where both costs are quadratic in the state."""
    before, after = nominal.stage_cost, learned.stage_cost
    if type(before) is not QuadraticCost or type(after) is not QuadraticCost or before.nx != after.nx:
        return ()
    states, inputs = spread_of(table.observations[:, : before.nx]), spread_of(table.actions)
    return tuple(
        WeightCheck(
            name,
            *(tuple(float(v) for v in np.linalg.eigvalsh(d[:, None] * getattr(c, name) * d)) for c in (before, after)),
        )
        for name, d in (("W", states), ("R", inputs))
        if getattr(after, name).size
    )
