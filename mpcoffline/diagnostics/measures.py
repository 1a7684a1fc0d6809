"""What the data say about a fit without simulating it: regression errors, support, lag, bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.spatial
import scipy.stats
import torch

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.memory import rows_before
from mpcoffline.datasets.table.transitions import Columns, TransitionTable
from mpcoffline.estimation.features import RandomFeatures, Ridge
from mpcoffline.learning import FitResult, ValueFunction
from mpcoffline.learning.bellman.equation import BellmanProblem
from mpcoffline.mpc import MPC, QuadraticCost
from mpcoffline.mpc.coordinates import Coordinates
from mpcoffline.mpc.scaling import Scaling, cost_spread, increments_scale, spread_of

_ROWS = 10_000
_TREE_ROWS = 5_000
_MOST_EPISODES = 200
_TAIL = 0.05  # share of a discounted return that may lie beyond the episode's end
_REGIONS = 4
_NEAR = 0.25  # spreads of the data: a state this close to the reference has reached it
_SCARCE = 1e-3
_WEIGHED = 1e-4  # of the largest weight: less is none
_BLIND = 0.3  # correlation of V with returns below which it may not have been learned,
_BLINDER = 0.2  # if a regression of the returns does better by this
_LAGS = 6  # steps before the present that are looked at, fewer where episodes are short
_LAG_FEATURES = 100
_MUCH_LAG = 0.05  # of the effect of the present input


@dataclass(frozen=True)
class ValueCheck:
    """V_phi against discounted Monte-Carlo returns of the last episodes.

    The returns are those of the policies that made the log, V an estimate of the best that can be done: a V somewhat
    below the returns is right, a V above them or without correlation is not.

    Attributes:
        n: Returns compared; 0 where no episode is long enough for the discount.
        correlation: Spearman's rank correlation.
        bias: Mean of V minus return, in standard deviations of the returns.
        above: Share of the states where V exceeds the return by more than a standard deviation.
        attainable: Correlation of a regression on the state, with returns of other episodes: where what happens does
            not follow from the state (unmeasured disturbances), no V correlates.
    """

    n: int
    correlation: float
    bias: float
    above: float
    attainable: float

    @property
    def blind(self) -> bool:
        """Whether V does not follow returns that follow from the state."""
        return self.n > 0 and self.correlation < min(_BLIND, self.attainable - _BLINDER)


@dataclass(frozen=True)
class RegionError:
    """The regression error of (FIT) in one part of the data, in units of the cost's variance.

    A constant that the error has in all data does not count: it is a constant of the cost, which changes no input.

    Attributes:
        name: The part, by quantiles of V.
        before: With the nominal MPC's model and cost.
        after: With the learned ones.
    """

    name: str
    before: float
    after: float


@dataclass(frozen=True)
class LagCheck:
    """Whether one-step errors of the identified model depend on past inputs, beside state and present input.

    Attributes:
        share: Spread of what past inputs explain, relative to the spread of the present input's effect.
        p_value: Of no dependence.
    """

    share: float
    p_value: float

    @property
    def found(self) -> bool:
        """Whether inputs act late, by a share that matters."""
        return self.share > _MUCH_LAG and self.p_value < 1e-6


@dataclass(frozen=True)
class GoalCheck:
    """How near the log comes to the goal.

    Attributes:
        share: Share of the logged states within a quarter of a spread of it, in each direction that the cost weighs.
        outside: Whether the goal is farther from the logged states than 99 % of them are from each other.
    """

    share: float
    outside: bool

    @property
    def missed(self) -> bool:
        """Whether the log says nothing of the goal."""
        return self.outside and self.share < _SCARCE


def returns_of(value: ValueFunction, table: TransitionTable, discount: float) -> tuple[Array, Array]:
    """V and the measured return of states of the last tenth of the episodes (200 at most), ``(n,)`` each."""
    observations, returns, _ = _measured(table, discount)
    return value.predict(observations), returns


def _measured(table: TransitionTable, discount: float) -> tuple[Array, Array, Array]:
    """States of the last tenth of the episodes, the return measured from each, and the number of its episode.

    Only where nearly all of a discounted return lies within its episode.

    Args:
        table: The transitions.
        discount: gamma.
    """
    needed = int(np.ceil(np.log(_TAIL) / np.log(discount))) if discount < 1.0 else len(table)
    episodes, n_episodes = table.episodes, table.n_episodes
    observations, returns, numbers = [], [], []
    for k in range(n_episodes - min(max(1, n_episodes // 10), _MOST_EPISODES), n_episodes):
        episode = table.take(episodes.rows(k))
        costs, ended = episode.costs.astype(np.float64), episode.terminations[-1] > 0.0
        total = np.zeros(len(episode) + 1)
        for t in range(len(episode) - 1, -1, -1):
            total[t] = costs[t] + discount * total[t + 1]
        complete = len(episode) if ended else max(0, len(episode) - needed)
        observations.append(episode.observations[:complete])
        returns.append(total[:complete])
        numbers.append(np.full(complete, k))
    return np.concatenate(observations), np.concatenate(returns), np.concatenate(numbers)


def value_check(value: ValueFunction, table: TransitionTable, discount: float) -> ValueCheck:
    """V against measured returns; see :func:`returns_of`."""
    observations, measured, episodes = _measured(table, discount)
    predicted = value.predict(observations)
    if len(measured) < 10 or measured.std() == 0.0:
        return ValueCheck(0, np.nan, np.nan, np.nan, np.nan)
    difference = (predicted - measured) / measured.std()
    return ValueCheck(
        len(measured),
        _correlation(predicted, measured),
        float(difference.mean()),
        float(np.mean(difference > 1.0)),
        _attainable(observations.astype(np.float64), measured, episodes),
    )


def _correlation(first: Array, second: Array) -> float:
    """Spearman's; 0 where one of them does not vary."""
    varied = np.ptp(first) > 0.0 and np.ptp(second) > 0.0
    return float(scipy.stats.spearmanr(first, second).statistic) if varied else 0.0


def _attainable(states: Array, returns: Array, episodes: Array) -> float:
    """Correlation of returns with a regression on the state, quadratic with random features, of other episodes."""
    later = episodes >= np.median(episodes)
    if later.all() or not later.any():
        return 0.0
    features = RandomFeatures(states[~later], min(_LAG_FEATURES, int(np.sum(~later)) // 10), np.random.default_rng(0))
    regression = Ridge.fit(features(states[~later]), returns[~later, None] - returns[~later].mean())
    return _correlation(regression(features(states[later]))[:, 0], returns[later])


def fit_errors(
    nominal: MPC, learned: MPC, value: ValueFunction, table: TransitionTable, result: FitResult | None
) -> tuple[RegionError, ...]:
    """The regression error of (FIT) before and after, in all data and by quarters of V.

    Args:
        nominal: MPC_1; its model and cost are those before.
        learned: The learned MPC.
        value: V_phi.
        table: The transitions.
        result: What (FIT) found; its potential, if there is one, and the scale of a known cost count.
    """
    sample = table.sample(_ROWS, 0)
    columns = sample.columns(torch.from_numpy(sample.rows))
    unit, cost = cost_spread(sample.costs), None if result is None else result.cost
    before, after = (
        _residuals(BellmanProblem(mpc, value, unit, cost), mpc, columns)
        for mpc in (nominal.replace(discount=learned.discount), learned)
    )
    potential = None if result is None else result.potential
    if potential is not None:
        model = BellmanProblem(learned, value, unit)
        with torch.no_grad():
            reached = model.predicted(columns, torch.from_numpy(learned.theta))
            shaping = potential(columns.observations) - model.discounted(columns) * potential(reached)
        after = after - shaping.double().numpy()
    before, after = before - before.mean(), after - after.mean()
    values = value.predict(sample.observations)
    edges = np.quantile(values, np.linspace(0.0, 1.0, _REGIONS + 1))
    parts = {"all data": np.ones(len(values), dtype=bool)}
    for k in range(_REGIONS):
        name = ("V lowest quarter", "V second quarter", "V third quarter", "V highest quarter")[k]
        parts[name] = (values >= edges[k]) & (values <= edges[k + 1])
    return tuple(
        RegionError(name, *(float(np.mean((missed[part] / unit) ** 2)) for missed in (before, after)))
        for name, part in parts.items()
    )


def _residuals(problem: BellmanProblem, mpc: MPC, columns: Columns) -> Array:
    theta = torch.from_numpy(mpc.theta)
    with torch.no_grad():
        explained = problem.predicted_value(columns, theta) + problem.stage_cost(columns, theta)
        return np.asarray((problem.target(columns) - explained).numpy())


def outside_support(table: TransitionTable, states: Array) -> float:
    """Share of states ``(n, nx)`` farther from the data than 99 % of the data are from the rest of the data.

    By the distance to the nearest logged state, coordinates in spreads of the data.
    """
    sample = table.sample(2 * _TREE_ROWS, 1)
    scale = spread_of(sample.observations)
    order = np.random.default_rng(0).permutation(len(sample))
    half = max(1, len(sample) // 2)
    known, others = (sample.observations[order[part]] / scale for part in (slice(None, half), slice(half, None)))
    tree = scipy.spatial.cKDTree(known)
    limit = np.quantile(tree.query(others)[0], 0.99) if len(others) else np.inf
    finite = np.isfinite(states).all(axis=1)
    n_far = np.count_nonzero(~finite) + np.count_nonzero(tree.query(states[finite] / scale)[0] > limit)
    return n_far / len(states)


def predicted_states(mpc: MPC, table: TransitionTable) -> Array:
    """f_theta(s, a) on some of the data, ``(n, nx)``."""
    sample = table.sample(_TREE_ROWS, 2)
    return mpc.model(sample.observations, sample.actions)


def one_step_error(mpc: MPC, table: TransitionTable) -> float:
    """Root mean square one-step prediction error, every coordinate in the spread of its increments."""
    sample = table.sample(_ROWS, 3)
    s, reached = (v.astype(np.float64) for v in (sample.observations, sample.next_observations))
    missed = (mpc.model(s, sample.actions) - reached) / increments_scale(s, reached, table.centring.centre[: table.ny])
    missed = missed[:, : mpc.layout.n_states]
    return float(np.sqrt(np.mean(np.nan_to_num(missed, nan=1e3, posinf=1e3, neginf=-1e3) ** 2)))


def lag_check(identified: MPC, table: TransitionTable) -> LagCheck:
    """Whether the identified model's one-step errors depend on inputs of steps before, which its state does not hold.

    What a regression on state and present input (products and random features) explains is taken out first, so that a
    wrong structure is not taken for a lag; what past inputs explain beyond is tested by an F test.

    Args:
        identified: The MPC with the identified model.
        table: The transitions, smoothed where they were noisy: past inputs tell of the true state, and with it of the
            noise in the logged one.
    """
    layout, lags = identified.layout, min(_LAGS, max(1, int(np.median(table.episodes.lengths)) // 4))
    rows = np.flatnonzero(rows_before(table) >= layout.steps + lags)
    if len(rows) > _ROWS:
        rows = np.sort(np.random.default_rng(0).permutation(rows)[:_ROWS])
    if len(rows) < 50:
        return LagCheck(0.0, 1.0)
    z, u, _, reached, _ = table.take(rows).values()
    n, (x, acting) = layout.n_states, layout.split(z, u)
    scale, plant = increments_scale(x, reached[:, :n], table.centring.centre[:n]), identified.plant_function
    predicted, without = (
        np.asarray(plant(x.T, v.T, identified.theta).full().T)
        for v in (acting, np.hstack([np.broadcast_to(u.mean(axis=0), u.shape), acting[:, u.shape[1] :]]))
    )
    effect, errors = (predicted - without) / scale, (reached[:, :n] - predicted) / scale
    good = np.isfinite(errors).all(axis=1) & np.isfinite(effect).all(axis=1)
    past = np.hstack([table.take(rows - layout.steps - k).actions.astype(np.float64) for k in range(1, lags + 1)])
    present = np.hstack([z, u])
    n_random = min(_LAG_FEATURES, len(rows) // 10)
    features = RandomFeatures(present, n_random, np.random.default_rng(0))(present)[good]
    errors, past, effect = errors[good], past[good], effect[good]
    past, errors = (v - Ridge.fit(features, v)(features) for v in (past, errors))
    explained = past @ np.linalg.lstsq(past, errors, rcond=None)[0]
    degrees = len(errors) - features.shape[1] - past.shape[1]
    if degrees < 20:
        return LagCheck(0.0, 1.0)
    k = int(np.argmax(np.sum(explained**2, axis=0) / np.maximum(np.sum((errors - explained) ** 2, axis=0), 1e-300)))
    left = max(float(np.sum((errors[:, k] - explained[:, k]) ** 2)), 1e-300)
    statistic = float(np.sum(explained[:, k] ** 2)) / past.shape[1] / (left / degrees)
    size = float(np.sqrt(np.mean(effect**2)))
    share = float(np.sqrt(np.mean(explained**2))) / size if size > 0.0 else 0.0
    return LagCheck(share, float(scipy.stats.f(past.shape[1], degrees).sf(statistic)))


def goal_check(mpc: MPC, table: TransitionTable) -> GoalCheck | None:
    """Whether the log comes near the goal: where nothing that the stage cost weighs is off; None without a goal.

    Only directions in which the cost has a weight count, in spreads of what it weighs::

        e = z - x_ref, of what tracks a signal its distance from it,     |D W D| along a direction > 0,  D = diag(std e)

    Args:
        mpc: MPC_1, whose costs say where the goal is.
        table: The transitions of its states.
    """
    errors = _goal_errors(mpc, table.sample(2 * _TREE_ROWS, 5).observations.astype(np.float64))
    if errors is None or not errors.shape[1]:
        return None
    near = (np.abs(errors) < _NEAR).all(axis=1)
    order = np.random.default_rng(0).permutation(len(errors))
    half = max(1, len(errors) // 2)
    tree = scipy.spatial.cKDTree(errors[order[:half]])
    others = np.atleast_1d(tree.query(errors[order[half:]])[0])
    away = float(tree.query(np.zeros(errors.shape[1]))[0])
    return GoalCheck(float(near.mean()), bool(len(others)) and away > float(np.quantile(others, 0.99)))


def _goal_errors(mpc: MPC, states: Array) -> Array | None:
    """What is off in each weighed direction, in spreads, ``(n, k)``."""
    reference, cost = mpc.reference, mpc.stage_cost
    if reference is None:
        return None
    weight = cost.W if type(cost) is QuadraticCost else None  # in features of the state, every state counts
    target = reference if weight is None else mpc.values["stage_cost.x_ref"]
    states, at = states.copy(), dict(zip((s.name for s in mpc.layout.signals), mpc.layout.present, strict=True))
    tracks: dict[int, str] = getattr(cost, "tracks", None) or {}
    for i, name in tracks.items():
        states[:, i] -= states[:, at[name]]
    errors = states[:, : len(target)] - target
    spread = spread_of(errors)
    if weight is None:
        return np.asarray(errors / spread)
    weights, directions = np.linalg.eigh(spread[:, None] * weight * spread)
    along = (errors / spread) @ directions[:, weights > _WEIGHED * weights.max(initial=0.0)]
    return np.asarray(along / spread_of(along))


def bound_names(mpc: MPC, nominal: MPC, table: TransitionTable) -> tuple[str, ...]:
    """Parameters on a bound that were not on it before; the zeros of a matrix factor's diagonal are no bounds."""
    before, after = (dict(zip(m.space.names, m.theta, strict=True)) for m in (nominal, mpc))
    s, a, costs, reached, _ = table.sample(_ROWS, 4).values()
    scaling = Scaling.of(s, a, costs, reached, table.centring.centre[: table.ny])
    on_bounds = Coordinates(mpc, ("cost", "model"), scaling).at_bounds(mpc.theta)
    return tuple(name for name in on_bounds if before.get(name) != after[name])
