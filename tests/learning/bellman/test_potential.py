"""Potential shaping: the stage cost becomes richer, Theorem 1 keeps holding."""

from __future__ import annotations

import json

import lq_plant
import numpy as np
import pytest
import torch
from lq_plant import BEST, DISCOUNT, MODEL_A, MODEL_B, QuadraticValue
from riccati import optimum

from mpcoffline.learning import FitResult, ParameterConfig, fit_parameters
from mpcoffline.learning.bellman.potential import Potential
from mpcoffline.mpc import MPC


def fitted(mpc: MPC, *, potential: bool) -> FitResult:
    config = ParameterConfig(prior=0.0, potential=potential, refit_iterations=2_000)
    return fit_parameters(mpc, QuadraticValue(BEST.P), lq_plant.random_log(2_000), ("cost",), config, seed=0)


def test_it_is_every_polynomial_of_degree_two_without_constant() -> None:
    rng = np.random.default_rng(0)
    s = torch.from_numpy(rng.normal(size=(50, 3)) * [1.0, 1e3, 1e-3] + [5.0, 0.0, 2.0])
    potential = Potential(s)
    potential.coefficients = torch.from_numpy(rng.normal(size=potential.coefficients.shape))
    z = ((s - s.mean(0)) / s.std(0, correction=0)).numpy()
    squares = [z[:, i] * z[:, j] for i in range(3) for j in range(i, 3)]
    expected = np.column_stack([z, *squares]) @ potential.coefficients.numpy()
    np.testing.assert_allclose(potential(s).numpy(), expected, rtol=1e-12, atol=1e-12)
    assert potential(torch.from_numpy(s.mean(0).numpy()[None])).abs() < 1e-12


def test_it_survives_json() -> None:
    s = torch.from_numpy(np.random.default_rng(1).normal(size=(20, 2)))
    potential = Potential(s)
    potential.coefficients += 0.3
    again = Potential.from_json(json.loads(json.dumps(potential.to_json())))
    np.testing.assert_array_equal(again(s).numpy(), potential(s).numpy())


def test_a_constant_coordinate_does_no_harm() -> None:
    potential = Potential(torch.full((10, 2), 3.0))
    potential.coefficients += 1.0
    assert torch.isfinite(potential(torch.full((4, 2), 3.0))).all()


def test_the_cost_explains_more_with_it() -> None:
    mpc = lq_plant.make_mpc()
    plain, shaped = (fitted(mpc, potential=potential) for potential in (False, True))
    assert plain.potential is None
    assert plain.loss_after > 1e-4  # W and R alone cannot express Q* - gamma V*(f)
    assert shaped.loss_after < 1e-3 * plain.loss_after
    assert shaped.potential is not None


def test_the_gain_is_optimal_with_a_wrong_model_and_no_cross_term() -> None:
    """(THM) with Lhat' = Lhat + Phi(s) - gamma Phi(f) and T = V*: solve with Lhat and T = V* - Phi instead."""
    mpc = lq_plant.make_mpc()
    result = fitted(mpc, potential=True)
    learned = mpc.with_theta(result.theta).values
    assert result.potential is not None
    hessian = torch.autograd.functional.hessian(lambda s: result.potential(s[None])[0], torch.zeros(2).double())
    P = BEST.P - 0.5 * hessian.numpy()
    AB = np.hstack([MODEL_A, MODEL_B])
    for _ in range(10):  # the Riccati recursion of the MPC, from its end
        Q = DISCOUNT * AB.T @ P @ AB
        Q[:2, :2] += learned["stage_cost.W"]
        Q[2:, 2:] += learned["stage_cost.R"]
        gain = -np.linalg.solve(Q[2:, 2:], Q[2:, :2])
        P = Q[:2, :2] + Q[:2, 2:] @ gain
    np.testing.assert_allclose(gain, BEST.K, atol=5e-3)
    nominal = optimum(MODEL_A, MODEL_B, lq_plant.W, lq_plant.R, DISCOUNT).K
    assert np.abs(nominal - BEST.K).max() > 0.1  # what the model alone would have given


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_after_a_terminal_state_it_vanishes(share: float) -> None:
    """Where every transition terminates, the columns are those of Phi(s) alone: L = Lhat + Phi(s)."""
    table = lq_plant.random_log(500)
    rows = table.rows.copy()
    rows[:, -1] = share
    ended = type(table)(rows, 2, 1, table.episode_ids)
    config = ParameterConfig(prior=1e-9, potential=True)
    result = fit_parameters(lq_plant.make_mpc(), QuadraticValue(BEST.P), ended, ("cost",), config, seed=0)
    assert np.isfinite(result.theta).all()
    assert result.loss_after < (1e-6 if share else 1e-3)
