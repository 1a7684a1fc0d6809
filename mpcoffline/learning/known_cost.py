"""Stage costs that need no learning: the logged ones are the MPC's, up to scale, offset and noise in the states."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import casadi as ca
import numpy as np
import scipy.optimize
import torch
from numpy.typing import NDArray

from mpcoffline.core.checks import check_known
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Identification, identify, smooth
from mpcoffline.estimation.features import RandomFeatures, Ridge
from mpcoffline.mpc import MPC
from mpcoffline.mpc.coordinates import Coordinates, canonical, with_level
from mpcoffline.mpc.row_twin import RowTwin
from mpcoffline.mpc.scaling import Scaling

from .normed_cost import normed_cost
from .stages import ROUNDING, Known, KnownCost

StageCostKind = Literal["fitted", "auto", "given"]

_log = logging.getLogger(__name__)

#: Rows on which costs are compared.
COST_ROWS = 20_000
_CHUNK = 100_000  # rows that are looked at a time
_NOISY = 0.05  # the same where noise in the states may be what is left
_WHITE = 0.3  # correlation of neighbouring residuals above which these are no noise: wrong costs have .5 to .95
_EXPLAINED = 0.3  # share of the residual's variance that a quadratic may explain: missing terms are explained whole
_AGREEING = 1.0 / 3.0  # share of the transitions that suffices, if exact: what else than the cost itself would be
_DIGITS = 1e-4  # of the spread, to which these agree one by one
_LEAST_SPREAD = 0.3  # of s and a there, in that of all: near rest any smooth costs agree
_STARTS, _ROUNDS = 100, 10
_AS_WRITTEN = 0.05  # under noise in the states, which draws it towards 0, a scale this near to 1 is 1


@dataclass(frozen=True)
class CostConfig:
    """Whether the stage cost is learned.

    Attributes:
        stage_cost: ``"fitted"`` by (FIT); ``"given"``: it stays what the MPC has, and model and terminal cost alone are
            learned; ``"auto"``: it stays where the logged costs are those of the MPC (:func:`known_cost`), also
            with other weights, which are then taken over, or say nothing about it, else it is fitted.
    """

    stage_cost: StageCostKind = "fitted"

    def __post_init__(self) -> None:
        check_known("stage_cost", self.stage_cost, get_args(StageCostKind))


def with_known_cost(known: Known, config: CostConfig) -> Known:
    """What is known of the stage cost, from the rows as they were logged: smoothed ones would blur it."""
    if config.stage_cost == "fitted":
        return known
    rows = excerpt(known.table, COST_ROWS, known.seed)
    if config.stage_cost == "auto":
        agreeing = agreeing_cost(known.mpc, rows)
        if agreeing is None:
            return known
        mpc, found = agreeing
        if mpc is not known.mpc:
            if not found.regressed:
                _log.info("The logged costs are the MPC's stage cost with other parameters, which are taken over")
            return replace(known, mpc=mpc, cost=found)
    else:
        found = known_cost(known.mpc, rows) or _affine(*_costs(known.mpc, rows)[:2])
    _log.info("The stage cost is not learned but kept: %s", found)
    if found.agreeing < 1.0:
        _log.warning(
            "the logged cost is the MPC's stage cost in %.0f %% of the transitions only%s; what it is elsewhere, where "
            "the plant cuts off inputs or adds penalties, is seen by V alone",
            100.0 * found.agreeing,
            ", from which the model is identified" if "model" in known.groups else "",
        )
    if found.constant:
        _log.warning(
            "%s: every step costs %g%s: stage and terminal cost stay the given ones%s",
            known.table.name,
            found.offset,
            ", only ends tell what is good" if np.any(known.table.terminations) else "",
            ", the model alone is learned" if "model" in known.groups else "",
        )
    return replace(known, cost=found)


def agreeing_cost(mpc: MPC, table: TransitionTable, *, count: int = 4_000) -> tuple[MPC, KnownCost] | None:
    """The MPC whose stage cost the logged costs are, and the relation.

    That is the given one, one with other weights, or one with another stage cost
    (:func:`~mpcoffline.learning.normed_cost.normed_cost`). Costs may be of the state that a step begins with, or of the
    one that it reaches; of the latter, if all are.

    Args:
        mpc: Its stage cost is Lhat.
        table: Transitions as logged, see :func:`known_cost`.
        count: From how many of them the weights are found.

    Returns:
        None where no weights make it so.
    """
    for reached in (False, True):
        found = known_cost(mpc, table, reached=reached)
        other = mpc if found is not None else _with_fitted_weights(mpc, table, count, reached)
        if found is None and other is not None:
            found = known_cost(other, table, noise=False, reached=reached)
        if other is not None and found is not None:
            return other, found
    return normed_cost(mpc, table)


def known_cost(mpc: MPC, table: TransitionTable, *, noise: bool = True, reached: bool = False) -> KnownCost | None:
    """Whether the logged costs are the MPC's stage cost, ``L = a Lhat(s,a) + b`` with a > 0.

    So it is where this explains L to rounding, in all transitions or in a third of them (elsewhere a plant may cut off
    inputs). States with measurement noise leave a residual, about ``-a dLhat/ds v``, which tells itself from that of a
    wrong cost: from one transition to the next it is not correlated, and no quadratic in (s, a) explains it.

    Args:
        mpc: Its stage cost is Lhat.
        table: Transitions as logged, neighbours in time beside each other.
        noise: Whether noise in the states may explain a residual.
        reached: Whether ``Lhat(s+,a)`` is asked about; then in all transitions.

    Returns:
        The relation; None where there is none.
    """
    ours, logged, inputs, pairs = _costs(mpc, table, reached)
    if len(logged) and np.ptp(logged) <= 1e-12 * np.abs(logged).max():
        return KnownCost(offset=float(logged.mean()), constant=True)
    if len(logged) < 3 or not np.isfinite(ours).all() or not ours.std() > 0.0:
        return None
    fit = replace(_affine(ours, logged), reached=reached)
    if fit.scale > 0.0 and fit.missed <= ROUNDING:
        return _rounded(fit, ours, logged, np.sqrt(ROUNDING))
    if noise and fit.scale > 0.0 and fit.missed <= _NOISY:
        residual = logged - fit.scale * ours - fit.offset
        if _correlation(residual, pairs) <= _WHITE and _explained(inputs, residual) <= _EXPLAINED:
            return _rounded(fit, ours, logged, _AS_WRITTEN)
    return None if reached else _partly(ours, logged, inputs)


def _costs(mpc: MPC, table: TransitionTable, reached: bool = False) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """Lhat and L ``(n,)``, and (s, a), where no episode ended; and after which of them the episode goes on."""
    columns, episodes = table.values(), np.asarray(table.episode_ids)
    going = np.flatnonzero(columns.terminations == 0.0)
    s, a = (columns.next_observations if reached else columns.observations)[going], columns.actions[going]
    ours = mpc.stage_costs(s, a)
    pairs = np.flatnonzero((np.diff(going) == 1) & (np.diff(episodes[going]) == 0))
    return ours, np.asarray(columns.costs[going], dtype=np.float64), np.hstack([s, a]), pairs


def _affine(ours: Array, logged: Array) -> KnownCost:
    """The relation of least squares."""
    about, mean = ours - ours.mean(), float(logged.mean())
    variance, spread = float(about @ about), float(np.sum((logged - mean) ** 2))
    a = float(about @ (logged - mean)) / variance if variance > 0.0 else 0.0
    if not a > 0.0:  # given for a reason all the same, and of some size
        a = float(np.sqrt(spread / variance)) if variance > 0.0 and spread > 0.0 else 1.0
        return KnownCost(a, mean - a * float(ours.mean()), 1.0)
    missed = float(np.sum((logged - mean - a * about) ** 2)) / spread if spread > 0.0 else 0.0
    return KnownCost(a, mean - a * float(ours.mean()), missed)


def _partly(ours: Array, logged: Array, inputs: Array) -> KnownCost | None:
    """The relation in the third of the transitions that agrees best (least trimmed squares), if it is exact there.

    Begun at the best of some lines through two transitions, then alternating (Rousseeuw and Van Driessen,
    doi:10.1007/s10618-005-0024-4).
    """
    count, rng = -(-len(ours) // 3), np.random.default_rng(0)
    first, second = rng.integers(len(ours), size=(2, _STARTS))
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = (logged[first] - logged[second]) / (ours[first] - ours[second])
    lines = [(a, logged[i] - a * ours[i]) for a, i in zip(slopes, first, strict=True) if np.isfinite(a) and a > 0.0]
    if not lines:
        return None
    misses = [np.abs(logged - a * ours - b) for a, b in lines]
    kept = np.argpartition(min(misses, key=lambda missed: np.partition(missed, count - 1)[count - 1]), count - 1)[
        :count
    ]
    fit = _affine(ours[kept], logged[kept])
    for _ in range(_ROUNDS):
        kept = np.argpartition(np.abs(logged - fit.scale * ours - fit.offset), count - 1)[:count]
        fit = _affine(ours[kept], logged[kept])
    for _ in range(2):  # those kept are the cheapest of the exact ones, whose rounding is the smallest
        tolerance = _DIGITS * float(logged[kept].std())
        agree = np.abs(logged - fit.scale * ours - fit.offset) <= tolerance
        if np.mean(agree) < _AGREEING or (inputs[agree].std(axis=0) < _LEAST_SPREAD * inputs.std(axis=0)).any():
            return None
        kept, fit = np.flatnonzero(agree), _affine(ours[agree], logged[agree])
    found = _rounded(fit, ours[kept], logged[kept], ROUNDING)
    return replace(found, agreeing=float(np.mean(agree)), tolerance=tolerance)


def as_logged(mpc: MPC, table: TransitionTable, cost: KnownCost | None) -> TransitionTable:
    """The transitions in which the plant took the logged input, as far as the costs tell.

    Where a plant cuts off inputs (an inverter at its limits, a full tank), it pays and moves for another one than is
    logged. Of such rows a model would learn an input that does less than it does.

    Args:
        mpc: Its stage cost is Lhat.
        table: Transitions of its states.
        cost: How logged costs follow from Lhat.

    Returns:
        The table itself where costs tell nothing.
    """
    taken = as_applied(mpc, table, cost)
    return table if taken.all() else table.take(np.flatnonzero(taken))


def as_applied(mpc: MPC, table: TransitionTable, cost: KnownCost | None) -> NDArray[np.bool_]:
    """Which rows these are, ``(n,)``; all, where costs tell nothing."""
    if cost is None or cost.agreeing == 1.0:
        return np.ones(len(table), dtype=bool)
    agreeing = []
    for start in range(0, len(table), _CHUNK):
        rows = table.take(slice(start, start + _CHUNK)).values()
        ours = mpc.stage_costs(rows.observations, rows.actions)
        agreeing.append(np.abs(rows.costs - cost.scale * ours - cost.offset) <= cost.tolerance)
    return np.concatenate(agreeing)


def identify_as_logged(
    mpc: MPC,
    table: TransitionTable,
    rows: TransitionTable,
    *,
    tried: Sequence[str] = (),
    seed: int = 0,
    start: MPC | None = None,
) -> tuple[Identification, TransitionTable]:
    """The model identified from the rows that tell what inputs do, and all rows without measurement noise.

    Learner and diagnosis identify by this one rule.

    Args:
        mpc: Its parameters are theta_0.
        table: Transitions of its states.
        rows: Those of :func:`as_logged`.
        tried: See :func:`mpcoffline.estimation.identify`.
        seed: Likewise.
        start: Likewise.

    Returns:
        What was identified, whose own table are the rows without noise; and the whole table without it.
    """
    found = identify(mpc, rows, tried=tried, seed=seed, start=start)
    if rows is table:
        return found, found.table
    if found.noise.negligible:
        return found, table
    return found, smooth(mpc.replace(model=found.model), table, found.theta, found.noise)


def _rounded(fit: KnownCost, ours: Array, logged: Array, near: float) -> KnownCost:
    """The relation with a scale of 1 where it is as near to that, and without an offset where that is rounding."""
    scale = 1.0 if abs(fit.scale - 1.0) <= near else fit.scale
    offset = float(np.mean(logged - scale * ours))
    return replace(fit, scale=scale, offset=offset if abs(offset) > ROUNDING * float(logged.std()) else 0.0)


def _correlation(residual: Array, pairs: NDArray[np.intp]) -> float:
    """The correlation of residuals that follow each other in time; 1 where too few do."""
    if len(pairs) < 30:
        return 1.0
    first, second = residual[pairs], residual[pairs + 1]
    size = float(np.sqrt(np.sum(first**2) * np.sum(second**2)))
    return float(np.sum(first * second)) / size if size > 0.0 else 0.0


def _explained(inputs: Array, residual: Array) -> float:
    """The share of the variance of every other residual that a quadratic in (s, a) of the others explains."""
    features = RandomFeatures(inputs, 0, np.random.default_rng(0))(inputs)
    missed = residual[1::2] - Ridge.fit(features[::2], residual[::2, None])(features[1::2])[:, 0]
    variance = float(np.var(residual[1::2]))
    return 1.0 - float(np.mean(missed**2)) / variance if variance > 0.0 else 0.0


def _by_rows(function: ca.Function) -> Callable[..., Array]:
    """A function of rows and parameters, ``(B, m)``: numpy's, or CasADi's where numpy has not all operations."""
    try:
        return RowTwin(function)
    except InvalidArgumentError:
        return lambda *inputs: np.asarray(function(*(each.T for each in inputs)).full().T)


def _with_fitted_weights(mpc: MPC, table: TransitionTable, count: int, reached: bool) -> MPC | None:
    """The MPC with the cost parameters that are nearest to the logged costs; None where there are none."""
    few = table.sample(count, 0)
    columns, centre = few.values(), table.centring.centre[: table.ny]
    scaling = Scaling.of(columns.observations, columns.actions, columns.costs, columns.next_observations, centre)
    coordinates = Coordinates(mpc, ("cost",), scaling)
    if coordinates.size == 0:
        return None
    _, logged, inputs, _ = _costs(mpc, few, reached)
    if not len(logged):  # every row ends an episode
        return None
    s, a, size = inputs[:, : mpc.nx], inputs[:, mpc.nx :], float(logged.std())
    if not size > 0.0:
        return None
    x, u, theta = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX.sym("theta", mpc.space.size)
    cost, free = mpc.stage_function(x, u, theta), np.flatnonzero(coordinates.mask).tolist()
    slopes = _by_rows(ca.Function("slopes", [x, u, theta], [ca.densify(ca.gradient(cost, theta)[free])]))
    costs = _by_rows(mpc.stage_function)

    def full(z: Array) -> Array:
        return np.asarray(coordinates.theta(torch.from_numpy(np.asarray(z))).numpy())

    def missed(theta: Array) -> Array:
        return np.asarray(logged - costs(s, a, theta)[:, 0])

    def residuals(z: Array) -> Array:
        """With the best constant for every z."""
        errors = -missed(full(z)) / size
        return np.asarray(np.nan_to_num(errors - errors.mean(), nan=1e6, posinf=1e6, neginf=-1e6))

    def jacobian(z: Array) -> Array:
        values = full(z)
        change = np.where(coordinates.logarithmic, values[coordinates.mask], coordinates.scale)
        rates = slopes(s, a, values) * change / size
        return np.asarray(np.nan_to_num(rates - rates.mean(axis=0)))

    low, high = np.minimum(coordinates.low, -1e-9), np.maximum(coordinates.high, 1e-9)
    found = scipy.optimize.least_squares(
        residuals, np.clip(coordinates.start, low, high), jac=jacobian, bounds=(low, high), max_nfev=50, xtol=1e-12
    )
    if not np.mean(found.fun**2) <= ROUNDING:
        return None
    fitted = canonical(mpc, full(found.x))
    return mpc.with_theta(with_level(mpc, fitted, float(missed(fitted).mean())))
