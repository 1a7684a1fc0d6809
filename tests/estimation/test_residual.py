"""Learned residuals on plants whose missing part is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from logged_plants import TANK, pendulum_log, pendulum_mpc, tank_log, tank_mpc
from numpy.typing import NDArray

from mpcoffline import MPC, make_solver
from mpcoffline.datasets import TransitionTable
from mpcoffline.estimation import fit_residual, fit_residuals, identify, with_residual
from mpcoffline.estimation.residual import Residual
from mpcoffline.estimation.small_network import Gate, _layers, _normal_equations, _signals
from mpcoffline.mpc.torch_twin import TorchTwin

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def learned() -> tuple[MPC, Residual, TransitionTable]:
    """A pendulum whose model knows no friction; the plant's is dry and viscous."""
    table = pendulum_log(20, 100, 0, friction=True)
    mpc = pendulum_mpc()
    mpc = mpc.with_theta(identify(mpc, table).theta)
    return mpc, fit_residual(mpc, table), table


def test_what_the_model_misses_is_learned(learned: tuple[MPC, Residual, TransitionTable]) -> None:
    mpc, residual, _ = learned
    assert residual.taken
    fresh = pendulum_log(10, 100, 99, friction=True).values()
    x, u, reached = fresh.observations, fresh.actions, fresh.next_observations
    before, after = (reached - m.model(x, u) for m in (mpc, with_residual(mpc, residual)))
    share = 1.0 - np.sum((after / residual.unit) ** 2) / np.sum((before / residual.unit) ** 2)
    assert share > 0.9
    assert residual.share == pytest.approx(share, abs=0.08)
    assert f"{residual.share:.0%}" in str(residual)
    assert residual.one_step[1] < 0.3 * residual.one_step[0]
    assert residual.far[1] < 0.3 * residual.far[0]


def test_it_is_bounded_and_zero_outside_the_data(learned: tuple[MPC, Residual, TransitionTable]) -> None:
    mpc, residual, table = learned
    rng = np.random.default_rng(0)
    columns = table.values()
    spread = columns.observations.std(axis=0)
    missed = np.abs(columns.next_observations - mpc.model(columns.observations, columns.actions)).max(axis=0)
    for size in (1.0, 3.0, 10.0, 1e3):
        x, u = size * spread * rng.normal(size=(2_000, 2)), size * rng.normal(size=(2_000, 1))
        assert (np.abs(residual(x, u)) <= 1.25 * missed + 1e-12).all()
    far = 10.0 * spread * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 0.0], [0.0, 1.0]])
    assert (np.abs(residual(far, np.zeros((4, 1)))) < 1e-2 * missed).all()


def test_arrays_casadi_torch_and_c_are_one(learned: tuple[MPC, Residual, TransitionTable]) -> None:
    mpc, residual, table = learned
    columns = table.sample(50, 0).values()
    x, u = columns.observations, columns.actions
    corrected = with_residual(mpc, residual)
    expected = mpc.model(x, u) + residual(x, u)
    np.testing.assert_allclose(corrected.model(x, u), expected, rtol=1e-12, atol=1e-13)
    twin = TorchTwin(corrected.dynamics_function)
    parts = (torch.from_numpy(v) for v in (x, u, corrected.theta))
    np.testing.assert_allclose(twin(*parts).numpy(), expected, rtol=1e-12, atol=1e-13)
    again = MPC.from_json(corrected.to_json())
    np.testing.assert_allclose(again.model(x, u), expected, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(corrected.theta, mpc.theta)
    starts = np.array([[0.3, 0.0], [-0.2, 0.4]])
    fast, oracle = (make_solver(corrected.replace(horizon=8), name).solve(starts) for name in ("ddp", "ipopt"))
    assert fast.success.all()
    np.testing.assert_allclose(fast.u0, oracle.u0, atol=1e-3)


def test_the_right_structure_gets_none() -> None:
    table = tank_log(12, 120, 0, noise=0.01)
    found = identify(tank_mpc(), table)
    residual = fit_residual(tank_mpc().with_theta(found.theta), found.table)
    assert not residual.taken
    assert "do not ask" in str(residual)
    exact = fit_residual(tank_mpc(TANK), tank_log(12, 120, 0))
    assert not exact.taken


def test_chance_is_not_learned() -> None:
    rng = np.random.default_rng(0)
    table = tank_log(12, 60, 0)
    shaken = table.values().next_observations + rng.normal(size=(len(table), 2)) * [0.3, 0.0]
    residual = fit_residual(tank_mpc(TANK), table.with_states(table.observations, shaken))
    assert not residual.taken


def test_the_same_seed_gives_the_same_residual(learned: tuple[MPC, Residual, TransitionTable]) -> None:
    mpc, _, table = learned
    few = table.take(np.arange(500))
    residual, again, other = (fit_residual(mpc, few, seed) for seed in (0, 0, 1))
    x, u = table.observations[:20].astype(float), table.actions[:20].astype(float)
    np.testing.assert_array_equal(again(x, u), residual(x, u))
    assert (other(x, u) != residual(x, u)).any()


def test_an_ensemble_agrees_in_the_data_and_differs_outside(learned: tuple[MPC, Residual, TransitionTable]) -> None:
    mpc, _, table = learned
    members = fit_residuals(mpc, table.take(np.arange(1_000)), 0, count=3)
    columns = table.sample(500, 0).values()
    x, u = columns.observations, columns.actions
    missed = columns.next_observations - mpc.model(x, u)
    said = np.stack([member(x, u) for member in members])
    assert len(members) == 3
    for one in said:
        assert np.sum((missed - one) ** 2) < 0.2 * np.sum(missed**2)
    assert not any(member.taken for member in members)
    edge = np.quantile(np.abs(columns.observations), 0.99, axis=0)[None]
    at_edge = np.stack([member(edge, np.ones((1, 1))) for member in members])
    assert at_edge.std(axis=0).max() > said.std(axis=0).mean()


def test_a_model_without_a_residual_is_as_it_was() -> None:
    mpc = tank_mpc()
    nothing = Residual(None, np.zeros(2, dtype=bool), np.ones(2))
    x, u = np.array([[40.0, 50.0]]), np.array([[0.3]])
    np.testing.assert_array_equal(with_residual(mpc, nothing).model(x, u), mpc.model(x, u))
    np.testing.assert_array_equal(nothing(x, u), 0.0)


# ---------------------------------------------------------------- the network


def test_the_normal_equations_are_those_of_casadis_derivatives() -> None:
    rng = np.random.default_rng(0)
    shapes = [(4, 4), (5, 5), (2, 6)]
    size = sum(int(np.prod(s)) for s in shapes)
    p, z, unit, targets = (
        rng.normal(size=size),
        rng.normal(size=(6, 3)),
        rng.uniform(1, 2, (6, 2)),
        rng.normal(size=(6, 2)),
    )
    curvature, slope, error = _normal_equations(_layers(p, shapes), z, unit, targets)

    def outputs(flat: Array) -> Array:
        return np.asarray((unit * _signals(_layers(flat, shapes), z)[0][-1]).ravel())

    J = np.stack([(outputs(p + 1e-6 * e) - outputs(p - 1e-6 * e)) / 2e-6 for e in np.eye(size)], axis=1)
    missed = targets.ravel() - outputs(p)
    np.testing.assert_allclose(np.tril(curvature), np.tril(J.T @ J) / 6, atol=1e-4 * np.abs(J.T @ J).max())
    np.testing.assert_allclose(slope, J.T @ missed / 6, atol=1e-4 * np.abs(J.T @ missed).max())
    assert error == pytest.approx(missed @ missed / 6)


def test_the_gate_is_open_in_the_data_and_shut_outside_whatever_the_units() -> None:
    rng = np.random.default_rng(0)
    data = rng.normal(size=(2_000, 2)) @ np.array([[1.0, 0.9], [0.0, 0.1]])
    data = np.hstack([data, np.full((2_000, 1), 7.0)])  # what never moves decides nothing
    gate = Gate.of(data).standardised(data)[1]
    assert gate.min() > 0.4
    assert gate.mean() > 0.95
    outside = np.array([[12.0, 12.0, 7.0], [3.0, -3.0, 7.0]])
    assert Gate.of(data).standardised(outside)[1].max() < 0.01
    units = np.array([1e3, 1e-3, 1.0])
    np.testing.assert_allclose(Gate.of(units * data).standardised(units * data)[1], gate, rtol=1e-6)


def test_threads_change_no_digit_of_an_ensemble(learned: tuple[MPC, Residual, TransitionTable]) -> None:
    mpc, _, table = learned
    before, found = torch.get_num_threads(), []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            found.append(fit_residuals(mpc, table, 3, count=3))
        finally:
            torch.set_num_threads(before)
    for one, two in zip(*found, strict=True):
        assert one.network is not None
        assert two.network is not None
        for A, B in zip(one.network.weights, two.network.weights, strict=True):
            np.testing.assert_array_equal(A, B)
