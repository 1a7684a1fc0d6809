"""Filter and smoother against the joint Gaussian distribution of states and measurements."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from numpy.typing import NDArray

from mpcoffline.estimation.kalman import Linearised, filtered, smoothed

Array = NDArray[np.float64]

F = np.array([[1.0, 0.2], [-0.3, 0.9]])
MEASUREMENT, PROCESS = np.array([0.3, 0.1]), np.array([0.05, 0.2])
STEPS = 5


def linear_data(offset: float = 0.4, n: int = 3, counts: float = 1.0) -> Linearised:
    """Measurements of x+ = F x + offset; linearised about arbitrary states."""
    rng = np.random.default_rng(0)
    measured, about = rng.normal(size=(STEPS + 1, n, 2)), rng.normal(size=(STEPS, n, 2))
    return Linearised(
        measured,
        np.full((STEPS + 1, n), counts),
        np.ones((STEPS, n), dtype=bool),
        about,
        about @ F.T + offset,
        np.broadcast_to(F, (STEPS, n, 2, 2)),
        np.ones((STEPS, n, 2, 1)),
    )


def joint(offset: float, y0: Array, counts: float = 1.0) -> tuple[Array, Array]:
    """Mean and covariance of x_0 ... x_T, when all that is known is the first measurement."""
    mean, covariance = [y0], np.zeros((2 * STEPS + 2, 2 * STEPS + 2))
    covariance[:2, :2] = np.diag(MEASUREMENT**2) / counts
    for t in range(STEPS):
        mean.append(F @ mean[-1] + offset)
        a, b = slice(2 * t, 2 * t + 2), slice(2 * t + 2, 2 * t + 4)
        covariance[b, : b.start] = F @ covariance[a, : b.start]
        covariance[: b.start, b] = covariance[b, : b.start].T
        covariance[b, b] = F @ covariance[a, a] @ F.T + np.diag(PROCESS**2)
    return np.concatenate(mean), covariance


@pytest.mark.parametrize("counts", [1.0, 2.0])
def test_the_smoother_is_the_conditional_mean_of_the_joint_distribution(counts: float) -> None:
    data = linear_data(counts=counts)
    result = smoothed(filtered(data, MEASUREMENT, PROCESS))
    for e in range(3):
        mean, covariance = joint(0.4, data.measured[0, e], counts)
        later = slice(2, None)
        noise = np.kron(np.eye(STEPS), np.diag(MEASUREMENT**2)) / counts
        gain = covariance[:, later] @ np.linalg.inv(covariance[later, later] + noise)
        expected = mean + gain @ (data.measured[1:, e].ravel() - mean[later])
        np.testing.assert_allclose(result[:, e].ravel(), expected, atol=1e-12)


def likelihood(offset: float) -> float:
    """Minus twice the log density of all measurements after the first, summed over trajectories."""
    data, total = linear_data(offset), 0.0
    for e in range(3):
        mean, covariance = joint(offset, data.measured[0, e])
        noisy = covariance[2:, 2:] + np.kron(np.eye(STEPS), np.diag(MEASUREMENT**2))
        total -= 2.0 * scipy.stats.multivariate_normal(mean[2:], noisy).logpdf(data.measured[1:, e].ravel())
    return total - 3 * 2 * STEPS * np.log(2.0 * np.pi)


def test_the_likelihood_is_the_density_of_the_measurements() -> None:
    assert filtered(linear_data(), MEASUREMENT, PROCESS).likelihood == pytest.approx(likelihood(0.4))


def test_gradient_and_information_are_derivatives_of_the_likelihood() -> None:
    found, step = filtered(linear_data(), MEASUREMENT, PROCESS), 1e-3
    low, middle, high = (likelihood(0.4 + s) for s in (-step, 0.0, step))
    assert found.gradient[0] == pytest.approx((high - low) / (4.0 * step), rel=1e-6)
    assert found.information[0, 0] == pytest.approx((high - 2.0 * middle + low) / (2.0 * step**2), rel=1e-4)


def test_an_ended_trajectory_does_not_depend_on_its_padding() -> None:
    data = linear_data()
    valid, counts, measured = data.valid.copy(), data.counts.copy(), data.measured.copy()
    valid[3:, 1], counts[4:, 1], measured[4:, 1] = False, 0.0, 1e6
    padded = smoothed(filtered(data._replace(valid=valid, counts=counts, measured=measured), MEASUREMENT, PROCESS))
    short = Linearised(*(part[: 4 if i < 2 else 3] for i, part in enumerate(data)))
    alone = smoothed(filtered(short, MEASUREMENT, PROCESS))
    np.testing.assert_allclose(padded[:4, 1], alone[:, 1], atol=1e-12)
    np.testing.assert_allclose(padded[:, [0, 2]], smoothed(filtered(data, MEASUREMENT, PROCESS))[:, [0, 2]], atol=1e-12)


def test_a_state_that_was_not_measured_is_bridged() -> None:
    data = linear_data()
    counts, measured = data.counts.copy(), data.measured.copy()
    counts[2], measured[2] = 0.0, 1e3
    x = smoothed(filtered(data._replace(counts=counts, measured=measured), MEASUREMENT, PROCESS))
    assert np.abs(x).max() < 10.0
