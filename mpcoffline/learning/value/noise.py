"""How noisy the logged plant is, by data alone: it decides how the low expectile of (VALUE) may be taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.features import RandomFeatures

# On the logs that ship, with noise added, the low expectile of samples came closer to V* than implicit Q-learning up to
# half noise in s+ - s: V is smooth, and its targets are held in bounds. Noise in L goes into the target as it is.
NOISY_CHANGE, NOISY_COST = 0.5, 0.1
_MIN_ROWS, _MAX_ROWS = 10, 20_000
_FEATURES = 300
_MULTIPLIED, _FLATTEST = 20, 0.2  # coordinates; slope, relative to the steepest
_RIDGES = (1e-8, 1e-5, 1e-3, 1e-1)  # few rows need the large ones


@dataclass(frozen=True)
class Stochasticity:
    """What (s, a) leaves open of a transition: shares of variance, 0 for a deterministic plant, 1 for pure noise.

    Attributes:
        change: Share of the variance of s+ - s, mean over the coordinates that change. Measurement noise on s and s+
            counts too: it is noise to whoever sees the data alone.
        cost: Share of the variance of L.
    """

    change: float
    cost: float

    @property
    def is_noisy(self) -> bool:
        """Whether either share is so large that V should be averaged over the noise before a low expectile is taken."""
        return self.change > NOISY_CHANGE or self.cost > NOISY_COST


def estimate_stochasticity(table: TransitionTable, *, seed: int = 0) -> Stochasticity:
    """Estimates how noisy s+ and L are given (s, a).

    ::

        share = Var[y - E(y | s, a)] / Var[y],       y = s+ - s per coordinate, or L

    where no episode ends, with E(y | s, a) from ridge regression on products and random features tanh(w'(s, a) + b) of
    one half of (at most 20,000) rows, and the variances of the other half. What the features cannot express counts as
    noise: under 1 % of the variance on the tasks that ship.

    Args:
        table: The transitions.
        seed: Seeds rows and features.

    Returns:
        Shares in [0, 1]; 0 for what does not vary, and for fewer than 20 rows, which tell nothing.
    """
    rng = np.random.default_rng(seed)
    rows = next(table.batches(_MAX_ROWS, rng, epochs=1)).numpy().astype(np.float64)
    rows = rows[rows[:, -1] == 0.0]  # what it costs that an episode ends is no noise
    sample = table.columns(rows)
    x = np.hstack([sample.observations, sample.actions])
    y = np.column_stack([sample.next_observations - sample.observations, sample.costs])
    half = len(rows) // 2
    if half < _MIN_ROWS:
        return Stochasticity(0.0, 0.0)
    features = RandomFeatures(x, _FEATURES, rng, multiplied=_MULTIPLIED, flattest=_FLATTEST)
    shares = _unexplained(features(x), _standardised(y), half)
    changes = shares[:-1][np.ptp(y[:, :-1], axis=0) > 0.0]
    return Stochasticity(float(changes.mean()) if len(changes) else 0.0, float(shares[-1]))


def _standardised(x: Array) -> Array:
    std = x.std(axis=0)
    return np.asarray((x - x.mean(axis=0)) / np.where(std > 0.0, std, 1.0))


def _unexplained(features: Array, y: Array, half: int) -> Array:
    """Share of each column's variance in the second half that the best of the regressions on the first leaves."""
    known, unseen = features[:half], features[half:]
    gram, moments = known.T @ known, known.T @ y[:half]
    total = np.square(y[half:] - y[:half].mean(axis=0)).mean(axis=0)
    shares = [np.ones(y.shape[1])]
    for ridge in _RIDGES:
        weights = np.linalg.solve(gram + ridge * half * np.eye(len(gram)), moments)
        left = np.square(y[half:] - unseen @ weights).mean(axis=0)
        shares.append(np.divide(left, total, out=np.zeros_like(left), where=total > 0.0))
    return np.asarray(np.min(shares, axis=0))
