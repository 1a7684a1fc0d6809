"""A plant whose states lie at a large offset is learned as well as the same plant around zero."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mpcoffline import MPC, Model, OfflineMPCLearner, Parameter, QuadraticCost
from mpcoffline.datasets import TransitionTable
from mpcoffline.diagnostics.measures import one_step_error, outside_support
from mpcoffline.estimation import estimate_noise, identify, with_measurement_noise
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.learning import ValueFunction
from mpcoffline.learning.terminal import fit_terminal, terminal_error
from mpcoffline.learning.value.noise import estimate_stochasticity
from mpcoffline.learning.value.units import Units
from mpcoffline.simulation.logged_cost import LoggedCost

Array = NDArray[np.float64]
FAR = 1e6  # m
QUICK: dict[str, Any] = {
    "value_n_steps": 200,
    "fit_n_steps": 40,
    "hidden": (16,),
    "value_batch_size": 64,
    "fit_batch_size": 64,
    "trim": 1.0,
}


def log(offset: float, cost_offset: float = 0.0, n: int = 20, length: int = 60) -> TransitionTable:
    """A cart with friction that is pushed at random, its position counted from far away."""
    rng = np.random.default_rng(0)
    parts: list[list[Array]] = [[], [], [], []]
    for _ in range(n):
        x = np.array([rng.uniform(-1.0, 1.0), 0.0])
        for _ in range(length):
            u = rng.uniform(-1.0, 1.0, 1)
            reached = np.array([x[0] + 0.1 * x[1], 0.9 * x[1] + 0.1 * u[0]])
            cost = x[0] ** 2 + 0.1 * x[1] ** 2 + 0.01 * u @ u + cost_offset
            for part, value in zip(parts, (x, u, cost, reached), strict=True):
                part.append(value)
            x = reached
    s, a, cost, s_next = (np.array(part) for part in parts)
    away = np.array([offset, 0.0])
    return TransitionTable.from_arrays(
        s + away, a, cost, s_next + away, np.zeros(n * length), np.repeat(np.arange(n), length)
    )


def mpc(offset: float) -> MPC:
    goal = [offset, 0.0]
    return MPC(
        model=Model(
            lambda x, u, p: ca.vertcat(x[0] + 0.1 * x[1], p["a"] * x[1] + p["b"] * u[0]),
            nx=2,
            nu=1,
            dt=0.1,
            discrete=True,
            parameters={"a": Parameter(0.8, low=0.1, high=1.1), "b": Parameter(0.2, low=0.01, high=1.0)},
        ),
        stage_cost=QuadraticCost(W=np.diag([1.0, 0.1]), R=[[0.01]], x_ref=goal),
        terminal_cost=QuadraticCost(W=np.diag([1.0, 0.1]), x_ref=goal),
        horizon=10,
        discount=0.95,
        action_low=[-1.0],
        action_high=[1.0],
    )


NEAR_LOG, FAR_LOG = log(0.0), log(FAR)


def without_references(found: MPC) -> Array:
    parts = [found.theta[found.space.slices[b.name]] for b in found.space if not b.name.endswith(("x_ref", "mean"))]
    return np.concatenate(parts)


@pytest.mark.parametrize(("preset", "options"), [("paper", {}), ("default", {"terminal": "quadratic"})])
def test_theta_does_not_depend_on_the_offset(preset: str, options: dict[str, Any]) -> None:
    found = []
    for offset, table in ((0.0, NEAR_LOG), (FAR, FAR_LOG)):
        learner = OfflineMPCLearner(mpc(offset), preset=preset, seed=0, **(QUICK | options))
        learner.fit(table, show_progress=False)
        found.append(learner)
    near, far = (without_references(learner.mpc) for learner in found)
    np.testing.assert_allclose(far, near, rtol=1e-3, atol=1e-3 * np.abs(near).max())
    states = np.array([[0.5, 0.0], [-1.0, 0.5]])
    values = []
    for learner, offset in zip(found, (0.0, FAR), strict=True):
        assert learner.value_function is not None
        values.append(learner.value_function.predict(states + np.array([offset, 0.0])))
    np.testing.assert_allclose(values[1], values[0], rtol=1e-3)


def test_the_model_is_identified_to_float64() -> None:
    found = identify_one_step(mpc(FAR), FAR_LOG)
    np.testing.assert_allclose(found.scale, identify_one_step(mpc(0.0), NEAR_LOG).scale, rtol=1e-5)
    assert found.error_after < 1e-6
    np.testing.assert_allclose(mpc(FAR).with_theta(found.theta).values["model.a"], 0.9, rtol=1e-6)
    assert one_step_error(mpc(FAR).with_theta(found.theta), FAR_LOG) < 1e-6


def test_noise_is_estimated_and_smoothed_away() -> None:
    noisy = with_measurement_noise(FAR_LOG, 0.05, seed=0)
    assert not noisy.centring.is_none
    assert estimate_noise(mpc(FAR), noisy).level == pytest.approx(0.05, rel=0.2)
    assert estimate_noise(mpc(FAR), FAR_LOG).negligible
    smooth = identify(mpc(FAR), noisy).table
    before, after = (np.sqrt(np.mean((t.observations - FAR_LOG.observations) ** 2, axis=0)) for t in (noisy, smooth))
    assert (after < 0.6 * before).all()


def test_minibatches_of_v_are_those_of_the_plant_around_zero() -> None:
    columns = []
    for table in (NEAR_LOG, FAR_LOG, log(FAR, cost_offset=1e6)):
        value = ValueFunction(2)
        value.normalise(table, 0.95)
        assert float(value.std[0]) == pytest.approx(NEAR_LOG.observations[:, 0].std(), rel=1e-4)
        columns.append(Units(table, value, 0.95).columns(torch.from_numpy(table.rows)))
    for near, *others in zip(*columns, strict=True):
        for other in others:
            torch.testing.assert_close(other, near, rtol=1e-5, atol=2e-5)


def test_what_is_said_of_the_data_does_not_depend_on_the_offset() -> None:
    near, far = (estimate_stochasticity(table) for table in (NEAR_LOG, FAR_LOG))
    assert far.change == pytest.approx(near.change, abs=1e-3)
    cost = LoggedCost(log(FAR, cost_offset=1e6))
    assert cost.exact
    s = np.array([[FAR + 0.5, 0.2]])
    assert cost(s, np.array([[0.3]]), s)[0] - 1e6 == pytest.approx(0.25 + 0.1 * 0.04 + 0.01 * 0.09, abs=1e-3)
    assert outside_support(FAR_LOG, FAR_LOG.observations[:50] + np.array([0.0, 9.0])) == 1.0


@pytest.mark.parametrize("kind", ["quadratic", "network"])
def test_a_terminal_cost_sees_small_distances(kind: Any) -> None:
    def value(x: torch.Tensor) -> torch.Tensor:
        return (x[:, 0].double() - FAR) ** 2 + 0.3 * x[:, 1].double() ** 2 + 0.1 * torch.sin(x[:, 1].double())

    s = FAR_LOG.observations
    cost = fit_terminal(kind, value, s, x_ref=[FAR, 0.0], seed=0)
    assert terminal_error(cost, value, s).relative < 0.1
