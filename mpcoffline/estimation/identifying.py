"""Identification: the model of the log, measured with noise or without."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mpcoffline.core.checks import check_integers
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.excerpts import excerpt
from mpcoffline.datasets.table.memory import with_plant_states
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC, Model

from .episodes import EpisodeSpread, by_episode
from .identification import IdentificationConfig, OneStepIdentification, OneStepProblem, described, identify_plant
from .kalman import Filtered, filtered, smoothed
from .multi_step import MultiStepProblem, Windows
from .plant import plant_rows, state_rows
from .smoothing import (
    EXCERPT,
    FEW_ROWS,
    NoiseEstimate,
    filter_noise,
    noise_by_moments,
    smoothed_plant,
    with_likely_process,
)
from .structure import MultiStepCheck, check_structure
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
        episode_spread: The parameters with ``varies="episode"`` of each episode, their mean, which theta has, and their
            covariance; None where the model has none.
        multi_step: How well the model predicts many steps, and whether other parameters would do so better, which says
            that its structure is wrong; None where the log has no stretches long enough.
    """

    table: TransitionTable
    noise: NoiseEstimate
    model: Model
    episode_spread: EpisodeSpread | None = None
    multi_step: MultiStepCheck | None = None


def identify(
    mpc: MPC,
    table: TransitionTable,
    config: IdentificationConfig | None = None,
    *,
    horizon: int | None = None,
    tried: Sequence[str] = (),
    seed: int = 0,
    start: MPC | None = None,
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

    With ``horizon``, the parameters that predict so many steps open loop best, from starts that are fitted, too (output
    error, :class:`~mpcoffline.estimation.multi_step.MultiStepProblem`). With the right structure that gains nothing;
    with a wrong one it predicts farther, and controllers on it were no better.

    Parameters with ``varies="episode"`` are found for each episode from there on, with one-step errors
    (``mpcoffline.estimation.episodes.by_episode``); theta has their mean.

    Example:
        >>> found = mpcoffline.estimation.identify(mpc, table)
        >>> better = mpc.with_theta(found.theta)
        >>> print(found.multi_step)

    Args:
        mpc: The MPC; its parameters are theta_0, and all but those of the model stay as they are.
        table: The transitions, in the order of time within each episode. Rows that were left out are gaps.
        config: Prior and effort.
        horizon: Steps that are predicted in the fit; None for one, 10 to 25 for output error.
        tried: What of the model's structure was varied before, in words: the check of structure repeats it.
        seed: Seeds the choice of rows and the restarts.
        start: An MPC that was learned before: the search begins at its model's parameters, too; the prior stays about
            theta_0.

    Returns:
        Parameters with deviations, smoothed data and noise; theta_0 itself for a model without parameters.

    Raises:
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    config = config or IdentificationConfig()
    if horizon is not None:
        check_integers(1, horizon=horizon)
    whole = state_rows(mpc, table)
    rows = plant_rows(mpc, whole)
    # Rows may have been left out since it was chosen.
    mpc = mpc.replace(model=mpc.model.suited_to_log(whole, finer=True))
    for _ in range(_ROUNDS):
        found = _identified(mpc, rows, config, horizon, seed, start)
        model = found.model.suited_to_log(whole, finer=True)
        if model.scheme == found.model.scheme:
            break
        logger.info("Identified again: at what was found, %s is not accurate, %s is.", found.model.scheme, model.scheme)
        mpc = mpc.replace(model=model.with_theta(mpc.model.space.theta))
    found.warn()
    if found.episode_spread is not None:
        logger.info("%s", found.episode_spread)
    check = _checked(mpc, rows, found, config, seed)
    if check is not None:
        substeps = () if found.model.integrator != "auto" else (f"the integrator ({found.model.scheme} is accurate)",)
        check = check.having_tried(*tried, *substeps)
        logger.log(logging.WARNING if check.suspicious else logging.INFO, "%s", check)
    table = whole if found.table is rows else with_plant_states(whole, found.table)
    return replace(found, table=table, multi_step=check)


def _checked(
    mpc: MPC, rows: TransitionTable, found: Identification, config: IdentificationConfig, seed: int
) -> MultiStepCheck | None:
    """The check of structure, on the rows as logged."""
    source = excerpt(rows, EXCERPT, seed)
    few = Trajectories.of(mpc, source, found.unwrapped).thinned(FEW_ROWS, seed)
    return check_structure(mpc, few, source.episode_ids, found.theta, spread=config.prior_spread, seed=seed)


def _beginning(mpc: MPC, start: MPC) -> Array:
    """Theta with the model's parameters of another MPC, as far as it has them."""
    known, theta = {block.name: block for block in start.space if block.group == "model"}, mpc.theta
    for block in mpc.space:
        if block.group == "model" and block.name in known and known[block.name].theta.shape == block.theta.shape:
            theta[mpc.space.slices[block.name]] = known[block.name].theta
    return np.asarray(np.clip(theta, mpc.space.low, mpc.space.high))


def _identified(
    mpc: MPC,
    table: TransitionTable,
    config: IdentificationConfig,
    horizon: int | None,
    seed: int,
    start: MPC | None = None,
) -> Identification:
    """As :func:`identify`, from a table of :func:`plant_rows`, with the model integrated as it is."""

    def result(found: OneStepIdentification, table: TransitionTable, noise: NoiseEstimate) -> Identification:
        spread = None
        if mpc.space.varying.any():
            found, spread = _by_episode(mpc, table, found, config, seed)
        model = mpc.with_theta(found.theta).model
        return Identification(**vars(found), table=table, noise=noise, model=model, episode_spread=spread)

    begin = None if start is None else _beginning(mpc, start)
    first = identify_plant(mpc, table, config, seed=seed, start=begin)
    source = excerpt(table, EXCERPT, seed)
    few = Trajectories.of(mpc, source, first.unwrapped).thinned(FEW_ROWS, seed)
    noise = noise_by_moments(few, first.theta)
    silent = noise.source == "unknown" or noise.negligible
    if silent and horizon is None:
        return result(first, table, noise)
    centre = table.centring.centre[: table.ny]
    noisy = OneStepProblem(mpc, few.rows(), centre)
    z, misfit = noisy.z(first.theta), Misfit.nothing()
    if not silent:
        z, noise, misfit = _most_likely(few, noisy, first, config, source)
        logger.info("Measurement noise of %.1f %%: identified and smoothed with a Kalman filter.", 100.0 * noise.level)
    if horizon is not None and len(z):
        z, misfit = _predicting_far(mpc, few, noisy, (np.zeros_like(z), z), horizon, config, source)
    clean = table if silent else smoothed_plant(mpc, table, noisy.theta(z), noise, first.unwrapped)
    rows = Trajectories.of(mpc, excerpt(clean, EXCERPT, seed), first.unwrapped).rows()
    problem = OneStepProblem(mpc, rows, centre, noisy.coordinates)
    return result(described(mpc, problem, z, misfit, config.prior_spread, first.unwrapped), clean, noise)


def _by_episode(
    mpc: MPC, table: TransitionTable, found: OneStepIdentification, config: IdentificationConfig, seed: int
) -> tuple[OneStepIdentification, EpisodeSpread | None]:
    """What was identified with the mean of what varies from episode to episode, and its spread."""
    source = excerpt(table, EXCERPT, seed)
    few = Trajectories.of(mpc, source, found.unwrapped).thinned(FEW_ROWS, seed)
    problem = OneStepProblem(mpc, few.rows(), table.centring.centre[: table.ny])
    if not problem.varying.any():  # fixed by their bounds
        return found, None
    ids = source.episode_ids[few.index[few.valid]]
    z, misfit, spread = by_episode(problem, problem.z(found.theta), ids, config.prior_spread)
    return described(mpc, problem, z, misfit, config.prior_spread, found.unwrapped), spread


def _predicting_far(
    mpc: MPC,
    few: Trajectories,
    coordinates: OneStepProblem,
    begin: tuple[Array, ...],
    horizon: int,
    config: IdentificationConfig,
    source: TransitionTable,
) -> tuple[Array, Misfit]:
    """The parameters that predict many steps best, from the best first guess, and what the data say of them."""
    windows = Windows.of(few, horizon, horizon, full=False)
    problem = MultiStepProblem(mpc, windows, coordinates, config.prior_spread)
    ends = [problem.fitted(z, config.max_iterations) for z in begin]
    z, starts, there = min(ends, key=lambda end: end[2].cost)
    return z, problem.misfit(z, starts, there, source.episode_ids[windows.rows])


def _most_likely(
    few: Trajectories,
    coordinates: OneStepProblem,
    first: OneStepIdentification,
    config: IdentificationConfig,
    source: TransitionTable,
) -> tuple[Array, NoiseEstimate, Misfit]:
    """The parameters of the largest likelihood and prior, the noise, and what the data say about the parameters."""
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
