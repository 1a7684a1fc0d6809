"""Regression on random features: functions learned in a second that need no tuning."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc.scaling import spread_of

_RIDGE = 1e-7  # relative to the mean square of the features


class RandomFeatures:
    """1, x, products of two entries of x, and hyperbolic tangents of random directions; x standardised.

    Args:
        x: Data that decide the scale, ``(n, d)``.
        n_random: Number of random directions.
        rng: Draws them.
        multiplied: How many entries have products, the first ones; all by default.
        flattest: Slope of the flattest hyperbolic tangents, relative to the steepest; by default all are alike.
    """

    def __init__(
        self,
        x: Array,
        n_random: int,
        rng: np.random.Generator,
        *,
        multiplied: int | None = None,
        flattest: float = 1.0,
    ) -> None:
        self._mean, self._spread = x.mean(axis=0), spread_of(x)
        self._directions = rng.standard_normal((x.shape[1], n_random))
        if flattest < 1.0:
            self._directions *= rng.uniform(flattest, 1.0, n_random)
        self._offsets = rng.uniform(-2.0, 2.0, n_random)
        self._pairs = np.triu_indices(x.shape[1] if multiplied is None else min(x.shape[1], multiplied))

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
