"""Stage costs that are distances or sums of absolute errors, where the logged costs are exactly such ones."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.features import RandomFeatures, Ridge
from mpcoffline.estimation.norms import Norms, fit_norms
from mpcoffline.mpc import MPC
from mpcoffline.mpc.expression_cost import ExpressionCost
from mpcoffline.mpc.parameters import ParameterSpace
from mpcoffline.mpc.scaling import cost_spread

from .stages import ROUNDING, KnownCost

_ROWS = 4_000
_PARTS = (0.5, 0.75)  # of the rows: what is learned from, what chooses the shape, what judges
_ROWS_A_NUMBER, _DIRECTIONS = 2, 6
_RANDOM = 100
_WORTH_MORE = 0.8  # times the squared error, for which all states are taken
_TRIFLE = 1e-3  # of the variance
_EXACT = 1e-12  # share of the variance: true norms end below 1e-14, what some norms resemble above 1e-11
_ROUNDED = 0.03  # of the size of a norm: how its kink is rounded in a plan


def normed_cost(mpc: MPC, table: TransitionTable) -> tuple[MPC, KnownCost] | None:
    """The MPC whose stage cost is a quadratic with norms, if that explains the logged costs to rounding.

    A reward is often minus a distance, or a sum of absolute errors. No weights of a quadratic stage cost are alike: it
    asks for much where much is lost anyhow, and for nothing near the goal. Such costs are looked for in the states that
    the MPC's stage cost depends on, then in all, those that a step begins with and those that it reaches. A quadratic
    alone is none of them: (FIT) finds it.

    In the MPC kinks are rounded by some per cent of the size of the norm.

    Args:
        mpc: Which states its stage cost depends on says where to look first.
        table: Transitions as logged.

    Returns:
        None where the logged costs are no such thing.
    """
    rows = table.sample(_ROWS, 0)
    columns = rows.values()
    going = np.flatnonzero(columns.terminations == 0.0)
    cost = np.asarray(columns.costs[going], dtype=np.float64)
    s, a, after = (each[going] for each in (columns.observations, columns.actions, columns.next_observations))
    # Rows that are logged again would be learned from and judged by.
    _, once = np.unique(np.hstack([s, a, after, cost[:, None]]), axis=0, return_index=True)
    s, a, after, cost = (each[np.sort(once)] for each in (s, a, after, cost))
    spread = cost_spread(cost) if len(cost) else 0.0
    if not spread > 0.0:
        return None
    y = (cost - cost.mean()) / spread
    order = np.random.default_rng(0).permutation(len(y))
    parts = np.split(order, [round(share * len(y)) for share in _PARTS])
    unit, variance = (float(cost.mean()), spread), float(np.var(y))
    for reached, states in _views(mpc, s, after, a, y, parts):
        x = np.hstack([(after if reached else s)[:, states], a])
        if len(parts[0]) < _ROWS_A_NUMBER * _numbers(x.shape[1]):
            continue
        if _missed(RandomFeatures(x, 0, np.random.default_rng(0)), x, y, parts) <= ROUNDING * variance:
            return None
        data, ends = ((x[part], y[part]) for part in parts[:2])
        norms = fit_norms(data, ends, np.random.default_rng(0))
        missed = float(np.mean((norms(x[parts[2]]) - y[parts[2]]) ** 2))
        if missed <= (_EXACT + _rounding(table, cost, x)) * variance:
            stage = _stage_cost(norms, x, states, s.shape[1], mpc.nu, unit)
            return mpc.replace(stage_cost=stage), KnownCost(missed=missed, reached=reached, regressed=True)
    return None


def _numbers(d: int) -> int:
    """About how many are learned of d columns: a quadratic, and norms of several directions."""
    return 1 + d + d * (d + 1) // 2 + _DIRECTIONS * (d + 1)


def _rounding(table: TransitionTable, cost: Array, x: Array) -> float:
    """What the rounding of logged numbers leaves open, as share of the variance."""
    eps = float(np.finfo(table.costs.dtype).eps)
    digits = [np.abs(v).max(axis=0) / np.where(v.std(axis=0) > 0.0, v.std(axis=0), np.inf) for v in (cost[:, None], x)]
    return float(np.sum((eps * np.concatenate(digits)) ** 2))


def _views(
    mpc: MPC, s: Array, after: Array, a: Array, y: Array, parts: list[NDArray[np.intp]]
) -> list[tuple[bool, NDArray[np.intp]]]:
    """Whether costs are of the states that are reached, and of which of these: the likelier first, by a regression.

    None that this explains but for a trifle: that has no kinks.
    """
    named, everything, found = _named(mpc, s, a), np.arange(s.shape[1]), []
    for reached in (False, True):
        errors = []
        for states in (named, everything):
            x = np.hstack([(after if reached else s)[:, states], a])
            errors.append(_missed(RandomFeatures(x, _RANDOM, np.random.default_rng(0)), x, y, parts))
        few = len(named) > 0 and _WORTH_MORE * errors[0] <= errors[1]
        found.append((errors[0 if few else 1], reached, named if few else everything))
    kinked = [each for each in found if each[0] > _TRIFLE * float(np.var(y))]
    return [(reached, states) for _, reached, states in sorted(kinked, key=lambda each: each[0])]


def _named(mpc: MPC, s: Array, a: Array) -> NDArray[np.intp]:
    """The states that the MPC's stage cost depends on where the data are."""
    x, u, theta = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX.sym("theta", mpc.space.size)
    slope = ca.Function("slope", [x, u, theta], [ca.densify(ca.gradient(mpc.stage_function(x, u, theta), x))])
    return np.flatnonzero(np.nan_to_num(slope(s.T, a.T, mpc.theta).full()).any(axis=1)[: s.shape[1]])


def _missed(features: RandomFeatures, x: Array, y: Array, parts: list[NDArray[np.intp]]) -> float:
    """The squared error on the last part of what the first one teaches."""
    seen, unseen = parts[0], parts[2]
    fitted = Ridge.fit(features(x[seen]), y[seen, None])
    return float(np.mean((fitted(features(x[unseen]))[:, 0] - y[unseen]) ** 2))


def _stage_cost(
    norms: Norms, x: Array, states: NDArray[np.intp], nx: int, nu: int, unit: tuple[float, float]
) -> ExpressionCost:
    z, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    level, scale = unit
    value = level + scale * norms.expression(ca.vertcat(z[states.tolist()], u), _ROUNDED * norms.sizes(x))
    space = ParameterSpace([])
    function = ca.Function("stage_cost", [z, u, ca.SX.sym("theta", 0)], [ca.densify(value)])
    return ExpressionCost(function, space)
