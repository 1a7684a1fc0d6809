"""Measurement noise: how much there is in the data, and the data without it.

With errors in s as well as in s+, one-step regression is biased (errors in variables): towards models that damp, and,
worse, towards stage costs that fit the noise. A smoother with the identified model removes most of the noise first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.checks import check_number
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.memory import with_plant_states
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

from .identification import identify_one_step
from .kalman import Linearised, filtered, smoothed
from .plant import plant_rows, state_rows
from .trajectories import Trajectories

#: Noise below this share of a coordinate's standard deviation is left in the data: it harms nothing,
NEGLIGIBLE = 0.01
#: provided that it is below this share of the increments', too: a slow plant is sampled often.
NEGLIGIBLE_STEP = 0.03

FEW_ROWS = 20_000  # on which the model is identified
EXCERPT = 2 * FEW_ROWS  # of which these are chosen
_FEWEST_PAIRS = 30  # of consecutive rows, for an estimate of the noise
_SIGNIFICANT = 3.0  # standard errors above zero
_LEAST_PROCESS = 1e-4  # of the increments' spread: keeps covariances regular
_CHUNK = 100_000  # rows that are smoothed at a time
_FEWER_ROWS = 4_000  # on which the process noise is chosen
_PROCESS_FACTORS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
_FAR = 10.0  # standard deviations of a measurement: no smoothing goes that far
_SMOOTHINGS = 2


@dataclass(frozen=True)
class NoiseEstimate:
    """How noisy the data are.

    Attributes:
        measurement: Standard deviation of the measurement error of each coordinate, in its unit, ``(nx,)``.
        process: Standard deviation of what the model misses in one step, ``(nx,)``: process noise or wrong structure.
        spread: Standard deviation of each coordinate in the data, ``(nx,)``.
        source: What the estimate rests on: ``"repeated"`` where the data measure every state twice (s+ of a row and s
            of the next), ``"innovations"`` where these are one number, ``"unknown"`` where too few rows are
            consecutive.
        increments: Standard deviation of the increment of each coordinate, ``(nx,)``; None where unknown.
    """

    measurement: Array
    process: Array
    spread: Array
    source: Literal["repeated", "innovations", "unknown"]
    increments: Array | None = None

    @property
    def levels(self) -> Array:
        """Measurement error as share of each coordinate's spread, ``(nx,)``."""
        return np.asarray(
            np.divide(self.measurement, self.spread, out=np.zeros_like(self.spread), where=self.spread > 0)
        )

    @property
    def level(self) -> float:
        """The largest of :attr:`levels`."""
        return float(self.levels.max(initial=0.0))

    @property
    def negligible(self) -> bool:
        """Whether the data may be used as they are."""
        slow = self.increments is not None and bool((self.measurement > NEGLIGIBLE_STEP * self.increments).any())
        return self.level < NEGLIGIBLE and not slow


def with_measurement_noise(table: TransitionTable, level: float, seed: int) -> TransitionTable:
    """The table with Gaussian noise on s and, drawn independently, on s+; for studies.

    Args:
        table: The transitions.
        level: Standard deviation as share of each coordinate's standard deviation, e.g. 0.05.
        seed: Seed of the draw.

    Raises:
        InvalidArgumentError: For a negative level.
    """
    check_number("level", level, 0.0, open_low=False)
    rng, columns = np.random.default_rng(seed), table.values()
    size = level * columns.observations.std(axis=0)
    s, reached = (
        part + size * rng.standard_normal(part.shape) for part in (columns.observations, columns.next_observations)
    )
    return table.with_states(s, reached)


def estimate_noise(mpc: MPC, table: TransitionTable, theta: Array | None = None) -> NoiseEstimate:
    """Estimates measurement and process noise.

    Where s+ of row t and s of row t+1 are two measurements of one state, their difference has twice the measurement
    variance. Where they are one number, the one-step errors e_t = s_{t+1} - f(s_t, a_t) tell, with the measurement
    errors v and F = df/ds::

        e_t = v_{t+1} - F_t v_t + w_t      so      E[e_t e_{t-1}'] = -F_t R,      E[e_t e_t'] = R + F_t R F_t' + Q

    (Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE TAC 15(2), 1970), after what past
    inputs explain linearly has been taken out of e: an input that acts late is no measurement noise.

    Args:
        mpc: The MPC.
        table: The transitions, in the order of time within each episode.
        theta: The parameters of the model; identified from the table by default.
    """
    found = identify_one_step(mpc, table) if theta is None else None
    parameters, unwrapped = (found.theta, found.unwrapped) if found else (np.asarray(theta, np.float64), ())
    return noise_by_moments(Trajectories.of(mpc, excerpt(plant_rows(mpc, table), EXCERPT, 0), unwrapped), parameters)


def smooth(
    mpc: MPC, table: TransitionTable, theta: Array, noise: NoiseEstimate, *, unwrapped: tuple[int, ...] = ()
) -> TransitionTable:
    """The table with its states smoothed: their estimates given all measurements of their episode and the model.

    An extended Rauch-Tung-Striebel smoother, see ``mpcoffline.estimation.kalman``. The process noise decides whom it
    believes: with a model of the wrong structure it stays close to the data.

    Args:
        mpc: The MPC.
        table: The transitions, in the order of time within each episode.
        theta: The identified parameters.
        noise: The noise.
        unwrapped: Coordinates that are wrapped angles.

    Returns:
        A new table of the same rows; actions, costs and terminations as they were. It is smoothed in chunks, so that
        a table larger than memory, which is a memory map, gives another one.

    Raises:
        InvalidArgumentError: For a noise estimate of another size.
        StorageError: Where a memory map cannot be written.
    """
    n_states = mpc.layout.n_states
    if noise.measurement.shape != (n_states,):
        raise InvalidArgumentError("noise", expected=f"{n_states} coordinates", actual=str(noise.measurement.shape))
    table = state_rows(mpc, table)
    return with_plant_states(table, smoothed_plant(mpc, plant_rows(mpc, table), theta, noise, unwrapped))


def smoothed_plant(
    mpc: MPC, table: TransitionTable, theta: Array, noise: NoiseEstimate, unwrapped: tuple[int, ...]
) -> TransitionTable:
    """As :func:`smooth`, of what the plant's map is given."""
    parts = (table.take(slice(start, start + _CHUNK)) for start in range(0, len(table), _CHUNK))
    smooth_parts = (
        part.with_states(*_smoothed_states(Trajectories.of(mpc, part, unwrapped), theta, noise)) for part in parts
    )
    return table.rewritten((part.rows, part.episode_ids) for part in smooth_parts)


def noise_by_moments(problem: Trajectories, theta: Array) -> NoiseEstimate:
    """Measurement and process noise by moments; see :func:`estimate_noise`."""
    valid, scale = problem.valid, problem.scale
    pairs = valid[:, :-1] & valid[:, 1:]
    nx = len(scale)
    rows = problem.rows()
    predicted, _, F = problem.model.linearised(rows.x, rows.u, theta)
    errors, F = (rows.reached - predicted) / scale, F * scale / scale[:, None]
    good: NDArray[np.bool_] = np.asarray(np.isfinite(errors).all(axis=1) & np.isfinite(F).all(axis=(1, 2)))
    errors, F = np.where(good[:, None], errors, 0.0), np.where(good[:, None, None], F, 0.0)
    if pairs.sum() < _FEWEST_PAIRS:
        process = np.sqrt(np.mean(errors**2, axis=0))
        return NoiseEstimate(np.zeros(nx), scale * process, problem.spread, "unknown")
    if problem.repeated:
        difference = (problem.reached[:, :-1] - problem.s[:, 1:])[pairs] / scale
        variances = np.mean(difference**2, axis=0) / 2.0
    else:
        variances = _lagged_variances(problem, errors, F)
    passed_on = np.einsum("nij,j->i", F**2, variances) / len(F)
    process = np.sqrt(np.maximum(np.mean(errors**2, axis=0) - variances - passed_on, 0.0))
    source: Literal["repeated", "innovations"] = "repeated" if problem.repeated else "innovations"
    increments = (problem.reached - problem.s)[valid].std(axis=0)
    return NoiseEstimate(scale * np.sqrt(variances), scale * process, problem.spread, source, increments)


def _lagged_variances(problem: Trajectories, errors: Array, F: Array) -> Array:
    """R from E[e_t e_{t-1}'] = -F_t R, column by column by least squares; zero where that is not significant."""
    valid, nu = problem.valid, problem.inputs.shape[2]
    grid = np.zeros((*valid.shape, errors.shape[1]))
    grid[valid] = errors
    slopes = np.zeros((*valid.shape, *F.shape[1:]))
    slopes[valid] = F
    past = np.zeros((*valid.shape, 2 * nu))
    past[:, 1:, :nu], past[:, 2:, nu:] = problem.inputs[:, :-1], problem.inputs[:, :-2]
    explained, *_ = np.linalg.lstsq(past[valid], errors, rcond=None)
    grid[valid] -= past[valid] @ explained
    pairs = valid[:, :-1] & valid[:, 1:]
    now, before, slope = grid[:, 1:][pairs], grid[:, :-1][pairs], slopes[:, 1:][pairs]
    products = -np.einsum("nji,nj->ni", slope, now) * before  # its mean is R times that of the squares
    squares = np.mean(np.einsum("nji,nji->ni", slope, slope), axis=0)
    standard_error = products.std(axis=0) / np.sqrt(len(products))
    mean = products.mean(axis=0)
    return np.asarray(np.where(mean > _SIGNIFICANT * standard_error, mean / np.maximum(squares, 1e-12), 0.0))


def filter_noise(problem: Trajectories, noise: NoiseEstimate) -> tuple[Array, Array]:
    """Measurement and process noise in the filter's units, kept regular."""
    increments = (problem.reached - problem.s)[problem.valid].std(axis=0)
    least = _LEAST_PROCESS * np.maximum(increments, 1e-3 * problem.scale)
    return noise.measurement / problem.scale, np.maximum(noise.process, least) / problem.scale


def with_likely_process(problem: Trajectories, data: Linearised, noise: NoiseEstimate) -> NoiseEstimate:
    """The estimate with the process noise scaled to the largest likelihood: moments resolve no small one."""
    step = max(1, int(data.valid.sum()) // _FEWER_ROWS)
    few = data.every(step)
    process = np.maximum(noise.process, 0.1 * noise.measurement)
    best, best_likelihood = noise, np.inf
    for factor in _PROCESS_FACTORS:
        candidate = replace(noise, process=factor * process)
        likelihood = filtered(few, *filter_noise(problem, candidate)).likelihood
        if not likelihood < best_likelihood:
            break
        best, best_likelihood = candidate, likelihood
    return best


def _smoothed_states(problem: Trajectories, theta: Array, noise: NoiseEstimate) -> Array:
    """States s and s+ of every row, ``(2, n, nx)``; what comes out far from what was measured stays as it was."""
    x = problem.measured
    for _ in range(_SMOOTHINGS):
        x = smoothed(filtered(problem.linearised(theta, x), *filter_noise(problem, noise)))
    far = np.abs(x - problem.measured) * problem.scale > _FAR * noise.measurement + 1e-9 * problem.scale
    x = np.where((~np.isfinite(x) | far).any(axis=2, keepdims=True), problem.measured, x) * problem.scale
    x = x.swapaxes(0, 1)
    valid, where = problem.valid, problem.index[problem.valid]
    states = np.empty((2, len(where), x.shape[2]))
    states[0, where] = (x[:, :-1] - problem.turns[:, :, 0])[valid]
    states[1, where] = (x[:, 1:] - problem.turns[:, :, 1])[valid]
    return states
