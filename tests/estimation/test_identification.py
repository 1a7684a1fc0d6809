"""Identification against numpy's least squares, true plants, and models that the data cannot tell apart."""

from __future__ import annotations

import logging
import warnings
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

import mpcoffline
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets import TransitionTable
from mpcoffline.estimation.identification import ABSURD, IdentificationConfig, OneStepProblem, identify_one_step
from mpcoffline.estimation.rows import Rows
from mpcoffline.mpc import MPC, Model, NormCost, Parameter, QuadraticCost
from mpcoffline.plants.nominal import nominal_mpc

Array = NDArray[np.float64]


def mpc_of(model: Model) -> MPC:
    cost = QuadraticCost(np.eye(model.nx), np.eye(model.nu))
    return MPC(model, cost, NormCost(np.zeros(model.nx)), 5, 0.9, [-10.0] * model.nu, [10.0] * model.nu)


def linear_mpc(A: Any, B: Any, **options: Any) -> MPC:
    parameters = {"A": Parameter(A, **options), "B": Parameter(B)}
    nx, nu = np.shape(B)
    return mpc_of(Model(lambda x, u, p: p["A"] @ x + p["B"] @ u, nx, nu, 0.1, parameters, discrete=True))


def table_of(x: Array, u: Array, reached: Array) -> TransitionTable:
    return TransitionTable.from_arrays(x, u, np.zeros(len(x)), reached, np.zeros(len(x)))


def inputs(n: int, nx: int, nu: int, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, nx)), rng.normal(size=(n, nu))


TRUE_A, TRUE_B = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[0.0], [0.1]])


def test_a_linear_model_is_numpys_least_squares() -> None:
    x, u = inputs(400, 2, 1)
    reached = x @ TRUE_A.T + u @ TRUE_B.T + 0.05 * np.random.default_rng(1).normal(size=x.shape)
    table = table_of(x, u, reached)
    result = identify_one_step(
        linear_mpc(np.eye(2), np.full((2, 1), 0.5)), table, IdentificationConfig(prior_spread=1e3)
    )
    regressors = np.hstack([table.observations, table.actions]).astype(np.float64)
    expected, *_ = np.linalg.lstsq(regressors, table.next_observations.astype(np.float64), rcond=None)
    np.testing.assert_allclose(result.theta[:4].reshape(2, 2), expected[:2].T, atol=1e-6)
    np.testing.assert_allclose(result.theta[4:6], expected[2], atol=1e-6)


def test_deviations_are_those_of_the_linear_regression() -> None:
    x, u = inputs(4_000, 1, 1)
    reached = 0.9 * x + 0.3 * u + 0.05 * np.random.default_rng(1).normal(size=x.shape)
    result = identify_one_step(linear_mpc([[1.0]], [[0.5]]), table_of(x, u, reached))
    covariance = 0.05**2 * np.linalg.inv(np.hstack([x, u]).T @ np.hstack([x, u]))
    np.testing.assert_allclose(result.deviation[:2], np.sqrt(np.diag(covariance)), rtol=0.05)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("task", "env_id"), [("pendulum", "PendulumSwingUp"), ("cartpole", "CartPoleSwingUp")])
@pytest.mark.usefixtures("shipped")
def test_the_swing_ups_parameters_are_found_from_far_away(task: str, env_id: str, seed: int) -> None:
    env_id = f"mpcoffline/{env_id}-v0"
    table = TransitionTable.from_minari(f"mpcoffline/{task}/ddpg-v0")
    mpc = nominal_mpc(env_id, alpha=1.5, seed=seed)
    result = identify_one_step(mpc, table, IdentificationConfig(rows=3_000))
    model = mpc.space.mask(("model",))
    np.testing.assert_allclose(result.theta[model], nominal_mpc(env_id).theta[model], rtol=1e-3)
    np.testing.assert_array_equal(result.theta[~model], mpc.theta[~model])
    assert result.error_after < 1e-3 < 0.1 < result.error_before
    assert not result.at_bound
    assert not result.undetermined


def test_errors_are_prediction_errors_in_spreads_of_the_increments() -> None:
    x, u = inputs(50, 2, 1)
    table = table_of(x, u, x @ TRUE_A.T + u @ TRUE_B.T + np.array([0.3, 0.0]))
    result = identify_one_step(linear_mpc(np.eye(2), np.zeros((2, 1))), table)
    s, reached = table.observations.astype(np.float64), table.next_observations.astype(np.float64)
    spread = (reached - s).std(axis=0)
    np.testing.assert_allclose(result.scale, spread, rtol=1e-6)
    expected = np.sqrt(np.mean(((reached - s) / spread) ** 2, axis=0))  # the first guess predicts no change
    np.testing.assert_allclose(result.errors_before, expected, rtol=1e-6)
    assert result.error_before == pytest.approx(np.sqrt(np.mean(expected**2)))


# ---------------------------------------------------------------- what the data leave open


def cart(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    return ca.vertcat(x[1], (p["gear"] * u - p["friction"] * x[1]) / p["mass"])


CART = {
    "mass": Parameter(2.0, low=0.01),
    "gear": Parameter(1.0, low=0.01),
    "friction": Parameter(0.3, low=0.001),
    "unused": Parameter(7.0, low=0.1),
}


def test_what_the_data_do_not_determine_is_named_and_stays_near_the_guess(caplog: pytest.LogCaptureFixture) -> None:
    mpc = mpc_of(Model(cart, 2, 1, 0.1, CART))
    true = mpc.with_theta(mpc.space.pack({"model.mass": 1.0, "model.gear": 1.5, "model.friction": 0.2}))
    x, u = inputs(500, 2, 1)
    with caplog.at_level(logging.WARNING):
        result = identify_one_step(mpc, table_of(x, u, true.model(x, u)))
        result.warn()
    mass, gear, friction, unused = result.theta[:4]
    assert (gear / mass, friction / mass) == pytest.approx((1.5, 0.2), rel=1e-4)
    assert unused == pytest.approx(7.0)
    assert 0.3 < mass < 4.0  # the nearest of all that explain the data
    assert len(result.undetermined) == 2
    text = " | ".join(result.undetermined)
    for name in ("model.mass", "model.gear", "model.friction", "model.unused"):
        assert name in text
    assert "do not determine" in caplog.text
    assert result.deviation[3] == pytest.approx(7.0, rel=0.01)  # as the prior has it


def test_data_without_excitation_change_nothing() -> None:
    x, u = np.zeros((40, 2)), np.zeros((40, 1))
    mpc = mpc_of(Model(cart, 2, 1, 0.1, CART))
    result = identify_one_step(mpc, table_of(x, u, x))
    np.testing.assert_allclose(result.theta, mpc.theta)
    assert len(result.undetermined) == 4


def test_a_bound_that_binds_is_named(caplog: pytest.LogCaptureFixture) -> None:
    x, u = inputs(300, 1, 1)
    mpc = linear_mpc([[0.2]], [[0.3]], low=0.0, high=0.5)
    with caplog.at_level(logging.WARNING):
        result = identify_one_step(mpc, table_of(x, u, 0.9 * x + 0.3 * u))
        result.warn()
    assert result.at_bound == ("model.A[0,0]",)
    assert result.theta[0] == pytest.approx(0.5, abs=1e-3)
    assert "model.A[0,0]" in caplog.text


def test_a_parameter_without_freedom_stays() -> None:
    x, u = inputs(300, 1, 1)
    mpc = linear_mpc([[0.2]], [[0.1]], low=0.2, high=0.2)
    result = identify_one_step(mpc, table_of(x, u, 0.2 * x + 0.3 * u))
    np.testing.assert_allclose(result.theta[:2], [0.2, 0.3], rtol=1e-5)


def test_a_model_without_parameters_is_returned_as_it_is() -> None:
    mpc = mpc_of(Model(lambda x, u, p: 0.9 * x + u, 1, 1, 0.1, discrete=True))
    x, u = inputs(20, 1, 1)
    result = identify_one_step(mpc, table_of(x, u, x))
    np.testing.assert_array_equal(result.theta, mpc.theta)
    assert result.error_before == result.error_after > 0.0


# ---------------------------------------------------------------- angles, bad starts, bad input


def pendulum(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    return ca.vertcat(x[1], p["g"] * ca.sin(x[0]) + p["b"] * u)


def test_wrapped_angles_are_compared_modulo_full_turns() -> None:
    mpc = mpc_of(Model(pendulum, 2, 1, 0.05, {"g": Parameter(10.0, low=1.0), "b": Parameter(1.0, low=0.1)}))
    true = mpc.with_theta(mpc.space.pack({"model.g": 14.7, "model.b": 3.0}))
    rng = np.random.default_rng(0)
    x = np.stack([rng.uniform(-np.pi, np.pi, 800), rng.uniform(-8, 8, 800)], axis=1)
    u = rng.uniform(-2, 2, (800, 1))
    reached = true.model(x, u)
    reached[:, 0] = (reached[:, 0] + np.pi) % (2 * np.pi) - np.pi
    assert (np.abs(reached[:, 0] - x[:, 0]) > 5.0).sum() > 10  # some do wrap
    result = identify_one_step(mpc, table_of(x, u, reached))
    assert result.unwrapped == (0,)
    np.testing.assert_allclose(result.theta[:2], [14.7, 3.0], rtol=1e-4)


def test_large_errors_alone_are_no_wrapped_angles() -> None:
    x, u = inputs(400, 1, 1)
    result = identify_one_step(linear_mpc([[1.0]], [[0.0]]), table_of(30.0 * x, u, 15.0 * x + u))
    assert result.unwrapped == ()
    assert result.theta[0] == pytest.approx(0.5, abs=1e-3)


def test_a_start_at_which_the_model_is_not_finite_is_left_behind() -> None:
    mpc = mpc_of(Model(lambda x, u, p: x * ca.sqrt(p["a"]) + u, 1, 1, 0.1, {"a": -0.3}, discrete=True))
    x, u = inputs(300, 1, 1)
    result = identify_one_step(mpc, table_of(x, u, 0.8 * x + u), IdentificationConfig(restarts=20, prior_spread=5.0))
    assert result.theta[0] == pytest.approx(0.64, abs=1e-3)
    assert np.isfinite(result.errors_before).all()


@settings(max_examples=15, deadline=None)
@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.integers(0, 99))
def test_units_do_not_matter(log_x: float, log_u: float, seed: int) -> None:
    unit_x, unit_u = 10.0**log_x, 10.0**log_u
    x, u = inputs(100, 1, 1, seed)
    reached = 0.9 * x + 0.3 * u + 0.01 * np.random.default_rng(seed + 1000).normal(size=x.shape)
    plain = identify_one_step(linear_mpc([[0.5]], [[0.2]]), table_of(x, u, reached))
    scaled = identify_one_step(
        linear_mpc([[0.5]], [[0.2 * unit_x / unit_u]]), table_of(unit_x * x, unit_u * u, unit_x * reached)
    )
    np.testing.assert_allclose(scaled.theta[:2] * [1.0, unit_u / unit_x], plain.theta[:2], rtol=1e-4, atol=1e-5)
    assert scaled.error_after == pytest.approx(plain.error_after, rel=1e-3)


@pytest.mark.usefixtures("shipped")
def test_the_same_seed_gives_the_same_bits() -> None:
    table = TransitionTable.from_minari("mpcoffline/pendulum/ddpg-v0")
    mpc = nominal_mpc("mpcoffline/PendulumSwingUp-v0", alpha=1.0, seed=3)
    config = IdentificationConfig(rows=500)
    first, again, other = (identify_one_step(mpc, table, config, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.theta, again.theta)
    assert (first.theta != other.theta).any()


@pytest.mark.parametrize("bad", [{"rows": 0}, {"prior_spread": 0.0}, {"max_iterations": 2.5}, {"restarts": -1}])
def test_a_configuration_out_of_range_is_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(InvalidArgumentError, match=next(iter(bad))):
        IdentificationConfig(**bad)


def test_data_of_another_plant_are_refused() -> None:
    x, u = inputs(10, 2, 1)
    with pytest.raises(InvalidDataError, match="observations"):
        identify_one_step(mpcoffline.nominal_mpc("mpcoffline/PendulumSwingUp-v0"), table_of(x, u, x))


def wavy(w: float) -> MPC:
    """A model whose error has many minima in its frequency."""
    step = {"w": Parameter(w, low=0.1, high=20.0)}
    return mpc_of(Model(lambda x, u, p: 0.5 * x + u + ca.sin(p["w"] * x), 1, 1, 0.1, step, discrete=True))


def test_an_earlier_model_is_where_the_search_begins_too() -> None:
    """By hand: from w = 1.2 a descent ends in a minimum far from the true w = 7, from an earlier 6.8 it ends there."""
    x, u = inputs(300, 1, 1)
    table = table_of(2.0 * x, u, x + u + np.sin(7.0 * 2.0 * x))
    cold = mpcoffline.estimation.identify(wavy(1.2), table)
    assert abs(cold.theta[0] - 7.0) > 1.0
    warm = mpcoffline.estimation.identify(wavy(1.2), table, start=wavy(6.8))
    assert warm.theta[0] == pytest.approx(7.0, abs=1e-3)
    assert warm.error_after < 0.1 * cold.error_after
    # Of both ends the better one counts; an MPC without such a parameter, or of another shape, tells nothing.
    assert mpcoffline.estimation.identify(wavy(6.8), table, start=wavy(1.2)).theta[0] == pytest.approx(7.0, abs=1e-3)
    other = linear_mpc(np.eye(2), np.ones((2, 1)))
    np.testing.assert_array_equal(mpcoffline.estimation.identify(wavy(1.2), table, start=other).theta, cold.theta)


def test_errors_as_large_as_numbers_are_finite_and_nothing_is_said() -> None:
    """f(1e6) = 1e308 counts by its logarithm, f(1e7) is not finite: a wall. Neither warns."""
    far = Model(lambda x, u, p: p["a"] * 1e302 * x + u, 1, 1, 0.1, {"a": Parameter(1.0, low=0.1)}, discrete=True)
    x = np.array([[1e6], [1e6], [1e7]])
    problem = OneStepProblem(mpc_of(far), Rows(x, np.zeros((3, 1)), x + np.array([[0.0], [1.0], [2.0]])))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        errors, jacobian = problem.linearised(np.zeros(1))
    logarithm = 308.0 * np.log(10.0) - np.log(problem.scale[0]) - np.log(ABSURD)
    assert errors[:, 0] == pytest.approx([ABSURD * (1.0 + logarithm)] * 2 + [ABSURD])
    assert jacobian[:, 0, 0] == pytest.approx([ABSURD, ABSURD, 0.0])
