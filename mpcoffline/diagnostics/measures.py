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
from mpcoffline.mpc import MPC
from mpcoffline.mpc.coordinates import Coordinates
from mpcoffline.mpc.scaling import Scaling, cost_spread, increments_scale, spread_of

_ROWS = 10_000
_TREE_ROWS = 5_000
_MOST_EPISODES = 200
_TAIL = 0.05  # share of a discounted return that may lie beyond the episode's end
_REGIONS = 4
_NEAR = 0.25  # spreads of the data: a state this close to the reference has reached it
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
    """

    n: int
    correlation: float
    bias: float
    above: float


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


def returns_of(value: ValueFunction, table: TransitionTable, discount: float) -> tuple[Array, Array]:
    """V and the measured return of states of the last tenth of the episodes (200 at most), ``(n,)`` each.

    Only where nearly all of a discounted return lies within its episode.

    Args:
        value: V_phi.
        table: The transitions.
        discount: gamma.
    """
    needed = int(np.ceil(np.log(_TAIL) / np.log(discount))) if discount < 1.0 else len(table)
    episodes, n_episodes = table.episodes, table.n_episodes
    observations, returns = [], []
    for k in range(n_episodes - min(max(1, n_episodes // 10), _MOST_EPISODES), n_episodes):
        episode = table.take(episodes.rows(k))
        costs, ended = episode.costs.astype(np.float64), episode.terminations[-1] > 0.0
        total = np.zeros(len(episode) + 1)
        for t in range(len(episode) - 1, -1, -1):
            total[t] = costs[t] + discount * total[t + 1]
        complete = len(episode) if ended else max(0, len(episode) - needed)
        observations.append(episode.observations[:complete])
        returns.append(total[:complete])
    return value.predict(np.concatenate(observations)), np.concatenate(returns)


def value_check(value: ValueFunction, table: TransitionTable, discount: float) -> ValueCheck:
    """V against measured returns; see :func:`returns_of`."""
    predicted, measured = returns_of(value, table, discount)
    if len(measured) < 10 or measured.std() == 0.0:
        return ValueCheck(0, np.nan, np.nan, np.nan)
    difference = (predicted - measured) / measured.std()
    correlation = scipy.stats.spearmanr(predicted, measured).statistic
    return ValueCheck(len(measured), float(correlation), float(difference.mean()), float(np.mean(difference > 1.0)))


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


def goal_share(table: TransitionTable, reference: Array) -> float:
    """Share of the logged states within a quarter of the data's spread of the reference, in every coordinate."""
    states = table.observations[:, : len(reference)]
    return float(np.mean((np.abs(states - reference) < _NEAR * spread_of(states)).all(axis=1)))


def bound_names(mpc: MPC, nominal: MPC, table: TransitionTable) -> tuple[str, ...]:
    """Parameters on a bound that were not on it before; the zeros of a matrix factor's diagonal are no bounds."""
    before, after = (dict(zip(m.space.names, m.theta, strict=True)) for m in (nominal, mpc))
    s, a, costs, reached, _ = table.sample(_ROWS, 4).values()
    scaling = Scaling.of(s, a, costs, reached, table.centring.centre[: table.ny])
    on_bounds = Coordinates(mpc, ("cost", "model"), scaling).at_bounds(mpc.theta)
    return tuple(name for name in on_bounds if before.get(name) != after[name])
