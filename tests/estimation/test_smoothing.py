"""Noise estimates and smoothing on simulated plants whose states are known."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets import TransitionTable
from mpcoffline.datasets.table.cache import scratch_table
from mpcoffline.estimation import identify, smoothing
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.estimation.smoothing import (
    NoiseEstimate,
    estimate_noise,
    smooth,
    with_measurement_noise,
)
from mpcoffline.mpc import MPC, Model, NormCost, Parameter, QuadraticCost
from mpcoffline.plants.nominal import nominal_mpc

Array = NDArray[np.float64]

PENDULUM = nominal_mpc("mpcoffline/PendulumSwingUp-v0")
TRUE = PENDULUM.theta[:2]


def pendulum(p_range: float = 1.0, friction: float = 0.0) -> MPC:
    """Pendulum in phi (not wrapped) with unknown gravity and gain; friction is fixed."""

    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return ca.vertcat(x[1], p["g"] * ca.sin(x[0]) + p["b"] * u[0] - friction * x[1])

    parameters = {"g": Parameter(14.7 * p_range, low=1.0), "b": Parameter(3.0 * p_range, low=0.1)}
    model = Model(ode, 2, 1, 0.05, parameters)
    return MPC(model, QuadraticCost(np.eye(2), [[1.0]]), NormCost([0.0, 0.0]), 5, 0.9, [-5.0], [5.0])


def episodes(model: Model, n: int = 25, steps: int = 60, lag: int = 0, seed: int = 0) -> TransitionTable:
    """Random inputs, held for some steps, from random states."""
    rng = np.random.default_rng(seed)
    angle, speed = rng.uniform(-np.pi, np.pi, n), rng.uniform(-2.0, 2.0, n)
    x = np.stack([np.cos(angle), np.sin(angle), speed] if model.nx == 3 else [angle, speed], axis=1)
    u = np.repeat(rng.uniform(-2.0, 2.0, (n, steps, 1)), 2, axis=1)[:, :steps]
    states = [x]
    for t in range(steps):
        states.append(model(states[-1], u[:, max(0, t - lag)]))
    path = np.stack(states, axis=1)
    ids = np.repeat(np.arange(n), steps)
    zeros = np.zeros(n * steps)
    flat = (path[:, :-1].reshape(-1, model.nx), u.reshape(-1, 1), zeros, path[:, 1:].reshape(-1, model.nx), zeros, ids)
    return TransitionTable.from_arrays(*flat)


def measured_once(table: TransitionTable, level: float, seed: int = 0) -> TransitionTable:
    """Noise where s+ of a row is the same number as s of the next."""
    noisy = with_measurement_noise(table, level, seed)
    goes_on = np.flatnonzero(table.episode_ids[1:] == table.episode_ids[:-1])
    noisy.next_observations[goes_on] = noisy.observations[goes_on + 1]
    return noisy


def distance(table: TransitionTable, truth: TransitionTable) -> float:
    """Root mean square error of s and s+ in spreads."""
    spread = truth.observations.std(axis=0)
    errors = [table.observations - truth.observations, table.next_observations - truth.next_observations]
    return float(np.sqrt(np.mean((np.concatenate(errors) / spread) ** 2)))


GUESS = nominal_mpc("mpcoffline/PendulumSwingUp-v0", alpha=1.5, seed=1)
CLEAN = episodes(PENDULUM.model)
NOISY = {"repeated": with_measurement_noise(CLEAN, 0.05, 0), "innovations": measured_once(CLEAN, 0.05)}


# ---------------------------------------------------------------- noise


def test_added_noise_has_the_size_that_was_asked_for() -> None:
    noisy, spread = with_measurement_noise(CLEAN, 0.05, 0), CLEAN.observations.std(axis=0)
    for part in ("observations", "next_observations"):
        np.testing.assert_allclose((getattr(noisy, part) - getattr(CLEAN, part)).std(axis=0), 0.05 * spread, rtol=0.06)
    between = np.corrcoef(
        (noisy.observations - CLEAN.observations)[1:, 0], (noisy.next_observations - CLEAN.next_observations)[:-1, 0]
    )
    assert abs(between[0, 1]) < 0.1
    np.testing.assert_array_equal(noisy.actions, CLEAN.actions)
    np.testing.assert_array_equal(with_measurement_noise(CLEAN, 0.0, 0).rows, CLEAN.rows)
    with pytest.raises(InvalidArgumentError, match="level"):
        with_measurement_noise(CLEAN, -0.1, 0)


@pytest.mark.parametrize("source", ["repeated", "innovations"])
@pytest.mark.parametrize("level", [0.02, 0.05, 0.1])
def test_the_measurement_noise_is_found(source: str, level: float) -> None:
    noisy = with_measurement_noise(CLEAN, level, 3) if source == "repeated" else measured_once(CLEAN, level, 3)
    noise = estimate_noise(GUESS, noisy)
    assert noise.source == source
    np.testing.assert_allclose(noise.levels, level, rtol=0.15)


def test_process_noise_is_told_from_measurement_noise() -> None:
    mpc, rng = pendulum(), np.random.default_rng(0)
    x, rows = rng.normal(size=(40, 2)), []
    for _ in range(60):
        u = rng.uniform(-2.0, 2.0, (40, 1))
        reached = mpc.model(x, u) + rng.normal(size=x.shape) * [0.0, 0.2]
        rows.append((x, u, reached))
        x = reached
    s, a, reached = (np.stack(part, axis=1).reshape(40 * 60, -1) for part in zip(*rows, strict=True))
    zeros, ids = np.zeros(2400), np.repeat(np.arange(40), 60)
    noise = estimate_noise(mpc, TransitionTable.from_arrays(s, a, zeros, reached, zeros, ids), mpc.theta)
    assert noise.negligible
    np.testing.assert_allclose(noise.process, [0.0, 0.2], rtol=0.05, atol=1e-3)


def test_an_input_that_acts_late_is_no_measurement_noise() -> None:
    noise = estimate_noise(PENDULUM, episodes(PENDULUM.model, lag=1))
    assert noise.negligible
    assert noise.process[2] > 0.01


def test_rows_without_neighbours_say_nothing() -> None:
    lone = TransitionTable(CLEAN.rows, CLEAN.ny, CLEAN.nu, np.arange(len(CLEAN)))
    noisy = with_measurement_noise(lone, 0.05, 0)
    assert estimate_noise(GUESS, noisy).source == "unknown"
    result = identify(GUESS, noisy)
    assert result.table is noisy


# ---------------------------------------------------------------- smoothing


@pytest.mark.parametrize("source", ["repeated", "innovations"])
def test_parameters_and_states_are_recovered(source: str) -> None:
    noisy = NOISY[source]
    result = identify(GUESS, noisy)
    np.testing.assert_allclose(result.theta[:2], TRUE, rtol=0.01)
    assert distance(result.table, CLEAN) < 0.2 * distance(noisy, CLEAN)
    errors = np.abs(result.theta[:2] - TRUE)
    assert (errors < 4.0 * result.deviation[:2]).all()
    assert (result.deviation[:2] < 0.01).all()
    radius = np.linalg.norm(result.table.observations[:, :2], axis=1)
    assert np.abs(radius - 1.0).max() < 0.05
    np.testing.assert_array_equal(result.table.actions, noisy.actions)
    np.testing.assert_array_equal(result.table.costs, noisy.costs)


def test_one_step_least_squares_is_biased_and_the_filter_is_not() -> None:
    noisy = with_measurement_noise(CLEAN, 0.1, 0)
    one_step = np.abs(identify_one_step(GUESS, noisy).theta[:2] / TRUE - 1.0).max()
    filtered = np.abs(identify(GUESS, noisy).theta[:2] / TRUE - 1.0).max()
    assert filtered < 0.3 * one_step


def test_clean_data_are_left_alone() -> None:
    for table in (CLEAN, with_measurement_noise(CLEAN, 0.002, 0)):
        result = identify(GUESS, table)
        assert result.table is table
        np.testing.assert_array_equal(result.theta, identify_one_step(GUESS, table).theta)


def test_with_a_wrong_structure_the_data_are_believed() -> None:
    damped = episodes(pendulum(friction=1.5).model)
    noisy = with_measurement_noise(damped, 0.05, 0)
    result = identify(pendulum(0.6), noisy)  # which knows no friction
    assert distance(result.table, damped) < 0.8 * distance(noisy, damped)


def test_rows_left_out_are_gaps() -> None:
    noisy = NOISY["repeated"]
    keep = np.arange(len(noisy)) % 20 < 15
    trimmed, truth = (TransitionTable(t.rows[keep], t.ny, t.nu, t.episode_ids[keep]) for t in (noisy, CLEAN))
    noise = estimate_noise(GUESS, trimmed)
    np.testing.assert_allclose(noise.levels, 0.05, rtol=0.15)
    result = identify(GUESS, trimmed)
    np.testing.assert_allclose(result.theta[:2], TRUE, rtol=0.02)
    assert distance(result.table, truth) < 0.4 * distance(trimmed, truth)


def test_wrapped_angles_are_smoothed_across_the_jump() -> None:
    clean = episodes(pendulum().model)
    rows = clean.rows.copy()
    for column in (0, clean.ny + clean.nu + 1):
        rows[:, column] = (rows[:, column] + np.pi) % (2 * np.pi) - np.pi
    wrapped = TransitionTable(rows, clean.ny, clean.nu, clean.episode_ids)
    noisy = with_measurement_noise(wrapped, 0.03, 0)
    result = identify(pendulum(0.7), noisy)
    np.testing.assert_allclose(result.theta[:2], [14.7, 3.0], rtol=0.02)
    assert result.unwrapped == (0,)
    turned = (result.table.observations[:, 0] - clean.observations[:, 0] + np.pi) % (2 * np.pi) - np.pi
    noise = 0.03 * wrapped.observations[:, 0].std()
    assert np.sqrt(np.mean(turned**2)) < 0.5 * noise


def test_a_model_without_parameters_smooths_too() -> None:
    fixed = MPC(
        Model(lambda x, u, p: PENDULUM.model.expression(x, u, ca.DM(TRUE)), 3, 1, 0.05, discrete=True),
        PENDULUM.stage_cost,
        PENDULUM.terminal_cost,
        5,
        0.9,
        [-2.0],
        [2.0],
    )
    result = identify(fixed, NOISY["repeated"])
    assert distance(result.table, CLEAN) < 0.01
    np.testing.assert_array_equal(result.theta, fixed.theta)


def test_smoothing_with_known_model_and_noise() -> None:
    noise = NoiseEstimate(0.05 * CLEAN.observations.std(axis=0).astype(np.float64), np.zeros(3), np.ones(3), "repeated")
    result = smooth(PENDULUM, NOISY["repeated"], PENDULUM.theta, noise)
    assert distance(result, CLEAN) < 0.01
    with pytest.raises(InvalidArgumentError, match="noise"):
        smooth(PENDULUM, CLEAN, PENDULUM.theta, NoiseEstimate(np.zeros(2), np.zeros(2), np.ones(2), "repeated"))


def test_a_table_larger_than_memory_gives_one_that_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(smoothing, "_CHUNK", 500)
    noisy, noise = NOISY["repeated"], NoiseEstimate(np.full(3, 0.05), np.full(3, 1e-3), np.ones(3), "repeated")
    blocks = [(noisy.rows[i : i + 700], noisy.episode_ids[i : i + 700]) for i in range(0, len(noisy), 700)]
    file = scratch_table(3, 1, blocks, tmp_path)
    mapped = TransitionTable(file.rows, 3, 1, file.episode_ids, noisy.name, file=file)
    found, expected = (smooth(PENDULUM, table, PENDULUM.theta, noise) for table in (mapped, noisy))
    assert (found.is_mapped, expected.is_mapped, len(noisy) > 500) == (True, False, True)
    np.testing.assert_array_equal(found.rows, expected.rows)
    np.testing.assert_array_equal(found.episode_ids, noisy.episode_ids)
    assert distance(expected, CLEAN) < distance(noisy, CLEAN)
    np.testing.assert_array_equal(mapped.rows, noisy.rows)


def test_a_long_trajectory_is_smoothed_in_pieces() -> None:
    clean = episodes(PENDULUM.model, n=1, steps=450)
    result = identify(GUESS, with_measurement_noise(clean, 0.05, 1))
    assert distance(result.table, clean) < 0.02


@pytest.mark.slow
def test_a_large_table_is_identified_from_stretches_and_smoothed_in_chunks() -> None:
    clean = episodes(PENDULUM.model, n=1_100, steps=100)
    noisy = with_measurement_noise(clean, 0.05, 1)
    result = identify(GUESS, noisy)
    np.testing.assert_allclose(result.theta[:2], TRUE, rtol=0.01)
    assert distance(result.table, clean) < 0.007
    spread = clean.observations.std(axis=0)
    worst = np.abs((result.table.observations - clean.observations) / spread).max()
    assert worst < 0.3  # also where the chunks meet
