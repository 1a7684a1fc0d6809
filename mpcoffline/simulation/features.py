"""Regression on random features: functions learned in a second that need no tuning."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_RIDGE = 1e-7  # relative to the mean square of the features


class RandomFeatures:
    """1, x, all products of two entries of x, and hyperbolic tangents of random directions; x standardised.

    Args:
        x: Data that decide the scale, ``(n, d)``.
        n_random: Number of random directions.
        rng: Draws them.
        quadratic: Whether products are among the features.
    """

    def __init__(self, x: Array, n_random: int, rng: np.random.Generator, *, quadratic: bool = True) -> None:
        self._mean, spread = x.mean(axis=0), x.std(axis=0)
        self._spread = np.where(spread > 0.0, spread, 1.0)
        self._directions = rng.standard_normal((x.shape[1], n_random))
        self._offsets = rng.uniform(-2.0, 2.0, n_random)
        self._pairs = np.triu_indices(x.shape[1]) if quadratic else (np.zeros(0, int), np.zeros(0, int))

    def __call__(self, x: Array) -> Array:
        """Features of x ``(n, d)``, ``(n, m)``."""
        z = (x - self._mean) / self._spread
        first, second = self._pairs
        waves = np.tanh(z @ self._directions + self._offsets)
        return np.hstack([np.ones((len(z), 1)), z, z[:, first] * z[:, second], waves])


class Ridge(NamedTuple):
    """A linear map of features.

    Attributes:
        weights: ``(m, d)``.
    """

    weights: Array

    @classmethod
    def fit(cls, features: Array, targets: Array, ridge: float = _RIDGE) -> Ridge:
        """Least squares with a small l2 penalty.

        Args:
            features: ``(n, m)``.
            targets: ``(n, d)``.
            ridge: Penalty relative to the mean square of the features.
        """
        gram = features.T @ features
        penalty = ridge * np.trace(gram) / len(gram)
        return cls(np.linalg.solve(gram + penalty * np.eye(len(gram)), features.T @ targets))

    def __call__(self, features: Array) -> Array:
        """The targets predicted, ``(n, d)``."""
        return np.asarray(features @ self.weights)
