"""Multi-step identification and its check of structure, against scipy and simulated plants."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from logged_plants import TANK, TANK_DT, tank_log, tank_mpc, tank_rate
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.estimation import identify
from mpcoffline.estimation.identification import OneStepProblem
from mpcoffline.estimation.multi_step import MultiStepProblem, Windows
from mpcoffline.estimation.trajectories import Trajectories

Array = NDArray[np.float64]
NOISY = tank_log(4, 100, 0, noise=0.02)


def problem_of(length: int = 20) -> MultiStepProblem:
    mpc = tank_mpc()
    found = Trajectories.of(mpc, NOISY, ())
    return MultiStepProblem(
        mpc, Windows.of(found, length, length, full=True), OneStepProblem(mpc, found.rows()), spread=1e3
    )


def test_windows_are_stretches_of_the_log() -> None:
    found = Trajectories.of(tank_mpc(), NOISY, ())
    windows = Windows.of(found, 30, 30, full=False)
    assert len(windows) == 4 * 4  # 30, 30, 30 and 10 steps of each episode
    spread = NOISY.observations.std(axis=0)
    for w, row in enumerate(windows.rows):
        n = windows.valid[:, w].sum()
        assert n == (10 if w % 4 == 3 else 30)
        np.testing.assert_allclose(windows.y[:n, w] * spread, NOISY.observations[row : row + n], rtol=1e-5)
        np.testing.assert_allclose(windows.y[n, w] * spread, NOISY.next_observations[row + n - 1], rtol=1e-5)
        np.testing.assert_array_equal(windows.u[:n, w], NOISY.actions[row : row + n])
    assert len(Windows.of(found, 30, 30, full=True)) == 4 * 3
    assert len(Windows.of(found, 30, 10, full=True)) == 4 * 8


def test_a_simulation_is_scipys() -> None:
    problem = problem_of()
    windows = problem.windows
    z = problem.coordinates.z(tank_mpc(TANK).theta)
    error = problem.simulated(z, windows.y[0], slopes=False).error[:, 3]
    x = windows.y[0, 3] * windows.scale
    for t in range(20):
        valve, span = windows.u[t, 3, 0], (0.0, TANK_DT)
        x = scipy.integrate.solve_ivp(lambda _, y, v: tank_rate(y, v), span, x, args=(valve,), rtol=1e-9).y[:, -1]
        np.testing.assert_allclose(error[t + 1], x / windows.scale - windows.y[t + 1, 3], atol=5e-5)  # RK4


def test_the_minimum_is_scipys() -> None:
    problem = problem_of()
    z, starts, there = problem.fitted(np.zeros(3), 40)

    def residuals(flat: Array) -> Array:
        return problem.simulated(flat[:3], flat[3:].reshape(-1, 2), slopes=False).error.ravel()

    begin = np.concatenate([np.zeros(3), problem.windows.y[0].ravel()])
    expected = scipy.optimize.least_squares(residuals, begin, xtol=1e-10, ftol=1e-10)
    assert there.cost == pytest.approx(2.0 * expected.cost, rel=1e-6)
    np.testing.assert_allclose(z, expected.x[:3], atol=1e-4)
    np.testing.assert_allclose(starts.ravel(), expected.x[3:], atol=1e-4)


def test_the_information_is_that_of_the_full_least_squares_problem() -> None:
    problem = problem_of()
    z, starts, there = problem.fitted(np.zeros(3), 40)
    misfit = problem.misfit(z, starts, there, NOISY.episode_ids[problem.windows.rows])
    flat = np.concatenate([z, starts.ravel()])

    def residuals(at: Array) -> Array:
        return problem.simulated(at[:3], at[3:].reshape(-1, 2), slopes=False).error.ravel()

    jacobian = np.stack(
        [(residuals(flat + 1e-5 * e) - residuals(flat - 1e-5 * e)) / 2e-5 for e in np.eye(len(flat))], axis=1
    )
    variance = there.cost / (problem.count - len(flat))
    covariance = variance * np.linalg.inv(jacobian.T @ jacobian)[:3, :3]
    np.testing.assert_allclose(np.linalg.inv(misfit.information), covariance, rtol=1e-3)
    np.testing.assert_allclose(misfit.scores.sum(axis=0), 0.0, atol=0.05)  # at the minimum
    moved = misfit.value(z + 0.01) - misfit.value(z)
    assert moved == pytest.approx(np.full(3, 0.01) @ misfit.information @ np.full(3, 0.01), rel=0.1)


def test_bounds_hold() -> None:
    mpc = tank_mpc((0.05, 0.0004, 0.001))  # k1 may be 0.012 at most, and is 0.02
    found = identify(mpc, NOISY, horizon=25)
    assert found.theta[1] == pytest.approx(0.012)
    assert found.at_bound == ("model.k1",)


def test_parameters_are_found_by_many_steps() -> None:
    found = identify(tank_mpc(), NOISY, horizon=25)
    errors = np.abs(found.theta[:3] - TANK)
    assert (errors < 3.0 * found.deviation[:3]).all()
    np.testing.assert_allclose(found.theta[:3], TANK, rtol=0.02)
    with pytest.raises(InvalidArgumentError, match="horizon"):
        identify(tank_mpc(), NOISY, horizon=0)


# ---------------------------------------------------------------- the check of structure


def test_the_right_structure_is_not_suspicious() -> None:
    check = identify(tank_mpc(), tank_log(12, 120, 1, noise=0.01)).multi_step
    assert check is not None
    assert check.steps == (15, 50)
    assert not check.suspicious
    # What remains is the measured start and the measurement that is predicted, each of 1 %.
    assert check.errors[0] < 0.02
    assert "would save" not in str(check)
    exact = identify(tank_mpc(), tank_log(12, 120, 1)).multi_step  # other parameters may save what is next to nothing
    assert exact is not None
    assert not exact.suspicious


def test_an_unmodelled_dead_time_is_suspicious(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        check = identify(tank_mpc(), tank_log(12, 120, 1, delay=2)).multi_step
    assert check is not None
    assert check.suspicious
    assert "dead time" in caplog.text
    assert "Tried: the integrator (rk4:" in str(check)
    again = identify(tank_mpc(), tank_log(12, 120, 1, delay=2), tried=["a residual"]).multi_step
    assert again is not None
    assert "Tried: a residual; the integrator" in str(again)
    assert "None of them was varied" in str(replace(check, tried=()))


def test_a_log_without_stretches_says_nothing() -> None:
    lone = tank_log(300, 1, 0)
    assert identify(tank_mpc(), lone).multi_step is None


# ---------------------------------------------------------------- deviations, and what is left open


@pytest.mark.slow
def test_stated_deviations_cover_the_truth() -> None:
    off = []
    for seed in range(20):
        found = identify(tank_mpc(), tank_log(8, 120, seed, noise=0.013), seed=seed)
        assert not found.undetermined
        off.append((found.theta[:3] - TANK) / found.deviation[:3])
    inside = np.abs(np.array(off)) < 2.0
    assert (inside.mean(axis=0) >= 0.9).all()
    assert 0.4 < np.std(off) < 1.4  # and they are not merely large


@pytest.mark.parametrize("noise", [0.003, 0.006])
def test_little_noise_on_a_plant_that_is_sampled_often_biases_nothing(noise: float) -> None:
    found = identify(tank_mpc(), tank_log(20, 200, 0, noise=noise))
    off = (found.theta[:3] - TANK) / found.deviation[:3]
    assert (np.abs(off) < 3.0).all()
    assert found.error_after < 0.01  # of increments that the noise is 5 to 10 % of
