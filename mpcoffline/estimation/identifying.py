"""Identification: the model of the log, measured with noise or without."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.memory import with_plant_states
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC, Model

from .identification import (
    IdentificationConfig,
    OneStepIdentification,
    OneStepProblem,
    described,
    identify_plant,
)
from .kalman import Filtered, filtered, smoothed
from .plant import plant_rows, state_rows
from .smoothing import (
    FEW_ROWS,
    NoiseEstimate,
    excerpt,
    filter_noise,
    noise_by_moments,
    smoothed_plant,
    with_likely_process,
)
from .trajectories import Trajectories
from .uncertainty import Misfit, clusters

logger = logging.getLogger(__name__)

_ROUNDS = 5
_SETTLED = 1e-4  # change of the scaled parameters


@dataclass(frozen=True, kw_only=True)
class Identification(OneStepIdentification):
    """An identified model, the data without measurement noise, and how far both can be trusted.

    Its errors are those on the data without noise.

    Attributes:
        table: The smoothed data; the given table itself where its noise is negligible.
        noise: The noise found.
        model: The identified model, integrated as accurately as the log asks for.
    """

    table: TransitionTable
    noise: NoiseEstimate
    model: Model


def identify(
    mpc: MPC, table: TransitionTable, config: IdentificationConfig | None = None, *, seed: int = 0
) -> Identification:
    """Identifies the model from a log, and takes the measurement noise out of the log.

    First least squares of the one-step prediction error, see ``mpcoffline.estimation.identification``::

        th* = argmin  E_D[ |(s+ - f_th(s,a)) / scale|^2 ] + (sigma^2 / n) |z / spread|^2

    That is biased where s is measured with noise. Where the noise found is not negligible: the parameters that make
    the data most likely under the extended Kalman filter, by Gauss-Newton on its innovations (Ljung, "System
    Identification", ch. 7: a prediction-error method), noise and model estimated in turn.

    A model that takes its substeps from the log (``integrator="auto"``) may need more at what is identified than at
    theta_0; then all is done again, from theta_0, with as many: a coarse Runge-Kutta step has the same one-step error
    at another, wrong time constant, and the data would seem sure of it.

    Args:
        mpc: The MPC; its parameters are theta_0, and all but those of the model stay as they are.
        table: The transitions, in the order of time within each episode. Rows that were left out are gaps.
        config: Prior and effort.
        seed: Seeds the choice of rows and the restarts.

    Returns:
        Parameters with deviations, smoothed data and noise; theta_0 itself for a model without parameters.

    Raises:
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    config = config or IdentificationConfig()
    whole = state_rows(mpc, table)
    rows = plant_rows(mpc, whole)
    mpc = mpc.replace(model=mpc.model.suited_to_log(rows))
    for _ in range(_ROUNDS):
        found = _identified(mpc, rows, config, seed)
        model = found.model.suited_to_log(rows, finer=True)
        if model.scheme == found.model.scheme:
            break
        logger.info("Identified again: at what was found, %s is not accurate, %s is.", found.model.scheme, model.scheme)
        mpc = mpc.replace(model=model.with_theta(mpc.model.space.theta))
    found.warn()
    return replace(found, table=whole if found.table is rows else with_plant_states(whole, found.table))


def _identified(mpc: MPC, table: TransitionTable, config: IdentificationConfig, seed: int) -> Identification:
    """As :func:`identify`, from a table of :func:`plant_rows`, with the model integrated as it is."""

    def result(found: OneStepIdentification, table: TransitionTable, noise: NoiseEstimate) -> Identification:
        model = mpc.with_theta(found.theta).model
        return Identification(**vars(found), table=table, noise=noise, model=model)

    first = identify_plant(mpc, table, config, seed=seed)
    source = excerpt(table, seed)
    few = Trajectories.of(mpc, source, first.unwrapped).thinned(FEW_ROWS, seed)
    noise = noise_by_moments(few, first.theta)
    if noise.source == "unknown" or noise.negligible:
        return result(first, table, noise)
    z, noise, misfit = _most_likely(mpc, few, first, config, (table, source))
    logger.info("Measurement noise of %.1f %%: identified and smoothed with a Kalman filter.", 100.0 * noise.level)
    centre = table.centring.centre[: table.ny]
    noisy = OneStepProblem(mpc, few.rows(), centre)
    smoothed_table = smoothed_plant(mpc, table, noisy.theta(z), noise, first.unwrapped)
    clean = Trajectories.of(mpc, excerpt(smoothed_table, seed), first.unwrapped)
    problem = OneStepProblem(mpc, clean.rows(), centre, noisy.coordinates)
    return result(described(mpc, problem, z, misfit, config.prior_spread, first.unwrapped), smoothed_table, noise)


def _most_likely(
    mpc: MPC,
    few: Trajectories,
    first: OneStepIdentification,
    config: IdentificationConfig,
    tables: tuple[TransitionTable, TransitionTable],
) -> tuple[Array, NoiseEstimate, Misfit]:
    """The parameters of the largest likelihood and prior, the noise, and what the data say about the parameters."""
    table, source = tables
    coordinates = OneStepProblem(mpc, few.rows(), table.centring.centre[: table.ny])
    z, noise = coordinates.z(first.theta), noise_by_moments(few, first.theta)
    about = few.measured
    for _ in range(_ROUNDS):
        data = few.linearised(coordinates.theta(z), about)
        noise = with_likely_process(few, data, noise_by_moments(few, coordinates.theta(z)))
        found = filtered(data, *filter_noise(few, noise))
        step = _gauss_newton(found, coordinates, z, config.prior_spread)
        z, about = np.clip(z + step, coordinates.low, coordinates.high), smoothed(found)
        if np.abs(step).max(initial=0.0) < _SETTLED:
            break

    def likelihood(other: Array) -> float:
        """Minus twice its logarithm."""
        data = few.linearised(coordinates.theta(other), few.measured)
        return filtered(data, *filter_noise(few, noise)).likelihood

    if not likelihood(z) <= likelihood(coordinates.z(first.theta)):
        z = coordinates.z(first.theta)
    found = filtered(few.linearised(coordinates.theta(z), about), *filter_noise(few, noise))
    slopes, free = coordinates.slopes(z), coordinates.free
    information = found.information[np.ix_(free, free)] * np.outer(slopes, slopes)
    scores = clusters(found.scores[:, free] * slopes, source.episode_ids[few.index[:, 0]])
    return z, noise, Misfit(likelihood, information, scores)


def _gauss_newton(found: Filtered, coordinates: OneStepProblem, z: Array, spread: float) -> Array:
    """The Gauss-Newton step of z on the likelihood and the prior."""
    slopes, free = coordinates.slopes(z), coordinates.free
    information = found.information[np.ix_(free, free)] * np.outer(slopes, slopes)
    gradient = found.gradient[free] * slopes + z / spread**2
    step = -np.asarray(np.linalg.solve(information + np.eye(len(z)) / spread**2, gradient), dtype=np.float64)
    return step / max(1.0, float(np.abs(step).max(initial=0.0)))
