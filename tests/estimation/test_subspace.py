"""Linear models from logs alone, against the systems that made these."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg

from mpcoffline import InvalidArgumentError, InvalidDataError, TransitionTable
from mpcoffline.core.types import Array
from mpcoffline.estimation import LinearModel, linear_model

A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.7]])
B = np.array([[0.0, 0.1], [0.1, 0.0], [0.3, 0.0]])
E = np.array([[0.05], [0.0], [0.0]])
C = np.array([[10.0, 0.0, 0.0], [0.0, 0.0, 10.0]])
PROCESS, NOISE = 0.02, 0.1


def logged(
    n_episodes: int = 30, length: int = 80, *, delay: int = 3, feedback: float = 0.0, seed: int = 0, noise: float = 1.0
) -> TransitionTable:
    """Outputs around 50, one signal that moves the plant, one that does not; the first input acts late."""
    rng = np.random.default_rng(seed)
    seen, acted, after = [], [], []
    for _ in range(n_episodes):
        x, past = rng.normal(size=3), [0.0] * delay
        d = np.repeat(rng.uniform(-3.0, 3.0, (length // 10 + 1, 2)), 10, axis=0)
        for k in range(length):
            y = C @ x + 50.0 + noise * NOISE * rng.normal(size=2)
            if k % 4 == 0:
                tried = rng.uniform(-1.0, 1.0, 2)
            u = tried - feedback * (y - 50.0)
            past.append(float(u[0]))
            seen.append([*y, *d[k]])
            acted.append(u)
            x = A @ x + B @ [past[k], u[1]] + E @ d[k, :1] + noise * PROCESS * rng.normal(size=3)
            after.append([*(C @ x + 50.0 + noise * NOISE * rng.normal(size=2)), *d[k + 1 if k + 1 < length else k]])
    n = n_episodes * length
    for e in range(n):  # the next row's outputs are the ones that were measured
        if (e + 1) % length:
            after[e] = seen[e + 1]
    return TransitionTable.from_arrays(
        observations=np.array(seen),
        actions=np.array(acted),
        costs=np.zeros(n),
        next_observations=np.array(after),
        terminations=np.zeros(n),
        episode_ids=np.repeat(np.arange(n_episodes), length),
    )


def gains(found: LinearModel) -> Array:
    """What outputs come to where all is held, per unit of inputs and signals."""
    return np.asarray(found.C @ np.linalg.solve(np.eye(found.order) - found.A, np.hstack([found.B, found.E])))


TRUE_GAINS = C @ np.linalg.solve(np.eye(3) - A, np.hstack([B, E]))


def innovations() -> Array:
    """Standard deviation of a stationary Kalman filter's innovations."""
    P = scipy.linalg.solve_discrete_are(A.T, C.T, PROCESS**2 * np.eye(3), NOISE**2 * np.eye(2))
    return np.asarray(np.sqrt(np.diag(C @ P @ C.T + NOISE**2 * np.eye(2))))


def test_order_poles_gains_dead_time_and_noise_are_the_plants() -> None:
    found = linear_model(logged(), 2, [2, 3])
    assert found.order == 3
    assert found.delay == (3, 0)
    for own in np.linalg.eigvals(A):
        assert np.abs(np.linalg.eigvals(found.A) - own).min() < 0.01
    np.testing.assert_allclose(gains(found)[:, :3], TRUE_GAINS, atol=0.3)
    assert (found.E[:, 1] == 0.0).all()  # the other signal says nothing of what follows
    np.testing.assert_allclose(found.noise, innovations(), rtol=0.06)
    rest = found.C @ np.linalg.solve(np.eye(3) - found.A, found.b) + found.c
    np.testing.assert_allclose(rest, 50.0, atol=0.2)
    assert (found.missed < 0.15).all()
    assert "3 states, inputs 3, 0 steps late" in str(found)


def test_a_controller_that_made_the_log_does_not_bias_it() -> None:
    found = linear_model(logged(feedback=0.02, delay=0), 2, [2, 3], [0, 0])
    for own in np.linalg.eigvals(A):
        assert np.abs(np.linalg.eigvals(found.A) - own).min() < 0.02
    np.testing.assert_allclose(gains(found)[:, :3], TRUE_GAINS, atol=0.5)


def test_starts_are_where_episodes_begin() -> None:
    log = logged(60, 30, delay=0)
    found = linear_model(log, 2, [2], [0, 0])
    first = log.take(log.episodes.firsts).values().observations[:, :2]
    np.testing.assert_allclose(found.C @ found.start + found.c, first.mean(axis=0), atol=1.0)
    spread = np.sqrt(np.diag(found.C @ np.diag(found.start_spread**2) @ found.C.T))
    assert (spread > 0.5 * first.std(axis=0)).all()


def test_units_change_nothing() -> None:
    log = logged(10, 60)
    c = log.values()
    y_unit, u_unit, offset = np.array([1e-6, 1e4, 1e3, 1.0]), np.array([1e5, 1e-3]), np.array([7.0, -2e6, 0.0, 0.0])
    other = TransitionTable.from_arrays(
        observations=c.observations * y_unit + offset,
        actions=c.actions * u_unit,
        costs=c.costs,
        next_observations=c.next_observations * y_unit + offset,
        terminations=c.terminations,
        episode_ids=log.episode_ids,
    )
    one, two = (linear_model(each, 2, [2, 3]) for each in (log, other))
    assert (one.order, one.delay) == (two.order, two.delay)
    np.testing.assert_allclose(np.abs(np.linalg.eigvals(one.A)), np.abs(np.linalg.eigvals(two.A)), rtol=1e-5)
    expected = gains(one) * y_unit[:2, None] / np.append(u_unit, y_unit[2:])
    np.testing.assert_allclose(gains(two), expected, rtol=1e-3, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("n_episodes", [1, 2])
def test_few_long_episodes_do(n_episodes: int) -> None:
    found = linear_model(logged(n_episodes, 600, delay=0), 2, [2], [0, 0])
    assert found.order == 3
    np.testing.assert_allclose(gains(found)[:, :3], TRUE_GAINS, atol=2.0)
    assert np.isfinite(found.start_spread).all()


def test_a_log_without_noise_asks_for_no_states_to_fit_rounding() -> None:
    found = linear_model(logged(12, 40, delay=0, noise=0.0), 2, [2], [0, 0])
    assert found.order == 3
    np.testing.assert_allclose(gains(found)[:, :3], TRUE_GAINS, atol=0.05)
    assert np.isfinite(found.start).all()


def test_one_long_stretch_and_fragments_do() -> None:
    """As of a plant in operation: whatever is held out, rows are left to fit."""
    parts = [logged(1, 500, delay=0), logged(6, 5, delay=0, seed=1)]
    columns = [np.concatenate(each) for each in zip(*(part.values() for part in parts), strict=True)]
    ids = np.concatenate([parts[0].episode_ids, parts[1].episode_ids + 1])
    s, a, costs, s_next, ends = columns
    found = linear_model(TransitionTable.from_arrays(s, a, costs, s_next, ends, ids), 2, [2], [0, 0])
    assert found.order == 3
    np.testing.assert_allclose(gains(found)[:, :3], TRUE_GAINS, atol=2.0)


def changed(**columns: Any) -> TransitionTable:
    log = logged(2, 20)
    c = log.values()
    parts = {
        "observations": c.observations,
        "actions": c.actions,
        "costs": c.costs,
        "next_observations": c.next_observations,
        "terminations": c.terminations,
        "episode_ids": log.episode_ids,
    }
    return TransitionTable.from_arrays(**parts | columns)


def test_what_cannot_be_modelled_is_named() -> None:
    log = logged(2, 20)
    with pytest.raises(InvalidArgumentError, match="columns"):
        linear_model(log, 2, [4])
    with pytest.raises(InvalidArgumentError, match="delay"):
        linear_model(log, 2, [2], [0])
    still = log.values().observations.copy()
    still[:, 1] = 3.0
    with pytest.raises(InvalidDataError, match="output 1 is one number"):
        linear_model(changed(observations=still), 2)
    with pytest.raises(InvalidDataError, match="at least, in episodes of 3 steps"):
        linear_model(logged(8, 2, delay=0), 2)
