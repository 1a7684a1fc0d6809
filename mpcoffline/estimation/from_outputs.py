"""Model and states from logs that hold outputs in place of states."""

from __future__ import annotations

import copy
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import torch
from numpy.typing import ArrayLike

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC
from mpcoffline.mpc.coordinates import Coordinates, canonical
from mpcoffline.mpc.labels import Label
from mpcoffline.mpc.outputs import Outputs
from mpcoffline.mpc.scaling import Scaling

from .observer import KalmanObserver, OutputModel
from .output_delays import Fit, search_delays
from .output_episodes import (
    OutputEpisodes,
    OutputPoint,
    filtered_outputs,
    missed_ahead,
    output_episodes,
    smoothed_states,
    with_states,
)
from .sensors import Sensors, listed, steps_late

_log = logging.getLogger(__name__)

_ROWS = 2_000  # that parameters are searched on
_LONGEST = 100  # steps of a stretch there
_ROWS_A_NUMBER = 3  # that are the least to learn it from
_STARTS, _FIRST_ITERATIONS = 3, 10
_SCORINGS = 100  # steps of Fisher's scoring at the end, at most
_SHORTER = 2.0 ** -np.arange(8)  # what of a step is tried
_DONE = 0.03  # by how much the logarithm falls at the end
_AWAY = 0.7  # standard deviation of the starts, in logarithms or scaled coordinates
_PROCESS = 0.01  # of the spread of starts: what the model is first taken to miss in a step
_WIDTHS = {"parameters": 2.0, "noise": 3.0, "process": 3.0, "start": 1.0}  # of the priors
_FARTHEST = 10.0  # logarithms of noise from where it begins: beyond, numbers end
_STEP = 1e-4  # of differences
_UNKNOWN = 0.5  # of the prior's standard deviation: what is left so wide was not told by the log
AHEAD = 15  #: Steps, as models of the log are judged by.
NOTHING = 0.7  #: Of what outputs move, missed: such a model says little more than that they stay.
_SAYS_NOTHING = (
    "That is hardly better than to say that they stay: the model's structure may be wrong, an input unknown, or they"
    " move little more than their noise."
)
SEEN = 0.5  #: Share of a state's variance that outputs have to remove.


@dataclass(frozen=True)
class OutputIdentification:
    """What outputs say of plant, noise and states.

    Attributes:
        mpc: The MPC with the identified model.
        sensors: Outputs, their noise, what the model misses, where episodes begin; and of which parameters and states
            the log hardly says anything: these stay near what was given.
        names: Names of the parameters that were learned, ``(p,)``.
        deviations: Their standard deviations, ``(p,)``; infinite for one of which nothing is known.
        seen: Share of each state's variance that outputs remove, of what there would be without them, ``(n_states,)``.
        missed: How far each output is from what was predicted 15 steps before, in what it moves in these,
            ``(n_outputs,)``; NaN where no episode is that long.
        table: The log with smoothed states in place of outputs: what a learner takes.
    """

    mpc: MPC
    sensors: Sensors
    names: tuple[str, ...]
    deviations: Array
    seen: Array
    missed: Array
    table: TransitionTable

    def __str__(self) -> str:
        """What was found, in sentences."""
        said = f"{self.sensors} {self._late()}Their model misses {listed(self.sensors.process)} a step."
        if np.isfinite(self.missed).all():
            said += f" {AHEAD} steps ahead, outputs are missed by {listed(100.0 * self.missed)} % of what they move."
        return f"{said} {_SAYS_NOTHING}" if (self.missed > NOTHING).any() else said

    def _late(self) -> str:
        delay = self.mpc.layout.delay
        return f"Inputs act {steps_late(delay)}. " if any(delay) else ""


def identify_from_outputs(
    mpc: MPC,
    log: TransitionTable,
    outputs: Outputs,
    *,
    start: ArrayLike | None = None,
    start_spread: ArrayLike,
    labels: Sequence[Label] = (),
    late: Sequence[bool] | None = None,
    seed: int = 0,
) -> OutputIdentification:
    """Model parameters, noise and states from a log of outputs, by the largest likelihood of its innovations.

    An extended Kalman filter runs over the log; theta, the noise of the outputs, what the model misses, and the mean of
    the starts are where its innovations e with covariances S are likeliest, with wide priors about what was given::

        sum_k e_k' S_k^-1 e_k + log det S_k   (Ljung, "System Identification", 2nd ed., 1999, section 7.4)

    from several starts, on about 2,000 rows: by quasi-Newton steps first, then by Fisher's scoring. The states of
    the table are smoothed with what was found (Rauch, Tung, Striebel), so that
    :class:`~mpcoffline.OfflineMPCLearner` takes it like any log.

    Example:
        >>> found = identify_from_outputs(mpc, log, [0], start_spread=[1.0, 0.5])
        >>> learner.fit(found)
        >>> action, state = learner.output_policy.predict(y)

    Args:
        mpc: Its model is the one to identify.
        log: Transitions whose observations are the outputs, then the signals, if the plant has some.
        outputs: Which states are measured, or a function of them; of two arguments x, u, also of the inputs that acted
            in the step before (:class:`KalmanObserver`).
        start: Mean of the states where episodes begin, as far as is known, ``(n_states,)``; where an output is a state,
            the log's own mean goes before it. At rest by default.
        start_spread: How far they are from that, standard deviation, ``(n_states,)``: the scale of states that nobody
            has measured.
        labels: What the outputs are called, as :class:`KalmanObserver` takes them.
        late: Which inputs may act later than the MPC says, ``(nu,)``: their dead time is looked for; none by default.
        seed: Picks rows and starts.

    Raises:
        InvalidArgumentError: For outputs of another number than the log's, or what :class:`KalmanObserver` refuses.
        InvalidDataError: If an output never moves, rows are few, or episodes too short to see a state in them.
    """
    given = KalmanObserver(mpc, outputs, 1.0, 0.0, start=start, start_spread=start_spread, labels=labels)
    data = output_episodes(mpc, log, given.n_outputs)
    start, spread = _first_start(given, data), given.start_spread
    model = OutputModel(mpc, outputs)
    search = _Search(mpc, model, data.some(_ROWS, _LONGEST, seed), start, spread, log)
    if len(log) < _ROWS_A_NUMBER * search.size:
        expected = f"{_ROWS_A_NUMBER * search.size} rows at least, to find {search.size} numbers in"
        raise InvalidDataError("log", expected=expected, actual=str(len(log)))
    v = search.best(seed)
    if any(late or ()) or any(mpc.layout.delay):
        mpc, data, search, v = _with_delay(mpc, late or (), search, log, v, seed)
    found, curvature = search.found(v), search.curvature(v)
    p = search.coordinates.size
    variances = np.diag(np.linalg.pinv(curvature))[:p]
    wide = np.sqrt(np.where(variances > 0.0, variances, np.inf))  # no minimum along it: nothing is known
    names = tuple(n for n, learned in zip(mpc.space.names, search.coordinates.mask, strict=True) if learned)
    unknown = [n for n, d in zip(names, wide, strict=True) if d > _UNKNOWN * _WIDTHS["parameters"]]
    identified = mpc.with_theta(canonical(mpc, found.theta))
    states, seen = smoothed_states(model, data, found, given.start_spread)
    unknown += [f"{mpc.layout.y_labels[i]} (a state)" for i in np.flatnonzero(seen < SEEN)]
    parts = found.noise, found.process, found.start, given.start_spread
    sensors = Sensors(model.function, *parts, undetermined=tuple(unknown), labels=given.labels)
    values = identified.theta[search.coordinates.mask]
    deviations = wide * np.where(search.coordinates.logarithmic, values, search.coordinates.scale)
    table = with_states(log, states, data, model.n_outputs)
    missed = missed_ahead(model, data, found, given.start_spread, AHEAD)
    result = OutputIdentification(identified, sensors, names, deviations, seen, missed, table)
    (_log.warning if unknown or (missed > NOTHING).any() else _log.info)("%s", result)
    return result


def missed_of(mpc: MPC, sensors: Sensors, log: TransitionTable) -> Array:
    """How far an MPC's model misses outputs 15 steps ahead, as :attr:`OutputIdentification.missed`, on some rows.

    Args:
        mpc: Its model may be a rough one.
        sensors: Outputs and noise; suited to the model (:meth:`Sensors.suited`).
        log: Transitions of outputs.
    """
    data = output_episodes(mpc, log, sensors.n_outputs).some(_ROWS, _LONGEST, 0)
    known = OutputPoint(mpc.theta, sensors.noise, sensors.process, sensors.start)
    return missed_ahead(OutputModel(mpc, sensors.outputs), data, known, sensors.start_spread, AHEAD)


class _Search:
    """The likelihood of innovations as a function of scaled coordinates v: parameters, logarithms of noise, starts.

    Args:
        mpc: The problem.
        model: What outputs are of it.
        data: The rows that it is searched on.
        start: Mean of the states where they begin.
        spread: Its uncertainty.
        log: All transitions.
    """

    def __init__(
        self, mpc: MPC, model: OutputModel, data: OutputEpisodes, start: Array, spread: Array, log: TransitionTable
    ) -> None:
        self._model, self._data, self._spread = model, data, spread
        noise = _first_noise(data)
        self._first = OutputPoint(mpc.theta, noise, np.maximum(_PROCESS * spread, np.finfo(np.float64).tiny), start)
        x = np.stack([step.known.x for step in filtered_outputs(model, data, self._first, spread)])
        valid = np.arange(len(data.acting))[:, None] < data.lengths
        steps = x[:-1][valid], data.acting[valid][:, : mpc.nu], x[1:][valid]
        scaling = Scaling.of(steps[0], steps[1], log.values().costs, steps[2])
        self.coordinates = Coordinates(mpc, ("model",), scaling)
        parts = {"parameters": self.coordinates.size, "noise": len(noise), "process": len(spread), "start": len(spread)}
        self._widths = np.concatenate([np.full(n, _WIDTHS[name]) for name, n in parts.items()])
        self._ends = np.cumsum(list(parts.values()))[:-1]
        free = np.repeat([_FARTHEST, np.inf], [len(noise) + len(spread), len(spread)])
        self._bounds = scipy.optimize.Bounds(
            np.append(self.coordinates.low, -free), np.append(self.coordinates.high, free)
        )

    @property
    def n_outputs(self) -> int:
        """How many outputs there are."""
        return self._model.n_outputs

    @property
    def size(self) -> int:
        """How many coordinates there are."""
        return len(self._widths)

    def missed(self, v: Array) -> Array:
        """How far outputs are missed some steps ahead, see :func:`missed_ahead`."""
        return missed_ahead(self._model, self._data, self.found(v), self._spread, AHEAD)

    def found(self, v: Array) -> OutputPoint:
        """What a point ``(..., size)`` is in units."""
        z, noise, process, start = np.split(v, self._ends, axis=-1)
        theta = self.coordinates.theta(torch.from_numpy(np.ascontiguousarray(z))).numpy()
        first = self._first
        return OutputPoint(
            theta, first.noise * np.exp(noise), first.process * np.exp(process), first.start + self._spread * start
        )

    def loss(self, v: Array) -> Array:
        """Minus the logarithm of the posterior at points ``(m, size)``, ``(m,)``: all are filtered side by side."""
        loss = 0.5 * np.sum((v / self._widths) ** 2, axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            for step in filtered_outputs(self._model, self._data, self.found(v[:, None, :]), self._spread):
                loss = loss + step.evidence.reshape(len(v), -1).sum(axis=1)
        return np.asarray(np.nan_to_num(loss, nan=1e12, posinf=1e12))

    def _slopes(self, v: Array) -> tuple[Array, Array]:
        """The loss's slope at v, and its second derivative as a true model has it on average: Fisher's information.

        ::

            H_ij = sum_k (de/dv_i de/dv_j) / S + (dS/dv_i dS/dv_j) / (2 S^2) + prior,    the derivatives by differences
        """
        n = len(v)
        points = np.vstack([v + _STEP * np.eye(n), v - _STEP * np.eye(n)])
        slope, H = v / self._widths**2, np.diag(self._widths**-2.0)
        with np.errstate(over="ignore", invalid="ignore"):
            for step in filtered_outputs(self._model, self._data, self.found(points[:, None, :]), self._spread):
                e, log_S, evidence = (part.reshape(2, n, -1) for part in (step.e, np.log(step.S), step.evidence))
                slope = slope + (evidence[0] - evidence[1]).sum(axis=1) / (2.0 * _STEP)
                deviation = np.exp(0.5 * log_S.mean(axis=(0, 1)))
                de, dS = ((part[0] - part[1]) / (2.0 * _STEP) for part in (e / deviation, log_S))
                H = H + de @ de.T + 0.5 * dS @ dS.T
        return slope, H

    def _with_slope(self, v: Array) -> tuple[float, Array]:
        steps = _STEP * np.eye(len(v))
        inward = np.where(v + _STEP > self._bounds.ub, -1.0, 1.0)
        values = self.loss(np.vstack([v, v + inward[:, None] * steps]))
        return float(values[0]), inward * (values[1:] - values[0]) / _STEP

    def best(self, seed: int) -> Array:
        """The likeliest point, from several starts."""
        rng, size = np.random.default_rng(seed), len(self._widths)
        away = np.concatenate([np.full(self.coordinates.size, _AWAY), np.zeros(size - self.coordinates.size)])
        starts = [np.zeros(size), *(away * rng.standard_normal(size) for _ in range(_STARTS - 1))]
        starts[0][: self.coordinates.size] = self.coordinates.start
        tried = [self.descended(np.clip(v, self._bounds.lb, self._bounds.ub), _FIRST_ITERATIONS) for v in starts]
        return self.settled(min(tried, key=lambda each: each[1])[0])

    def settled(self, v: Array) -> Array:
        """The minimum near v by Fisher's scoring, also along narrow valleys, where parameters are told apart by little.

        Coordinates at a bound that lead beyond it stay there.
        """
        value = float(self.loss(v[None])[0])
        for _ in range(_SCORINGS):
            slope, H = self._slopes(v)
            if not (np.isfinite(slope).all() and np.isfinite(H).all()):
                break
            held = ((v <= self._bounds.lb) & (slope > 0.0)) | ((v >= self._bounds.ub) & (slope < 0.0))
            step = np.zeros_like(v)
            step[~held] = -np.linalg.solve(H[np.ix_(~held, ~held)], slope[~held])
            points = np.clip(v + _SHORTER[:, None] * step, self._bounds.lb, self._bounds.ub)
            losses = self.loss(points)
            best = int(np.argmin(losses))
            fallen = value - float(losses[best])
            if fallen > 0.0:
                v, value = points[best], float(losses[best])
            if not fallen > _DONE:
                break
        return v

    def on(self, data: OutputEpisodes) -> _Search:
        """The same on other rows."""
        other = copy.copy(self)
        other._data = data
        return other

    def descended(self, v: Array, iterations: int) -> tuple[Array, float]:
        """Some way down from a point: where, and the loss there."""
        done = scipy.optimize.minimize(
            self._with_slope, v, jac=True, method="L-BFGS-B", bounds=self._bounds, options={"maxiter": iterations}
        )
        return np.asarray(done.x), float(done.fun)

    def curvature(self, v: Array) -> Array:
        """The second derivative of the loss there, ``(size, size)``, by differences.

        ::

            2 h^2 H_ij = g(i + j) - g(i) - g(j),    g(a) = f(v + h a) - 2 f(v) + f(v - h a)
        """
        step, n = 10.0 * _STEP, len(v)
        e, (rows, columns) = step * np.eye(n), np.triu_indices(n, 1)
        away = np.vstack([np.zeros(n), e, e[rows] + e[columns]])
        points = np.vstack([v + away, v - away[1:]])
        values = np.concatenate([self.loss(part) for part in np.array_split(points, -(-len(points) // (4 * n)))])
        ahead, behind = values[: len(away)], np.append(values[0], values[len(away) :])
        g = ahead + behind - 2.0 * values[0]
        found = np.diag(g[1 : n + 1])
        found[rows, columns] = found[columns, rows] = (g[n + 1 :] - g[1 + rows] - g[1 + columns]) / 2.0
        return np.asarray(found / step**2)


def _with_delay(
    mpc: MPC, late: Sequence[bool], search: _Search, log: TransitionTable, v: Array, seed: int
) -> tuple[MPC, OutputEpisodes, _Search, Array]:
    """The MPC with the dead time of the log, its episodes, the search on them, and the likeliest point.

    What was applied before an episode, and acts in it, is taken for what makes outputs likelier.
    """
    tried = {}

    def fitted(delay: tuple[int, ...], point: Array | None) -> Fit:
        begin, each = v if point is None else point, []
        for held in (False, True)[: 1 + any(delay)]:
            data = output_episodes(mpc.with_delay(delay), log, search.n_outputs, held=held)
            each.append((data, search.on(data.some(_ROWS, _LONGEST, seed))))
        losses = [float(own.loss(begin[None])[0]) for _, own in each]
        chosen = int(np.argmin(losses))
        own, at, loss = each[chosen][1], begin, losses[chosen]
        if point is not None or chosen:
            at, loss = own.descended(begin, _FIRST_ITERATIONS)
        tried[delay] = each[chosen]
        return Fit(loss, at, float(np.sqrt(np.mean(own.missed(at) ** 2))))

    delay, best = search_delays(mpc, late, int(log.episodes.lengths.max()), fitted)
    data, own = tried[delay]
    return mpc.with_delay(delay), data, own, v if np.array_equal(best.point, v) else own.settled(best.point)


def _first_start(given: KalmanObserver, data: OutputEpisodes) -> Array:
    """The mean of the starts, of states that are measured as the log has it."""
    h, start, outputs = given.function, given.start.copy(), data.y[0].mean(axis=0)
    by_states, *_ = h.jacobian().call([start, *(np.zeros(h.numel_in(i)) for i in range(1, h.n_in())), 0])
    for k, row in enumerate(np.asarray(by_states.full())):
        if np.count_nonzero(row) == 1 and row.max() == 1.0 and not given.feedthrough[k]:
            start[int(np.argmax(row))] = outputs[k]
    return start


def _first_noise(data: OutputEpisodes) -> Array:
    """What the second differences of outputs say of their noise: for a smooth motion all of it."""
    second = np.diff(data.y, n=2, axis=0)
    spread = np.nanstd(data.y, axis=(0, 1))
    rough = np.nanstd(second, axis=(0, 1)) / np.sqrt(6.0) if len(second) else 0.1 * spread
    return np.asarray(np.maximum(rough, 1e-3 * spread))
