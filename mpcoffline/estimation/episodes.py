"""Parameters that are others in every episode: their values, their mean and their spread, by empirical Bayes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array

from .identification import OneStepProblem
from .uncertainty import Misfit

_ROUNDS = 50
_SETTLED = 1e-3  # change of scaled parameters and of their spread
_WEAKEST_PRIOR = 1e-10
_LEAST_SPREAD = 1e-8  # of the prior's: keeps the covariance regular where no episode differs


@dataclass(frozen=True)
class EpisodeSpread:
    """The parameters with ``varies="episode"``, episode by episode, in theta's coordinates.

    An episode that says little of a parameter is near the mean of all, by as much as it says little.

    Attributes:
        names: The coordinates, ``(v,)``.
        index: Where they stand in theta, ``(v,)``.
        episodes: Ids of the episodes, ``(E,)``.
        values: What was found in each, ``(E, v)``.
        deviations: One standard deviation of each value, given its episode's rows and the spread, ``(E, v)``.
        mean: What the MPC takes, ``(v,)``.
        covariance: Of the values over all episodes, those to come included: ``(v, v)``.
    """

    names: tuple[str, ...]
    index: NDArray[np.intp]
    episodes: NDArray[np.integer[Any]]
    values: Array
    deviations: Array
    mean: Array
    covariance: Array

    @property
    def spread(self) -> Array:
        """Standard deviation over the episodes, ``(v,)``."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def __str__(self) -> str:
        """Mean and spread of each, in a sentence."""
        parts = (f"{n} {m:.4g} +- {s:.2g}" for n, m, s in zip(self.names, self.mean, self.spread, strict=True))
        return f"Over {len(self.episodes)} episodes: {', '.join(parts)}."


class _Round(NamedTuple):
    """The least-squares problem about the present guess, in units of its variance."""

    variance: float
    hessians: Array  # of each episode, (E, p, p)
    gradients: Array  # (E, p)


def by_episode(
    problem: OneStepProblem, z: Array, episodes: NDArray[np.integer[Any]], prior_spread: float
) -> tuple[Array, Misfit, EpisodeSpread]:
    """Parameters of each episode and those that all share, from the estimate that takes one value for all.

    ::

        min_{z, d_e}  sum_e [ sum_rows |(s+ - f(s,a; z + d_e)) / scale|^2 / sigma^2 + d_e' S^-1 d_e ] + |z / spread|^2

    d_e is zero but for the parameters that vary. By Gauss and Newton, the d_e eliminated (the Hessian is an arrow);
    sigma^2 and S, the covariance of d_e, are estimated between the steps, S by expectation-maximisation (Dempster,
    Laird, Rubin, J. Royal Stat. Soc. B 39, 1977): the mean of d_e d_e' and of the covariance that an episode leaves.

    Args:
        problem: The one-step prediction problem; its model has parameters that vary.
        z: The estimate for all episodes together.
        episodes: The episode of each of the problem's rows.
        prior_spread: Standard deviation of the prior in scaled coordinates.

    Returns:
        z with the mean of what varies, what the data say about it, and the episodes' values.
    """
    ids, group = np.unique(episodes, return_inverse=True)
    v = np.flatnonzero(problem.varying)
    others, spread = np.zeros((len(ids), len(v))), prior_spread**2 * np.eye(len(v))
    for _ in range(_ROUNDS):
        now, before = _linearised(problem, z, others, v, group, len(ids)), spread
        z, others, left = _step(problem, now, z, others, spread, v, prior_spread)
        squares = others.T @ others / max(len(ids) - 1, 1)  # their mean has been taken out
        spread = left.mean(axis=0) + squares + _LEAST_SPREAD * prior_spread**2 * np.eye(len(v))
        moved = np.abs(spread - before).max() / np.abs(spread).max()
        if moved < _SETTLED:
            break
    now = _linearised(problem, z, others, v, group, len(ids))
    precision = np.asarray(np.linalg.inv(spread), dtype=np.float64)
    left = np.asarray(np.linalg.inv(now.hessians[:, v[:, None], v] + precision), dtype=np.float64)
    found = _described(problem, z, others, left, v, ids)
    misfit = _misfit(problem, now, others, left, precision, v, group)
    return _with_mean(problem, z, found.mean, v), misfit, found


def _rows_of(z: Array, others: Array, v: NDArray[np.intp]) -> Array:
    """The parameters of each episode, ``(E, p)``."""
    every = np.tile(z, (len(others), 1))
    every[:, v] += others
    return every


def _linearised(
    problem: OneStepProblem, z: Array, others: Array, v: NDArray[np.intp], group: NDArray[np.intp], n: int
) -> _Round:
    errors, jacobian = problem.linearised(_rows_of(z, others, v)[group])
    p = len(z)
    unknown = p + others.size
    variance = max(float(np.sum(errors**2)) / max(errors.size - unknown, 1), _WEAKEST_PRIOR)
    hessians, gradients = np.zeros((n, p, p)), np.zeros((n, p))
    np.add.at(hessians, group, jacobian.swapaxes(1, 2) @ jacobian)
    np.add.at(gradients, group, np.einsum("nip,ni->np", jacobian, errors))
    return _Round(variance, hessians / variance, gradients / variance)


def _step(
    problem: OneStepProblem, now: _Round, z: Array, others: Array, spread: Array, v: NDArray[np.intp], prior: float
) -> tuple[Array, Array, Array]:
    """The z and d_e after a Gauss-Newton step, and the covariance that each episode leaves, ``(E, v, v)``."""
    _, H, g = now
    inverse = np.linalg.inv(spread)
    left = np.linalg.inv(H[:, v[:, None], v] + inverse)
    to_others = left @ H[:, v]  # (E, v, p)
    pull = np.einsum("eij,ej->ei", left, g[:, v] + others @ inverse)
    S = (H - H[:, :, v] @ to_others).sum(axis=0) + np.eye(len(z)) / prior**2
    right = (g - np.einsum("epv,ev->ep", H[:, :, v], pull)).sum(axis=0) + z / prior**2
    dz = -np.linalg.solve(S, right)
    d_others = -pull - to_others @ dz
    length = max(1.0, float(np.abs(dz).max()), float(np.abs(d_others).max(initial=0.0)))
    z, others = z + dz / length, others + d_others / length
    centre = others.mean(axis=0)
    z[v] += centre
    z = np.clip(z, problem.low, problem.high)
    others = np.clip(others - centre, problem.low[v] - z[v], problem.high[v] - z[v])
    return z, others, left


def _described(
    problem: OneStepProblem,
    z: Array,
    others: Array,
    left: Array,
    v: NDArray[np.intp],
    ids: NDArray[np.integer[Any]],
) -> EpisodeSpread:
    """The episodes' values in theta's coordinates."""
    index = np.flatnonzero(problem.coordinates.mask)[problem.free[v]]
    every = _rows_of(z, others, v)
    values = problem.theta(every)[:, index]
    slopes = problem.slopes(every)[:, v]
    left = left * slopes[:, :, None] * slopes[:, None, :]
    mean = values.mean(axis=0)
    between = (values - mean).T @ (values - mean) / max(len(ids) - 1, 1)
    deviations = np.sqrt(np.diagonal(left, axis1=1, axis2=2))
    names = tuple(problem.names[i] for i in v)
    return EpisodeSpread(names, index, ids, values, deviations, mean, between + left.mean(axis=0))


def _with_mean(problem: OneStepProblem, z: Array, mean: Array, v: NDArray[np.intp]) -> Array:
    """The z with the mean of theta where z has the mean of its scaled coordinates, which may be a logarithm's."""
    theta = problem.theta(z)
    theta[np.flatnonzero(problem.coordinates.mask)[problem.free[v]]] = mean
    return problem.z(theta)


def _misfit(
    problem: OneStepProblem,
    now: _Round,
    others: Array,
    left: Array,
    precision: Array,
    v: NDArray[np.intp],
    group: NDArray[np.intp],
) -> Misfit:
    """What the data say about z, the d_e integrated out: its information, and the episodes' scores.

    ::

        H - H_v (H_vv + S^-1)^-1 H_v',    whose columns of what varies are  H_v (H_vv + S^-1)^-1 S^-1
    """
    H, scores = now.hessians, now.gradients.copy()
    information = (H - H[:, :, v] @ left @ H[:, v]).sum(axis=0)
    # Where an episode says much, that difference would be rounding; and at the minimum g_v = -S^-1 d_e.
    information[:, v] = (H[:, :, v] @ left @ precision).sum(axis=0)
    information[v] = information[:, v].T
    scores[:, v] = -others @ precision

    def value(other: Array) -> float:
        return float(np.sum(problem.linearised(_rows_of(other, others, v)[group])[0] ** 2)) / now.variance

    return Misfit(value, information, scores)
