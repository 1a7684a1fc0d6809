"""The controller that made a log: what it costs, a clone of it, and how far models of the log agree with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.features import RandomFeatures, Ridge
from mpcoffline.estimation.small_network import Effort, SmallNetwork, fit_small_network
from mpcoffline.estimation.structure import HeldOut, clearly_negative
from mpcoffline.mpc.layout import Layout
from mpcoffline.mpc.scaling import cost_spread

from .models import LogModels
from .starts import signals_along

_ROWS = 10_000
_HIDDEN = (8, 8)
_EFFORT = Effort(rows=500, steps=25, decays=(1e-3,))
_FEWEST = 20  # rows, below which it is the mean input
_EXACT = 1e-8  # of the inputs' variance: what a linear clone misses by less needs no network
_GOOD = 0.02  # of the inputs' variance: what is missed by less needs no memory
_TINY = 1e-300
_REMEMBERS = 0.5  # of the error without memory: what a controller with memory is known by


class Past(NamedTuple):
    """What the clone knows of the step before.

    Attributes:
        y: The observation, ``(B, ny)``.
        u: The inputs, ``(B, nu)``.
    """

    y: Array
    u: Array


@dataclass(frozen=True)
class Behaviour:
    """A clone of the controller that made a log: the mean of its inputs, by regression, within those logged.

    Of the observation y alone; where that is not half as good on held-out episodes, of y, the observation before and
    the inputs before, as a PI controller acts: ``u = u_before + K_p (y - y_before) + K_i y``. Each is linear, with a
    small network beside it where held-out episodes ask for that. It is a clone of what is done on average: what is
    tried at random, and what an operator knows beyond y, are :meth:`deviations`.

    Attributes:
        share: Share of the variance of the inputs on held-out episodes that it explains; 1 where they never vary.
        remembers: Whether it depends on the step before.
    """

    share: float
    remembers: bool
    _ny: int
    _bounds: tuple[Array, Array]
    _at_first: Callable[[Array], Array]
    _later: Callable[[Array], Array]

    @classmethod
    def of(cls, table: TransitionTable, layout: Layout, seed: int = 0) -> Behaviour:
        """Learns it from a log.

        Args:
            table: The transitions as they were logged, noise included: that is what the controller saw. States of the
                MPC or observations.
            layout: What the MPC's state is made of.
            seed: Seeds split and networks.
        """
        columns, ny = table.values(), layout.ny
        y, u = columns.observations[:, :ny], columns.actions
        bounds = u.min(axis=0), u.max(axis=0)
        second = np.flatnonzero(np.diff(table.episode_ids) == 0) + 1  # rows with one before
        if len(second) > _ROWS:
            second = np.sort(np.random.default_rng(seed).permutation(second)[:_ROWS])
        mean, constant = u.mean(axis=0), bool((bounds[0] == bounds[1]).all())
        if len(second) < _FEWEST or constant:

            def always(at: Array) -> Array:
                return np.tile(mean, (len(at), 1))

            return cls(float(constant), False, ny, bounds, always, always)
        ids, past = table.episode_ids[second], np.hstack([y[second], y[second - 1], u[second - 1]])
        plain, missed = _regression(y[second], u[second], ids, bounds, seed)
        held_out = HeldOut.of(ids, seed).rows
        variance = max(float(np.mean(_per_row((u[second] - u[second].mean(axis=0))[held_out], u[second]))), _TINY)
        if np.mean(missed) <= _GOOD * variance:
            return cls(1.0 - float(np.mean(missed)) / variance, False, ny, bounds, plain, plain)
        full, missed_less = _regression(past, u[second], ids, bounds, seed)
        better = clearly_negative(missed_less - _REMEMBERS * missed, ids[held_out])
        left = float(np.mean(missed_less if better else missed)) / variance
        return cls(1.0 - left, better, ny, bounds, plain, full if better else plain)

    def predict(self, observation: ArrayLike, state: Past | None = None) -> tuple[Array, Past]:
        """Inputs for observations, as :meth:`mpcoffline.MPCPolicy.predict`.

        Args:
            observation: ``(B, ny)`` or ``(ny,)``.
            state: What the call before returned; None at first.

        Returns:
            Inputs ``(B, nu)`` or ``(nu,)`` within the range of those logged, and what the next call is given.
        """
        given = np.asarray(observation, dtype=np.float64)
        y = np.atleast_2d(given)
        u = self._inputs(y, state)
        return (u if given.ndim == 2 else u[0]), Past(y, u)

    def deviations(self, table: TransitionTable, rows: NDArray[np.intp], n_steps: int) -> Array:
        """What was done beside what the clone does, in the steps from some rows on: 0 after the end of an episode.

        Args:
            table: The transitions as they were logged.
            rows: Where the stretches begin, ``(s,)``.
            n_steps: Their length.

        Returns:
            ``(s, n_steps, nu)``.
        """
        steps, goes_on = stretches(table, rows, n_steps)
        columns, state = table.values(), None
        found = np.zeros((*steps.shape, table.nu))
        for k in range(n_steps):
            y, u = columns.observations[steps[:, k], : self._ny], columns.actions[steps[:, k]]
            found[:, k] = u - self._inputs(y, state)
            state = Past(y, u)
        return np.where(goes_on[:, :, None], found, 0.0)

    def replaying(self, deviations: Array) -> Replaying:
        """The clone with deviations ``(s, n_steps, nu)`` on top: what was logged, where the state is as it was."""
        return Replaying(self, deviations)

    def _inputs(self, y: Array, before: Past | None) -> Array:
        y = y[:, : self._ny]
        found = self._at_first(y) if before is None else self._later(np.hstack([y, *before]) if self.remembers else y)
        return np.clip(found, *self._bounds)


class Replaying:
    """A :class:`Behaviour` with its logged deviations, for batches that are members times starts.

    Args:
        behaviour: The clone.
        deviations: What is added in each step, ``(s, n_steps, nu)``; nothing after the last.
    """

    def __init__(self, behaviour: Behaviour, deviations: Array) -> None:
        self._behaviour, self._deviations = behaviour, deviations

    def predict(self, observation: ArrayLike, state: tuple[int, Past] | None = None) -> tuple[Array, tuple[int, Past]]:
        """Inputs for observations ``(m s, ny)``, the starts of the first member first; see :class:`Behaviour`."""
        y = np.asarray(observation, dtype=np.float64)
        k, past = (0, None) if state is None else state
        u, _ = self._behaviour.predict(y, past)
        if k < self._deviations.shape[1]:
            u = u + np.tile(self._deviations[:, k], (len(y) // len(self._deviations), 1))
        u = np.clip(u, *self._behaviour._bounds)
        return u, (k + 1, Past(y, u))


class Agreement(NamedTuple):
    """Whether models of a log reproduce what it cost, the clone acting as the log's controller did.

    Attributes:
        simulated: Cost of the episodes on each model, undiscounted, ``(m, s)``.
        logged: What they cost in the log, ``(s,)``.
        unit: Spread of the stage cost times the steps.
    """

    simulated: Array
    logged: Array
    unit: float

    @property
    def deviations(self) -> Array:
        """Mean difference simulated - logged in spreads of the stage cost, a step, ``(m,)``."""
        return np.asarray((self.simulated - self.logged).mean(axis=1) / self.unit)

    @property
    def scatters(self) -> Array:
        """Root mean square of the differences, likewise: one episode's cost is predicted so well, ``(m,)``."""
        return np.asarray(np.sqrt(np.mean((self.simulated - self.logged) ** 2, axis=1)) / self.unit)


def agreement(
    models: LogModels,
    cost: Callable[[Array, Array, Array], Array],
    table: TransitionTable,
    policy: Any,
    rows: NDArray[np.intp],
    n_steps: int,
    paid: Callable[[Array], Array] | None = None,
) -> Agreement:
    """Simulates the controller of the log on the models, from its own states, and compares the costs.

    Nothing is replayed that a model misses; then all of them would agree with the log.

    Args:
        models: The models.
        cost: The stage cost of states ``(B, nx)``, inputs ``(B, nu)`` and states reached ``(B, nx)``, ``(B,)``.
        table: The transitions of the MPC's states.
        policy: What acts, :meth:`Behaviour.replaying` of these rows and steps.
        rows: Starts, ``(s,)``.
        n_steps: Steps; fewer where an episode ends before.
        paid: What the step that ends an episode costs more, by the states that it reaches ``(B, nx)``; nothing by
            default.
    """
    layout, columns = models.layout, table.values()
    steps, goes_on = stretches(table, rows, n_steps)
    signals, outside = signals_along(table, rows, n_steps, layout), slice(layout.n_states, layout.ny)
    x = np.broadcast_to(columns.observations[rows], (len(models), len(rows), table.ny))
    simulated, state = np.zeros(x.shape[:2]), None
    dearest = float(columns.costs.max())
    for k in range(n_steps):
        u, state = policy.predict(x[:, :, : layout.ny].reshape(-1, layout.ny), state)
        reached = models.step(x, u.reshape(*simulated.shape, -1))
        following = np.where(np.isfinite(reached), reached, x)
        following[:, :, outside] = signals[:, k]
        stage = cost(x.reshape(-1, table.ny), u, following.reshape(-1, table.ny)).reshape(simulated.shape)
        simulated += np.where(goes_on[:, k], np.nan_to_num(stage, nan=dearest, posinf=dearest), 0.0)
        ends = np.flatnonzero(goes_on[:, k] & (columns.terminations[steps[:, k]] > 0.0))
        if paid is not None and len(ends):
            simulated[:, ends] += paid(following[:, ends].reshape(-1, table.ny)).reshape(len(models), -1)
        x = following
    logged = np.where(goes_on, columns.costs[steps], 0.0).sum(axis=1)
    return Agreement(simulated, logged, cost_spread(columns.costs) * float(goes_on.sum(axis=1).mean()))


class Returns(NamedTuple):
    """What the episodes of a log cost, undiscounted.

    Attributes:
        costs: Of each episode, ``(E,)``.
        steps: Its length, ``(E,)``.
    """

    costs: Array
    steps: NDArray[np.intp]

    @classmethod
    def of(cls, table: TransitionTable) -> Returns:
        """Those of a table."""
        _, firsts, lengths = table.episodes
        order = np.argsort(firsts)
        costs = np.add.reduceat(table.costs.astype(np.float64), firsts[order])
        return cls(costs, lengths[order])

    @property
    def per_step(self) -> tuple[float, float]:
        """Mean cost of a step, and its standard error from episode to episode; NaN for one episode."""
        mean, n = float(self.costs.sum() / self.steps.sum()), len(self.costs)
        missed = self.costs - mean * self.steps
        return mean, float(np.sqrt(n / (n - 1) * np.sum(missed**2)) / self.steps.sum()) if n > 1 else float("nan")


def stretches(
    table: TransitionTable, rows: NDArray[np.intp], n_steps: int
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The rows from some rows on, and where they are of the same episode still, ``(s, n_steps)`` each."""
    first = np.asarray(rows)[:, None]
    steps = first + np.arange(n_steps)
    inside = np.minimum(steps, len(table) - 1)
    return inside, (steps < len(table)) & (table.episode_ids[inside] == table.episode_ids[first])


def _per_row(missed: Array, u: Array) -> Array:
    """Mean square over the inputs, each in its spread, ``(n,)``."""
    spread = u.std(axis=0)
    moves = spread > 0.0
    return np.asarray(np.mean((missed[:, moves] / spread[moves]) ** 2, axis=1))


def _regression(
    x: Array, u: Array, episodes: NDArray[np.integer[Any]], bounds: tuple[Array, Array], seed: int
) -> tuple[Callable[[Array], Array], Array]:
    """Inputs u ``(n, nu)`` as a function of x ``(n, d)``, and its squared errors on held-out rows."""
    held_out, moves = HeldOut.of(episodes, seed).rows, np.flatnonzero(bounds[0] < bounds[1])
    features = RandomFeatures(x[~held_out], 0, np.random.default_rng(seed), multiplied=0)
    ridge = Ridge.fit(features(x[~held_out]), u[~held_out])

    def linear(at: Array) -> Array:
        return ridge(features(at))

    left = (u - linear(x))[:, moves]
    parts = ((x[part], left[part]) for part in (~held_out, held_out))
    network: SmallNetwork | None = None
    if float(np.mean(_per_row(u - linear(x), u))) > _EXACT:
        drawn = int(np.random.default_rng(seed).integers(2**31))
        network = fit_small_network(next(parts), next(parts), _HIDDEN, drawn, _EFFORT)

    def both(at: Array) -> Array:
        found = linear(at)
        if network is not None:
            found[:, moves] += network(at)
        return found

    missed = [_per_row(np.clip(f(x[held_out]), *bounds) - u[held_out], u) for f in (linear, both)]
    if network is not None and clearly_negative(missed[1] - missed[0], episodes[held_out]):
        return both, missed[1]
    return linear, missed[0]
