"""An extended Kalman filter and Rauch-Tung-Striebel smoother over many logged trajectories at once.

Every state is measured, with independent errors. The model f_theta is linearised about a first guess of the
trajectories; smoothing again about the result is Gauss-Newton on the most likely trajectories.

Reference: Rauch, Tung, Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal 3(8), 1965.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array

_UNMEASURED = 1e12  # variance of a measurement that does not exist


class Linearised(NamedTuple):
    """Trajectories and the model about them, padded to one length, time first.

    Attributes:
        measured: Mean measurement of each state, ``(T + 1, E, nx)``.
        counts: How many measurements it is the mean of (0, 1, 2), ``(T + 1, E)``.
        valid: Where there is a transition, ``(T, E)``; a trajectory is valid from its start on.
        about: States that the model is linearised about, ``(T, E, nx)``.
        ahead: Their predicted successors f, ``(T, E, nx)``.
        F: df/dx there, ``(T, E, nx, nx)``.
        slopes: df/dtheta there, ``(T, E, nx, p)``.
    """

    measured: Array
    counts: Array
    valid: NDArray[np.bool_]
    about: Array
    ahead: Array
    F: Array
    slopes: Array

    def every(self, step: int) -> Linearised:
        """Every step-th trajectory, without derivatives in theta."""
        measured, counts, valid, about, ahead, F, slopes = self
        measured, counts, valid = measured[:, ::step], counts[:, ::step], valid[:, ::step]
        return Linearised(
            measured, counts, valid, about[:, ::step], ahead[:, ::step], F[:, ::step], slopes[:, ::step, :, :0]
        )


class Filtered(NamedTuple):
    """What the filter found.

    Attributes:
        x: Estimates, given the measurements so far, ``(T + 1, E, nx)``.
        P: Their covariances, ``(T + 1, E, nx, nx)``.
        x_ahead: Predictions of x_1 ... x_T, ``(T, E, nx)``.
        P_ahead: Their covariances, ``(T, E, nx, nx)``.
        F: df/dx as used: the identity where a trajectory has ended, ``(T, E, nx, nx)``.
        likelihood: Minus twice the log likelihood of the measurements, up to a constant.
        gradient: Half of its derivative in the model parameters, ``(p,)``, with gains held.
        information: The Gauss-Newton approximation of half of its second derivative, ``(p, p)``.
        scores: The share of each trajectory in the gradient, ``(E, p)``.
    """

    x: Array
    P: Array
    x_ahead: Array
    P_ahead: Array
    F: Array
    likelihood: float
    gradient: Array
    information: Array
    scores: Array


def filtered(data: Linearised, measurement: Array, process: Array) -> Filtered:
    """The Kalman filter, with the sensitivity of its innovations to the model parameters.

    ::

        x-_{t+1} = f + F (x_t - about),   P- = F P F' + Q,   K = P- (P- + R)^-1,   x = x- + K (y - x-),   P = (1 - K) P-
        dx-      = F dx + df/dtheta,                                               dx = (1 - K) dx-

    Args:
        data: Measurements and linearised model.
        measurement: Standard deviation of a measurement's error, ``(nx,)``.
        process: Standard deviation of the model's error in a step, ``(nx,)``; positive.
    """
    R, Q = np.diag(measurement**2), np.diag(process**2)
    F = np.where(data.valid[:, :, None, None], data.F, np.eye(len(measurement)))
    slopes = np.where(data.valid[:, :, None, None], data.slopes, 0.0)
    weights = np.where(data.counts > 0.0, 1.0 / np.maximum(data.counts, 1.0), _UNMEASURED)
    x, P = data.measured[0], weights[0][:, None, None] * R
    sensitivity = np.zeros_like(slopes[0])
    gradient, information = np.zeros(slopes.shape[-1]), np.zeros((slopes.shape[-1],) * 2)
    scores, likelihood = np.zeros(sensitivity[:, 0].shape), 0.0
    history: list[tuple[Array, Array, Array, Array]] = []
    for t, valid in enumerate(data.valid):
        ahead = np.where(valid[:, None], data.ahead[t] + _times(F[t], x - data.about[t]), x)
        P_ahead = F[t] @ P @ F[t].swapaxes(1, 2) + Q
        heard = valid & (data.counts[t + 1] > 0.0)
        S = P_ahead + np.where(heard, weights[t + 1], _UNMEASURED)[:, None, None] * R
        S_inverse = np.linalg.inv(S)
        innovation = np.where(heard[:, None], data.measured[t + 1] - ahead, 0.0)
        whitened = _times(S_inverse, innovation)
        likelihood += float(np.sum(innovation * whitened) + np.linalg.slogdet(S[heard])[1].sum())
        gain = P_ahead @ S_inverse
        history.append((x, P, ahead, P_ahead))
        x, P = ahead + _times(gain, innovation), P_ahead - gain @ P_ahead
        if slopes.shape[-1]:
            sensitivity = F[t] @ sensitivity + slopes[t]
            weighted = (S_inverse @ sensitivity)[heard]
            gradient -= np.tensordot(sensitivity, whitened, ((0, 1), (0, 1)))
            scores -= _times(sensitivity.swapaxes(1, 2), whitened)
            information += np.tensordot(sensitivity[heard], weighted, ((0, 1), (0, 1)))
            sensitivity = sensitivity - gain @ sensitivity
    xs, Ps, x_ahead, Ps_ahead = (np.stack(parts) for parts in zip(*history, strict=True))
    xs, Ps = np.concatenate([xs, x[None]]), np.concatenate([Ps, P[None]])
    return Filtered(xs, Ps, x_ahead, Ps_ahead, F, likelihood, gradient, information, scores)


def smoothed(found: Filtered) -> Array:
    """The estimates given all measurements, ``(T + 1, E, nx)``.

    ::

        x^_t = x_t + P_t F' (P-_{t+1})^-1 (x^_{t+1} - x-_{t+1})
    """
    result = found.x.copy()
    gains = found.P[:-1] @ found.F.swapaxes(2, 3) @ np.linalg.inv(found.P_ahead)
    for t in range(len(gains) - 1, -1, -1):
        result[t] += _times(gains[t], result[t + 1] - found.x_ahead[t])
    return result


def _times(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])
