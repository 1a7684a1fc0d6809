"""Whether logged costs contain what the soft limits of an MPC cost, and in which unit."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.features import RandomFeatures
from mpcoffline.mpc import MPC
from mpcoffline.mpc.penalties import penalty_function

from .known_cost import COST_ROWS, known_cost
from .limit_costs import LimitCosts
from .stages import Known

_log = logging.getLogger(__name__)


def limit_costs_of(mpc: MPC, table: TransitionTable) -> LimitCosts | None:
    """What the soft limits of an MPC cost in the unit of logged costs, and whether these contain it.

    Logged costs are explained by the MPC's stage cost, a quadratic in (s, a) and P. They contain it where the
    coefficient of P is nearer to the unit of the log than to zero. That unit is the scale of the MPC's stage cost where
    this is the logged one (:func:`~mpcoffline.learning.known_cost.known_cost`), else the ratio of their spreads,
    without what P explains.

    Args:
        mpc: Its limits and its stage cost.
        table: Transitions of its states as they were logged.

    Returns:
        None where nothing is soft along the horizon, or all logged costs are one number.
    """
    function = penalty_function(mpc)
    if function is None:
        return None
    known, columns = known_cost(mpc, table), table.values()
    if known is not None and known.constant:
        return None
    going = np.flatnonzero(columns.terminations == 0.0)
    s, a = columns.observations[going], columns.actions[going]
    logged = np.asarray(columns.costs[going], dtype=np.float64)
    ours, P = (each(s.T, a.T, mpc.theta).full().ravel() for each in (mpc.stage_function, function))
    if not len(logged) or not np.isfinite(np.stack([ours, P])).all():
        return LimitCosts(function, mpc.theta, 1.0, False)
    share = 0.0
    if P.std() > 0.0:
        inputs = np.hstack([s, a])
        quadratic = RandomFeatures(inputs, 0, np.random.default_rng(0))(inputs)
        share = _coefficient(logged, P, np.column_stack([ours, quadratic]))
    # Where a log costs little but for its violations, what they cost says nothing of the unit of the rest.
    unit = known.scale if known is not None else _ratio(logged - share * P, ours)
    contained = share > 0.5 * unit
    if known is None:
        unit = share if contained else _ratio(logged, ours)
    return LimitCosts(function, mpc.theta, unit, contained)


def with_limit_costs(known: Known) -> Known:
    """The costs without what soft limits cost, where they contain it; V sees them with it in any case."""
    found = limit_costs_of(known.mpc, excerpt(known.table, COST_ROWS, known.seed))
    if found is None:
        return known
    _log.info("Soft limits: %s", found)
    return replace(known.with_rows(found.without), limits=found)


def _ratio(logged: Array, ours: Array) -> float:
    found = float(logged.std() / ours.std()) if ours.std() > 0.0 else 1.0
    return found if 0.0 < found < np.inf else 1.0


def _coefficient(logged: Array, P: Array, others: Array) -> float:
    """That of P in the least squares fit of the logged costs."""
    columns = np.column_stack([P / P.std(), others])
    size = np.abs(columns).max(axis=0)
    found = np.linalg.lstsq(columns / np.where(size > 0.0, size, 1.0), logged, rcond=None)[0]
    return float(found[0] / (size[0] * P.std()))
