"""The condition of Theorem 1, doi:10.1109/TAC.2019.2913768: the policy keeps V finite on the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.learning import ValueFunction
from mpcoffline.mpc import MPC, QuadraticCost
from mpcoffline.mpc.scaling import spread_of
from mpcoffline.solvers import Solver

_NEIGHBOURS = 100
_FLAT = 0.05  # of the widest: a direction in which the neighbours of the reference vary less is no direction of motion
_STEP = 1e-3  # of the data's spread, for differences


@dataclass(frozen=True)
class TheoremCheck:
    """Theorem 1 asks that the optimal policy keeps V finite along the model.

    Attributes:
        value_growth: Largest V along the learned policy's rollouts on its own model, over the largest in the data;
            both above the smallest in the data. Inf where a rollout runs away.
        outside: Share of these states that are outside the data's support.
        eigenvalues: Moduli of the closed loop of learned policy and own model, linearised at the reference, largest
            first; empty where there is no reference, or the policy fails there.
    """

    value_growth: float
    outside: float
    eigenvalues: tuple[float, ...]


@dataclass(frozen=True)
class WeightCheck:
    """Eigenvalues of a learned weight matrix, smallest first.

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
    that the plant never takes.
    """
    s = table.observations.astype(np.float64)
    spread = spread_of(s)
    step = _STEP * spread
    moved = reference + np.concatenate([np.diag(step), -np.diag(step)])
    found = solver.solve(np.concatenate([reference[None], moved]))
    if not found.success.all():
        return ()
    u = found.u0
    reached = mpc.model(moved, u[1:])
    jacobian = (reached[: mpc.nx] - reached[mpc.nx :]).T / (2.0 * step) / spread[:, None] * spread
    near = np.argsort(np.sum(((s - reference) / spread) ** 2, axis=1))[:_NEIGHBOURS]
    _, sizes, directions = np.linalg.svd((s[near] - reference) / spread, full_matrices=False)
    kept = directions[sizes > _FLAT * sizes.max(initial=0.0)] if len(sizes) else directions
    moduli = np.abs(np.linalg.eigvals(kept @ jacobian @ kept.T))
    return tuple(float(v) for v in np.sort(moduli)[::-1]) if np.isfinite(moduli).all() else ()


def weight_checks(nominal: MPC, learned: MPC) -> tuple[WeightCheck, ...]:
    """Eigenvalues of W and R before and after, where both costs are quadratic."""
    before, after = nominal.stage_cost, learned.stage_cost
    if not isinstance(before, QuadraticCost) or not isinstance(after, QuadraticCost):
        return ()
    return tuple(
        WeightCheck(name, *(tuple(float(v) for v in np.linalg.eigvalsh(getattr(c, name))) for c in (before, after)))
        for name in ("W", "R")
        if getattr(after, name).size
    )
