"""The model parameters by least squares of the one-step prediction error: the baseline without any value function."""

from __future__ import annotations

import copy
import logging
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
import torch
from numpy.typing import NDArray

from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.text import listed
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC
from mpcoffline.mpc.coordinates import Coordinates
from mpcoffline.mpc.scaling import Scaling, increments_scale

from .one_step import OneStep
from .plant import plant_rows
from .rows import Rows, without_jumps
from .uncertainty import Misfit, clusters, uncertainty

logger = logging.getLogger(__name__)

#: Spreads of the increments: what a prediction that is not finite counts, and from where on errors count by less.
ABSURD = 1e3
_AT_BOUND = 1e-4  # in scaled coordinates
_WEAKEST_PRIOR = 1e-10
_FEW_ROWS = 1_000  # for the way to the minimum
_PRIOR_ROUNDS = 3  # until sigma^2, which begins at 1, is that of the minimum
_MAX_ENTRIES = 20_000_000  # of the Jacobian: 160 MB


@dataclass(frozen=True)
class IdentificationConfig:
    """How the model is identified.

    Attributes:
        rows: Transitions used; a random subset where there are more.
        prior_spread: How far theta_0 may be off, as standard deviation in the scaled coordinates of
            :class:`~mpcoffline.mpc.coordinates.Coordinates` (1: a factor e). It decides only what the data leave
            open: its weight against the data is that of a Gaussian prior.
        max_iterations: Bound on the iterations of a descent.
        restarts: Further starting points, drawn from the prior, where the first one ends badly.
    """

    rows: int = 20_000
    prior_spread: float = 1.0
    max_iterations: int = 50
    restarts: int = 4

    def __post_init__(self) -> None:
        check_number("prior_spread", self.prior_spread, 0.0)
        check_integers(1, rows=self.rows, max_iterations=self.max_iterations)
        check_integers(0, restarts=self.restarts)


@dataclass(frozen=True)
class OneStepIdentification:
    """An identified model, and how far it can be trusted.

    Errors are root mean squares of the one-step prediction error s+ - f(s,a), a coordinate divided by ``scale``, so
    that 1 is as bad as predicting s+ = s + a constant.

    Attributes:
        theta: All parameters of the MPC, those of the model identified, ``(size,)``.
        deviation: One standard deviation of each, given data and prior, with the episodes' own scatter: errors that
            last over many rows count as few; 0 where not identified, ``(size,)``.
        scale: Spread of the increments s+ - s, ``(nx,)``.
        errors_before: Normalised error of each coordinate at theta_0, ``(nx,)``; a single one counts 1000 at most.
        errors_after: The same at theta.
        at_bound: Names of the parameters that ended at a bound.
        undetermined: Parameters, or combinations of them, that the data do not determine: moved to either side by as
            much as the prior leaves open, they predict the data as well. These stay near theta_0.
        unwrapped: Coordinates that proved to be wrapped angles.
        absurd: Rows that the model predicts by more than 1000 spreads wrong, or not at all, and rows looked at.
    """

    theta: Array
    deviation: Array
    scale: Array
    errors_before: Array
    errors_after: Array
    at_bound: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    unwrapped: tuple[int, ...] = ()
    absurd: tuple[int, int] = (0, 0)

    @property
    def error_before(self) -> float:
        """Root mean square over all coordinates at theta_0."""
        return float(np.sqrt(np.mean(self.errors_before**2)))

    @property
    def error_after(self) -> float:
        """The same at theta."""
        return float(np.sqrt(np.mean(self.errors_after**2)))

    def warn(self) -> None:
        """Logs what the user should know."""
        if self.undetermined:
            text = "The data do not determine %s; what they leave open stays near the given values."
            logger.warning(text, listed(self.undetermined, joint=", nor "))
        if self.at_bound:
            text = "Identified at a bound: %s. Is the bound right, and the model's structure?"
            logger.warning(text, listed(self.at_bound))
        if self.unwrapped:
            logger.warning("Wrapped angles (compared modulo 2 pi): coordinates %s.", list(self.unwrapped))
        if self.absurd[0]:
            text = "The model's predictions of %d of %d rows are absurd or not finite: is it right there, are the data?"
            logger.warning(text, *self.absurd)


class _Descent(NamedTuple):
    """Where one starting point led."""

    z: Array
    cost: float


class OneStepProblem:
    """Normalised one-step prediction errors as a function of the scaled coordinates z of the model parameters.

    ::

        min_z  mean_D[ |(s+ - f_th(z)(s,a)) / scale|^2 ] + prior |z|^2
    """

    rows: Rows
    scale: Array
    model: OneStep
    low: Array
    high: Array

    def __init__(
        self, mpc: MPC, rows: Rows, centre: Array | float = 0.0, coordinates: Coordinates | None = None
    ) -> None:
        self.rows, self.scale = rows, increments_scale(rows.x, rows.reached, centre)
        c = coordinates or Coordinates(mpc, ("model",), Scaling(rows.x, rows.u, self.scale))
        self.coordinates = c
        self.model, self._theta_0 = OneStep(mpc, c.mask), mpc.theta[c.mask]
        self.free: NDArray[np.intp] = np.flatnonzero(c.high > c.low)
        self.low, self.high = c.low[self.free], c.high[self.free]
        names = [name for name, chosen in zip(mpc.space.names, c.mask, strict=True) if chosen]
        self.names: list[str] = [names[i] for i in self.free]
        self.varying: NDArray[np.bool_] = mpc.space.varying[c.mask][self.free]

    def on(self, rows: Rows) -> OneStepProblem:
        """The same problem for other rows, in the same scale."""
        other = copy.copy(self)
        other.rows = rows
        return other

    def theta(self, z: Array) -> Array:
        """The full theta ``(..., size)`` of free coordinates z ``(..., p)``."""
        full = np.zeros((*z.shape[:-1], self.coordinates.size))
        full[..., self.free] = z
        return np.asarray(self.coordinates.theta(torch.from_numpy(full)).numpy())

    def z(self, theta: Array) -> Array:
        """The inverse of :meth:`theta`."""
        return np.asarray(np.clip(self.coordinates.z(theta)[self.free], self.low, self.high))

    def slopes(self, z: Array) -> Array:
        """The derivative of theta in z, of the free coordinates."""
        c = self.coordinates
        slopes = np.where(c.logarithmic, self.theta(z)[..., c.mask], c.scale)
        return np.asarray(slopes[..., self.free])

    def errors(self, theta: Array) -> Array:
        """Normalised prediction errors, ``(n, nx)``; not finite where the model is not."""
        predicted = self.model.predict(self.rows.x, self.rows.u, theta)
        return (predicted - self.rows.reached) / self.scale

    def linearised(self, z: Array) -> tuple[Array, Array]:
        """The errors and their derivative in z, ``(n, nx)`` and ``(n, nx, p)``; a prediction that fails is a wall.

        z is one ``(p,)`` for all rows, or one a row ``(n, p)``.
        Errors e beyond c = 1000 count c (1 + log(e / c)): a few absurd ones do not decide what the model is.
        """
        predicted, slopes = self.model.with_slopes(self.rows.x, self.rows.u, self.theta(z))
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is the wall
            errors = (predicted - self.rows.reached) / self.scale
            jacobian = slopes[:, :, self.free] * self.slopes(z)[..., None, :] / self.scale[:, None]
        finite = np.isfinite(errors) & np.isfinite(jacobian).all(axis=2)
        errors, jacobian = np.where(finite, errors, ABSURD), np.where(finite[:, :, None], jacobian, 0.0)
        beyond = np.maximum(np.abs(errors) / ABSURD, 1.0)
        if (beyond > 1.0).any():
            errors, jacobian = errors / beyond * (1.0 + np.log(beyond)), jacobian / beyond[:, :, None]
        return errors, jacobian

    def descend(self, start: Array, prior: float, max_iterations: int) -> _Descent:
        """Trust-region Gauss-Newton from one start, within the bounds (scipy's ``trf``)."""
        n, weight = self.rows.x.shape[0], np.sqrt(prior)
        slopes: dict[bytes, Array] = {}  # of the last point, which trf asks for after its errors

        def residuals(z: Array) -> Array:
            errors, jacobian = self.linearised(z)
            slopes.clear()
            slopes[z.tobytes()] = np.concatenate([jacobian.reshape(-1, len(z)) / np.sqrt(n), weight * np.eye(len(z))])
            return np.concatenate([errors.ravel() / np.sqrt(n), weight * z])

        def derivative(z: Array) -> Array:
            if z.tobytes() not in slopes:
                residuals(z)
            return slopes[z.tobytes()]

        try:
            found = scipy.optimize.least_squares(
                residuals,
                np.clip(start, self.low, self.high),
                jac=derivative,
                bounds=(self.low, self.high),
                max_nfev=max_iterations,
                xtol=1e-10,
                ftol=1e-12,
                gtol=1e-12,
            )
        except (ValueError, np.linalg.LinAlgError) as error:  # squares of the derivative overflow
            raise self.unpredictable(str(error)) from error
        return _Descent(np.asarray(found.x), 2.0 * float(found.cost))

    def unpredictable(self, reason: str) -> InvalidDataError:
        """The error that says that the model makes nothing of the data."""
        return InvalidDataError(
            "identification",
            expected="data that the model can predict",
            actual=f"states up to {np.abs(self.rows.x).max():g} ({reason})",
            hint="Are the data in the model's units?",
        )


def identify_one_step(
    mpc: MPC, table: TransitionTable, config: IdentificationConfig | None = None, *, seed: int = 0
) -> OneStepIdentification:
    """Identifies the model by least squares of the one-step prediction error.

    ::

        th* = argmin  E_D[ |(s+ - f_th(s,a)) / scale|^2 ] + (sigma^2 / n) |z / spread|^2

    with scale the spread of the increments s+ - s of each coordinate, z the scaled coordinates of the model parameters
    and sigma^2 the mean square error that remains: the maximum a posteriori estimate, whose prior decides only what
    the data leave open (a mass and a gear that matter by their ratio alone).
    An entry of s that the data wrap, as an angle, is compared modulo 2 pi.

    Args:
        mpc: The MPC; its parameters are theta_0, and all but those of the model stay as they are.
        table: The transitions.
        config: Prior, size and effort.
        seed: Seeds the choice of rows and the restarts.

    Returns:
        The identified parameters with their errors; theta_0 itself for a model without parameters.

    Raises:
        InvalidDataError: If the data have other dimensions than the MPC, or the model predicts none of them at all.
    """
    return identify_plant(mpc, plant_rows(mpc, table), config, seed=seed)


def identify_plant(
    mpc: MPC,
    table: TransitionTable,
    config: IdentificationConfig | None = None,
    *,
    seed: int = 0,
    start: Array | None = None,
) -> OneStepIdentification:
    """As :func:`identify_one_step`, from a table of :func:`plant_rows`; the search begins at theta ``start``, too."""
    config = config or IdentificationConfig()
    rng = np.random.default_rng(seed)
    centre = table.centring.centre[: table.ny]
    rows, episodes = _rows(mpc, table, config, rng)
    problem = OneStepProblem(mpc, rows, centre)
    rows, unwrapped = without_jumps(problem.rows, problem.errors(mpc.theta) * problem.scale)
    if unwrapped:
        problem = OneStepProblem(mpc, rows, centre)
    if not problem.free.size:
        return described(mpc, problem, np.zeros(0), Misfit.nothing(), config.prior_spread, unwrapped)
    z, prior = _best_descent(problem, config, rng, None if start is None else problem.z(start))
    variance = len(problem.rows.x) * prior * config.prior_spread**2
    found = described(mpc, problem, z, _misfit(problem, z, variance, episodes), config.prior_spread, unwrapped)
    if found.absurd[0] == len(rows.x):
        raise problem.unpredictable("the best prediction of every row is more than 1000 increments off")
    return found


def _misfit(problem: OneStepProblem, z: Array, variance: float, episodes: NDArray[np.integer[Any]]) -> Misfit:
    """The sum of squared errors over their variance, about z."""

    def sum_of_squares(other: Array) -> float:
        return float(np.sum(problem.linearised(other)[0] ** 2)) / variance

    errors, jacobian = problem.linearised(z)
    information = np.einsum("nip,niq->pq", jacobian, jacobian, optimize=True) / variance
    scores = np.einsum("nip,ni->np", jacobian, errors) / variance
    return Misfit(sum_of_squares, information, clusters(scores, episodes))


def described(
    mpc: MPC, problem: OneStepProblem, z: Array, misfit: Misfit, spread: float, unwrapped: tuple[int, ...] = ()
) -> OneStepIdentification:
    """What was identified, with errors on the problem's rows.

    Args:
        mpc: The MPC; its parameters are theta_0.
        problem: The one-step prediction problem.
        z: The identified coordinates.
        misfit: What the data say about z.
        spread: Standard deviation of the prior.
        unwrapped: Coordinates that are wrapped angles.
    """
    theta = np.clip(problem.theta(z), mpc.space.low, mpc.space.high)
    errors = problem.errors(theta)
    absurd = int(np.sum(~(np.abs(errors) <= ABSURD).all(axis=1)))
    covariance, undetermined = uncertainty(misfit, z, (problem.low, problem.high), spread, problem.names)
    deviation = np.zeros_like(theta)
    identified = np.flatnonzero(problem.coordinates.mask)[problem.free]
    deviation[identified] = np.sqrt(np.diag(covariance)) * np.abs(problem.slopes(z))
    return OneStepIdentification(
        theta,
        deviation,
        problem.scale,
        _root_mean_square(problem.errors(mpc.theta)),
        _root_mean_square(errors),
        tuple(name for name, bound in zip(problem.names, _at_bound(problem, z), strict=True) if bound),
        undetermined,
        unwrapped,
        (absurd, len(errors)),
    )


def _rows(
    mpc: MPC, table: TransitionTable, config: IdentificationConfig, rng: np.random.Generator
) -> tuple[Rows, NDArray[np.integer[Any]]]:
    """A random subset in float64, small enough for its Jacobian, and the episode of each row."""
    n_parameters = max(1, int(mpc.space.mask(("model",)).sum()))
    count = min(config.rows, max(n_parameters, _MAX_ENTRIES // (n_parameters * table.ny)))
    sample = table.sample(count, rng)
    columns = sample.columns(sample.rows)
    parts = (columns.observations, columns.actions, columns.next_observations)
    return Rows(*(np.asarray(part, dtype=np.float64) for part in parts)), sample.episode_ids


def _best_descent(
    problem: OneStepProblem, config: IdentificationConfig, rng: np.random.Generator, begin: Array | None = None
) -> tuple[Array, float]:
    """The minimum and the weight of its prior: found on few rows, refined on all.

    It begins at theta_0, and at a point that is given; again from elsewhere where the first start ends at a bound or
    explains nothing.
    """
    n, n_coordinates = problem.rows.x.shape
    few = problem.on(Rows(*(part[:: max(1, n // _FEW_ROWS)] for part in problem.rows)))

    def weight(mean_square: float) -> float:
        """What a Gaussian prior weighs against the mean square error: sigma^2 / (n spread^2)."""
        return float(max(_WEAKEST_PRIOR, mean_square / n_coordinates / n) / config.prior_spread**2)

    start, best = np.zeros(len(problem.free)), _Descent(np.zeros(len(problem.free)), np.inf)
    if begin is not None:
        best = few.descend(begin, weight(1.0), config.max_iterations)
    for _ in range(config.restarts + 1):
        best = min(best, few.descend(start, weight(1.0), config.max_iterations), key=attrgetter("cost"))
        if best.cost < n_coordinates and not _at_bound(problem, best.z).any():
            break
        start = 0.5 * config.prior_spread * rng.standard_normal(len(start))
    for _ in range(_PRIOR_ROUNDS):
        errors = few.linearised(best.z)[0]
        prior = weight(float(np.sum(np.where(np.abs(errors) < ABSURD, errors, 0.0) ** 2)) / len(few.rows.x))
        best = few.descend(best.z, prior, config.max_iterations)
    return problem.descend(best.z, prior, config.max_iterations).z, prior


def _at_bound(problem: OneStepProblem, z: Array) -> NDArray[np.bool_]:
    return np.asarray((z - problem.low < _AT_BOUND) | (problem.high - z < _AT_BOUND))


def _root_mean_square(errors: Array) -> Array:
    """Of each coordinate ``(nx,)``, whatever the model predicts."""
    finite = np.nan_to_num(errors, nan=ABSURD, posinf=ABSURD, neginf=-ABSURD)
    return np.asarray(np.sqrt(np.mean(np.clip(finite, -ABSURD, ABSURD) ** 2, axis=0)))
