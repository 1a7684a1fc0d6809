"""The parts of a diagnosis against closed forms."""

from __future__ import annotations

import lq_plant
import numpy as np
import pytest
from lq_episodes import episodes
from lq_plant import BEST, DISCOUNT, QuadraticValue
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable
from mpcoffline.diagnostics.measures import (
    bound_names,
    fit_errors,
    goal_check,
    lag_check,
    one_step_error,
    outside_support,
    returns_of,
    value_check,
)
from mpcoffline.diagnostics.stability import closed_loop_eigenvalues, value_growth, weight_checks
from mpcoffline.estimation.features import RandomFeatures, Ridge
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.mpc import MPC, Model, NormCost, Parameter, QuadraticCost
from mpcoffline.simulation.logged_cost import LoggedCost
from mpcoffline.solvers import make_solver

Array = NDArray[np.float64]

TRUE_MPC = lq_plant.make_mpc((lq_plant.A, lq_plant.B))


LOG = episodes()


# ---------------------------------------------------------------- regressions


def test_quadratics_are_in_the_span_of_the_features() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(200, 3)) * [1.0, 1e3, 1e-3]
    target = (x @ np.array([[1.0], [1e-3], [1e3]]) + 2.0) ** 2
    features = RandomFeatures(x, 0, rng)
    np.testing.assert_allclose(Ridge.fit(features(x), target, 1e-12)(features(x)), target, atol=1e-6)


def test_a_quadratic_cost_is_found_exactly() -> None:
    cost = LoggedCost(LOG)
    assert cost.exact
    assert cost.r2 > 1.0 - 1e-6
    x, u = np.array([[3.0, -2.0]]), np.array([[1.5]])  # far outside the data
    expected = lq_plant.quadratic(lq_plant.W, x) + lq_plant.quadratic(lq_plant.R, u)
    np.testing.assert_allclose(cost(x, u, x), expected, rtol=1e-3)
    assert cost(np.zeros((1, 2)), np.zeros((1, 1)), np.zeros((1, 2))) == pytest.approx(
        0.0, abs=1e-4
    )  # cheaper than anything logged
    assert cost.low == LOG.costs.min() > 0.0


def test_the_cost_of_the_mpc_is_used_where_it_is_the_logged_one() -> None:
    """Of any sign, beyond all data, and where the states are noisy."""
    s, a = (v.astype(np.float64) for v in (LOG.observations, LOG.actions))
    noisy = s + 0.02 * np.random.default_rng(0).normal(size=s.shape)
    costs = 2.0 * LOG.costs - 5e3
    table = TransitionTable.from_arrays(noisy, a, costs, LOG.next_observations, LOG.terminations, LOG.episode_ids)
    cost = LoggedCost(table, mpc=lq_plant.make_mpc())
    assert cost.exact
    x, u = np.array([[3.0, -2.0], [0.0, 0.0]]), np.array([[1.5], [0.0]])
    expected = 2.0 * (lq_plant.quadratic(lq_plant.W, x) + lq_plant.quadratic(lq_plant.R, u)) - 5e3
    np.testing.assert_allclose(cost(x, u, x), expected, atol=0.1)


def test_another_cost_is_learned_with_random_features() -> None:
    rng = np.random.default_rng(0)
    s, a = rng.uniform(-1, 1, (4_000, 2)), rng.uniform(-1, 1, (4_000, 1))
    costs = np.abs(s[:, 0]) + np.sin(3.0 * s[:, 1]) + a[:, 0] ** 2
    table = TransitionTable.from_arrays(s, a, costs, s, np.zeros(4_000), np.arange(4_000) // 50)
    cost = LoggedCost(table)
    assert not cost.exact
    assert cost.r2 > 0.99
    shuffled = TransitionTable.from_arrays(s, a, rng.permutation(costs), s, np.zeros(4_000), np.arange(4_000) // 50)
    assert LoggedCost(shuffled).r2 < 0.1


def test_a_constant_cost_is_learned() -> None:
    s = np.random.default_rng(0).normal(size=(100, 2))
    cost = LoggedCost(TransitionTable.from_arrays(s, s[:, :1], np.full(100, 3.0), s, np.zeros(100)))
    np.testing.assert_allclose(cost(s, s[:, :1], s), 3.0, rtol=1e-5)


# ---------------------------------------------------------------- ensemble and simulation


# ---------------------------------------------------------------- measures


def test_returns_are_discounted_sums_where_they_are_complete() -> None:
    costs = np.arange(1.0, 101.0)
    s = np.linspace(0.0, 1.0, 100)[:, None]
    table = TransitionTable.from_arrays(s, s, costs, s, np.zeros(100), np.zeros(100, int))
    value = QuadraticValue(np.eye(1))
    predicted, measured = returns_of(value, table, 0.9)
    assert len(measured) == 100 - 29  # 0.9^29 < 5 %
    np.testing.assert_allclose(measured[3], sum(0.9**k * costs[3 + k] for k in range(97)))
    np.testing.assert_allclose(predicted, s[:71, 0] ** 2, rtol=1e-6)


def test_v_against_returns() -> None:
    log = episodes(n=30, steps=60)
    good = value_check(QuadraticValue(BEST.P), log, DISCOUNT)
    bad = value_check(QuadraticValue(100.0 * BEST.P), log, DISCOUNT)
    assert good.n > 50
    assert good.correlation > 0.5
    assert bad.bias > good.bias
    assert bad.above > 0.5
    assert value_check(QuadraticValue(BEST.P), episodes(n=3, steps=5), DISCOUNT).n == 0


def test_errors_of_fit_are_those_of_the_exact_cost() -> None:
    nominal = lq_plant.make_mpc()
    value = QuadraticValue(BEST.P)
    found = {part.name: part for part in fit_errors(nominal, TRUE_MPC, value, LOG, None)}
    assert found["all data"].after < 1e-10  # the true model and cost explain everything, for any V
    assert len(found) == 5
    s, a = (v.astype(np.float64) for v in (LOG.observations, LOG.actions))
    reached, wrong = LOG.next_observations.astype(np.float64), nominal.model(s, a)
    missed = DISCOUNT * (lq_plant.quadratic(BEST.P, reached) - lq_plant.quadratic(BEST.P, wrong))
    assert found["all data"].before == pytest.approx(np.var(missed) / LOG.costs.var(), rel=1e-4)  # but a constant


def test_one_step_errors() -> None:
    assert one_step_error(TRUE_MPC, LOG) < 1e-5
    still = lq_plant.make_mpc((np.eye(2), np.zeros((2, 1))))
    spread = (LOG.next_observations - LOG.observations).astype(np.float64)
    assert one_step_error(still, LOG) == pytest.approx(np.sqrt(np.mean((spread / spread.std(axis=0)) ** 2)), rel=1e-4)


def test_states_far_from_the_data_are_outside_their_support() -> None:
    inside, outside = LOG.observations[::7].astype(np.float64), np.full((30, 2), 50.0)
    assert outside_support(LOG, inside) < 0.03
    assert outside_support(LOG, np.concatenate([inside[:30], outside])) == pytest.approx(0.5, abs=0.03)
    assert outside_support(LOG, np.full((2, 2), np.nan)) == 1.0


def test_a_late_input_is_found_and_a_wrong_structure_is_not_taken_for_one() -> None:
    for log, found in ((episodes(lag=1), True), (episodes(friction=0.1), False), (LOG, False)):
        mpc = lq_plant.make_mpc()
        known = mpc.with_theta(identify_one_step(mpc, log).theta)
        assert lag_check(known, log).found == found
    assert not lag_check(TRUE_MPC, episodes(n=2, steps=5)).found


def test_whether_the_log_reaches_the_goal() -> None:
    near, far = (
        goal_check(lq_plant.make_mpc(stage_cost=QuadraticCost(lq_plant.W, lq_plant.R, x_ref=x)), LOG)
        for x in ([0.0, 0.0], [30.0, 0.0])
    )
    assert near is not None
    assert far is not None
    assert near.share > 0.01
    assert not near.missed
    assert far.share == 0.0
    assert far.missed
    np.testing.assert_array_equal(lq_plant.make_mpc().reference, [0.0, 0.0])


def test_parameters_on_a_bound_are_named() -> None:
    model = Model(
        lambda x, u, p: p["a"] * x + p["b"] * u, 1, 1, 0.1, {"a": Parameter(0.5, 0.0, 1.0), "b": 1.0}, discrete=True
    )
    mpc = MPC(model, QuadraticCost([[1.0]], [[1.0]]), NormCost([0.0]), 5, 0.9, [-1.0], [1.0])
    moved = mpc.with_theta(mpc.space.pack({"model.a": 1.0, "stage_cost.W": [[0.0]]}))
    x, u = np.random.default_rng(0).normal(size=(2, 50, 1))
    log = TransitionTable.from_arrays(x, u, (x**2)[:, 0], 0.9 * x + u, np.zeros(50))
    assert bound_names(moved, mpc, log) == ("model.a",)
    assert bound_names(mpc, mpc, log) == ()


# ---------------------------------------------------------------- stability


def test_eigenvalues_are_those_of_the_optimal_closed_loop() -> None:
    found = closed_loop_eigenvalues(TRUE_MPC, make_solver(TRUE_MPC), LOG, np.zeros(2))
    expected = np.sort(np.abs(np.linalg.eigvals(lq_plant.A + lq_plant.B @ BEST.K)))[::-1]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_direction_that_the_plant_never_takes_is_left_out() -> None:
    angle = np.random.default_rng(0).uniform(-np.pi, np.pi, 3_000)
    s = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    table = TransitionTable.from_arrays(s, s[:, :1], angle**2, s, np.zeros(3_000))
    model = Model(lambda x, u, p: x * np.array([2.0, 0.5]), 2, 1, 0.1, discrete=True)  # the radius grows
    mpc = MPC(model, QuadraticCost(np.eye(2), [[1.0]], x_ref=[1.0, 0.0]), NormCost([1.0, 0.0]), 3, 0.9, [-1.0], [1.0])
    found = closed_loop_eigenvalues(mpc, make_solver(mpc, "ipopt"), table, np.array([1.0, 0.0]))
    np.testing.assert_allclose(found, [0.5], atol=1e-2)


def test_growth_of_v_and_weights() -> None:
    value = QuadraticValue(np.eye(2))
    inside = LOG.observations.astype(np.float64)
    assert value_growth(value, LOG, inside, lost=False) == pytest.approx(1.0, abs=0.1)
    assert value_growth(value, LOG, 10.0 * inside, lost=False) > 50.0
    assert value_growth(value, LOG, inside, lost=True) == np.inf
    W, R = weight_checks(TRUE_MPC, lq_plant.make_mpc(W=np.diag([5.0, 2.0])), LOG)
    first, second = LOG.observations.var(axis=0)  # weights are in spreads of what they weigh
    assert W.before == pytest.approx(sorted((first, 0.1 * second)), rel=1e-5)
    assert W.after == pytest.approx(sorted((5.0 * first, 2.0 * second)), rel=1e-5)
    assert R.before == R.after == pytest.approx((0.1 * LOG.actions.var(),), rel=1e-5)
