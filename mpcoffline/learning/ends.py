"""What it is worth that an episode ends: for which rows are learned from, and for the terminal cost."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.inside import Inside
from mpcoffline.datasets.table.shards import Change
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

from .stages import KnownCost

_log = logging.getLogger(__name__)


class Ends(NamedTuple):
    """States in which episodes ended, and what a terminal cost must be there.

    Attributes:
        states: s+, ``(n, ny)``.
        values: T there, ``(n,)``, in the unit of the MPC's stage cost.
        before: s, from which they were reached, ``(n, ny)``.
    """

    states: Array
    values: Array
    before: Array


def ends_matter(table: TransitionTable, discount: float) -> bool:
    """Whether ends have a price: a cost of their own, beyond all others, or going on is worth more than nothing.

    After an end nothing is paid. Where that is less than what going on costs, and no price says that an end is bad or
    good, as in the log of a plant that is switched off when it leaves its range, the ends are no aim to be learned.

    Args:
        table: The transitions.
        discount: gamma, of what going on costs: the mean cost for 1 / (1 - gamma) steps.
    """
    ended = np.asarray(table.terminations) > 0.0
    if not ended.any() or ended.all():
        return False
    costs = np.asarray(table.costs, dtype=np.float64)
    others, own = costs[~ended], costs[ended]
    low, high = float(others.min()), float(others.max())
    size = (high - low) or max(abs(low), 1e-300)
    priced = float(np.median(np.maximum(own - high, low - own))) > 0.5 * size
    goes_on = float(others.mean()) / max(1.0 - discount, 1e-12)
    return priced or float(own.mean()) > goes_on + size


def innermost(table: TransitionTable, fraction: float, discount: float, count: int | None = None) -> TransitionTable:
    """The table without the farthest rows (:meth:`TransitionTable.trim`); all of it where ends matter."""
    if fraction < 1.0 and ends_matter(table, discount):
        _log.info("Episodes end at a price: no rows are left out, as ends lie far out")
        return table
    return table.trim(fraction, count)


def inside(table: TransitionTable, fraction: float, discount: float, count: int | None = None) -> Change | None:
    """What :func:`innermost` does, for the rows of which a table is an excerpt: it decides how far out is too far.

    Returns:
        From rows to those that stay; None where all do.
    """
    if fraction >= 1.0 or ends_matter(table, discount):
        return None
    return Inside.of(table, fraction, count)


def going_on(table: TransitionTable) -> TransitionTable:
    """The transitions after which an episode goes on."""
    return table.take(np.flatnonzero(np.asarray(table.terminations) == 0.0))


def priced_ends(mpc: MPC, table: TransitionTable, cost: KnownCost | None) -> Ends | None:
    """T where episodes end, so that a plan pays for an end what the log says.

    A plan goes on after an end, so T holds what the stage cost of the last step lacks::

        Lhat(s,a) + gamma T(s+) = L(s,a),      nothing follows

    Args:
        mpc: Its stage cost is Lhat.
        table: The transitions.
        cost: How logged costs follow from Lhat; None where Lhat is in their unit.

    Returns:
        None where ends do not matter.
    """
    if not ends_matter(table, mpc.discount):
        return None
    last = table.take(np.flatnonzero(np.asarray(table.terminations) > 0.0)).values()
    cost = KnownCost() if cost is None else cost
    ours = cost.stage_costs(mpc, last)
    lacking = cost.of_state(mpc, last.next_observations)
    values = ((last.costs - cost.offset) / cost.scale - ours) / mpc.discount + lacking
    states, before = (np.asarray(s, dtype=np.float64) for s in (last.next_observations, last.observations))
    return Ends(states, np.asarray(values, dtype=np.float64), before)
