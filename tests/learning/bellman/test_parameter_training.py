"""(FIT) step by step: stopping and going on, restarts, the prediction error besides, and what is said of bounds."""

from __future__ import annotations

import logging
from typing import Any

import casadi as ca
import lq_plant
import numpy as np
import pytest
import torch
from lq_plant import BEST, QuadraticValue

from mpcoffline.datasets import TransitionTable
from mpcoffline.learning import ParameterConfig, ParameterTraining
from mpcoffline.learning.bellman.equation import BellmanProblem, PredictionError
from mpcoffline.mpc import MPC, Model, Parameter

BOTH = ("cost", "model")
WRONG = (0.5 * lq_plant.A, 2.0 * lq_plant.B)


def training(mpc: MPC | None = None, groups: tuple[str, ...] = BOTH, **options: Any) -> ParameterTraining:
    config = ParameterConfig(**({"n_steps": 60, "batch_size": 64, "refit_iterations": 50} | options))
    value = QuadraticValue(BEST.P)
    return ParameterTraining(mpc or lq_plant.make_mpc(), value, lq_plant.random_log(400), groups, config, seed=0)


def test_going_on_after_a_skipped_step_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    honest, calls = BellmanProblem.error, 0

    def faulty(self: BellmanProblem, batch: Any, theta: torch.Tensor, constant: Any = None) -> torch.Tensor:
        nonlocal calls
        calls += theta.requires_grad
        return honest(self, batch, theta, constant) * (torch.nan if theta.requires_grad and calls == 5 else 1.0)

    monkeypatch.setattr(BellmanProblem, "error", faulty)
    whole = training()
    whole.advance(20)
    arrays = whole.to_arrays()
    whole.advance(40)
    part = training()
    part.restore(arrays)
    part.advance(40)
    np.testing.assert_array_equal(part.theta, whole.theta)


def test_no_finite_gradient_at_all_is_said(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    fit = training()
    honest = BellmanProblem.error
    monkeypatch.setattr(BellmanProblem, "error", lambda *arguments: torch.nan * honest(*arguments))
    fit.advance(5)
    assert "(FIT) did not move in 5 steps: no gradient was finite" in caplog.text


@pytest.mark.parametrize("stops", [(1,), (20, 45), (60,)])
def test_going_on_gives_the_same_bits(stops: tuple[int, ...]) -> None:
    whole = training()
    whole.advance(60)
    part = training()
    for stop in stops:
        part.advance(stop - part.step)
        arrays = part.to_arrays()
        part = training()
        part.restore(arrays)
        assert part.step == stop
    part.advance(60 - part.step)
    assert part.step == part.n_steps - 1
    np.testing.assert_array_equal(part.theta, whole.theta)
    np.testing.assert_array_equal(part.result.theta, whole.result.theta)


def test_the_prediction_error_is_its_formula() -> None:
    mpc, table = lq_plant.make_mpc(), lq_plant.random_log(200)
    problem = BellmanProblem(mpc, QuadraticValue(BEST.P), 1.0)
    sample = table.columns(torch.from_numpy(table.rows))
    s, a, reached = (
        np.asarray(c, dtype=np.float64) for c in (table.observations, table.actions, table.next_observations)
    )
    missed = reached - (s @ lq_plant.MODEL_A.T + a @ lq_plant.MODEL_B.T)
    expected = np.mean((missed / (reached - s).std(axis=0)) ** 2)
    theta = torch.from_numpy(mpc.theta)
    found = PredictionError(problem, sample, theta)(sample, theta)
    assert float(found) == pytest.approx(expected, rel=1e-6)


def test_full_turns_of_a_wrapped_angle_are_no_prediction_error() -> None:
    """The same motion, once with the angle as it is and once confined to [-pi, pi)."""

    def step(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return ca.vertcat(x[0] + 0.1 * x[1], x[1] + p["b"] * u[0])

    mpc = lq_plant.make_mpc().replace(model=Model(step, 2, 1, 0.1, {"b": 0.2}, discrete=True))
    rng = np.random.default_rng(0)
    s = np.c_[rng.uniform(-np.pi, np.pi, 400), rng.uniform(-3.0, 3.0, 400)]
    a = rng.uniform(-2.0, 2.0, (400, 1))
    reached = np.c_[s[:, 0] + 0.1 * s[:, 1], s[:, 1] + 0.1 * a[:, 0]]
    wrapped = np.c_[(reached[:, 0] + np.pi) % (2.0 * np.pi) - np.pi, reached[:, 1]]
    assert (np.abs(wrapped - reached) > 1.0).sum() > 10
    errors = []
    for following in (reached, wrapped):
        table = TransitionTable.from_arrays(s, a, a[:, 0] ** 2, following, np.zeros(400))
        sample = table.columns(torch.from_numpy(table.rows))
        theta = torch.from_numpy(mpc.theta)
        errors.append(
            float(PredictionError(BellmanProblem(mpc, QuadraticValue(BEST.P), 1.0), sample, theta)(sample, theta))
        )
    assert errors[1] == pytest.approx(errors[0], rel=1e-4)


def test_with_a_large_weight_the_model_is_identified() -> None:
    """(FIT) alone does not need the true model; the prediction error besides finds it."""
    mpc = lq_plant.make_mpc(WRONG)
    errors = []
    for weight in (0.0, 100.0):
        fit = training(mpc, n_steps=400, batch_size=400, prior=0.0, prediction_weight=weight, clip=1e6)
        while not fit.done:
            fit.advance(100)
        values = mpc.with_theta(fit.theta).values
        errors.append(max(np.abs(values["model.A"] - lq_plant.A).max(), np.abs(values["model.B"] - lq_plant.B).max()))
    assert errors[1] < 0.02 < errors[0]


@pytest.mark.parametrize("prior", [0.0, 10.0])
def test_a_fit_that_runs_off_begins_again_and_says_so(caplog: pytest.LogCaptureFixture, prior: float) -> None:
    fit = training(learning_rate=50.0, n_steps=5, n_restarts=2, prior=prior)
    with caplog.at_level(logging.WARNING):
        while not fit.done:
            fit.advance(5)
    assert (fit.attempt, fit.step, fit.n_steps) == (2, 6, 6)
    assert "starting again beside theta_0 (1 of at most 2 restarts)" in caplog.text
    result = fit.result
    assert "failed in every attempt; the model stays as it was" in caplog.text
    mpc = lq_plant.make_mpc()
    np.testing.assert_array_equal(mpc.with_theta(result.theta).values["model.A"], lq_plant.MODEL_A)
    assert result.loss_after < result.loss_before or prior > 0.0  # the cost is fitted all the same


def test_a_fixed_parameter_is_on_no_bound() -> None:
    model = Model(
        lambda x, u, p: lq_plant.A @ x + p["gain"] * ca.DM(lq_plant.B) @ u,
        2,
        1,
        0.1,
        {"gain": Parameter(1.0, low=1.0, high=1.0)},
        discrete=True,
    )
    fit = training(lq_plant.make_mpc().replace(model=model), n_steps=5)
    fit.advance(5)
    assert fit.result.at_bounds == ()


def test_parameters_that_end_on_a_bound_are_named(caplog: pytest.LogCaptureFixture) -> None:
    model = Model(
        lambda x, u, p: lq_plant.A @ x + p["gain"] * ca.DM(lq_plant.B) @ u,
        2,
        1,
        0.1,
        {"gain": Parameter(0.5, low=0.1, high=0.6)},  # the plant's is 1
        discrete=True,
    )
    fit = training(lq_plant.make_mpc().replace(model=model), n_steps=200, prior=0.0)
    while not fit.done:
        fit.advance(100)
    result = fit.result
    assert result.at_bounds == ("model.gain",)
    assert "ended on the bounds of model.gain" in caplog.text


def test_no_gradient_steps_leave_the_model_to_identification() -> None:
    mpc = lq_plant.make_mpc()
    fit = training(mpc, n_steps=0)
    assert fit.advance(5) == {"fit_loss": fit.result.loss_after}
    assert fit.done
    result = fit.result
    np.testing.assert_array_equal(mpc.with_theta(result.theta).values["model.A"], lq_plant.MODEL_A)
    assert result.loss_after < result.loss_before
