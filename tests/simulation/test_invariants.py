"""What states always satisfy, on plants where it is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpcoffline.simulation.invariants import Invariants

Array = NDArray[np.float64]


def pendulum(x: Array, u: Array) -> Array:
    """Cosine, sine and speed of an angle, which moves by the speed."""
    angle, speed = np.arctan2(x[:, 1], x[:, 0]) + 0.1 * x[:, 2], x[:, 2] + 0.3 * x[:, 1] + u[:, 0]
    return np.stack([np.cos(angle), np.sin(angle), speed], axis=1)


def test_cosine_and_sine_stay_on_the_circle() -> None:
    rng = np.random.default_rng(0)
    angle, u = rng.uniform(-2.0, 3.0, 500), rng.normal(size=(500, 1))
    x = np.stack([np.cos(angle), np.sin(angle), 3.0 * rng.normal(size=500)], axis=1)
    found = Invariants.of(x, u, pendulum, 0)
    assert found.weights.shape[1] == 1
    off = x * np.array([1.05, 1.05, 1.0])
    np.testing.assert_allclose(found.projected(off.reshape(2, 250, 3)).reshape(500, 3), x, atol=1e-2)
    radius = np.hypot(*found.projected(off)[:, :2].T)
    np.testing.assert_allclose(radius, 1.0, atol=1e-5)
    np.testing.assert_allclose(found.projected(x), x, atol=1e-9)


def test_what_the_controller_of_the_log_had_so_is_no_law() -> None:
    """Both states are always equal in the log; the input could part them."""
    rng = np.random.default_rng(0)
    x, u = np.tile(rng.normal(size=(500, 1)), 2), rng.normal(size=(500, 1))
    found = Invariants.of(x, u, lambda x, u: 0.9 * x + np.hstack([u, np.zeros_like(u)]), 0)
    assert found.weights.shape[1] == 0
    assert found.projected(x + 1.0) is not None
    np.testing.assert_array_equal(found.projected(2.0 * x), 2.0 * x)


def test_states_without_a_law_and_few_rows_have_none() -> None:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(300, 2)), rng.normal(size=(300, 1))
    assert Invariants.of(x, u, lambda x, u: 0.9 * x + u, 0).weights.shape[1] == 0
    assert Invariants.of(x[:2], u[:2], lambda x, u: 0.9 * x + u, 0).weights.shape[1] == 0
    assert Invariants.of(x, u, lambda x, u: np.full_like(x, np.nan), 0).weights.shape[1] == 0


def test_a_sum_that_the_plant_keeps_is_kept_and_far_states_are_left_alone() -> None:
    """Three tanks between which is pumped: their volume stays."""
    rng = np.random.default_rng(0)
    x, u = rng.uniform(0.0, 1.0, (500, 3)), rng.uniform(-0.1, 0.1, (500, 2))
    x[:, 2] = 2.0 - x[:, 0] - x[:, 1]

    def pumped(x: Array, u: Array) -> Array:
        return x + np.stack([-u[:, 0], u[:, 0] - u[:, 1], u[:, 1]], axis=1)

    found = Invariants.of(x, u, pumped, 0)
    off = x + 0.02
    np.testing.assert_allclose(found.projected(off).sum(axis=1), 2.0, atol=1e-3)
    np.testing.assert_array_equal(found.projected(x + 100.0), x + 100.0)
