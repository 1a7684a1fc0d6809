"""Costs in simulations against the functions that the logs were made with."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import lq_plant
import numpy as np
import pytest
from hypothesis import Phase, given, settings, strategies as st
from lq_episodes import episodes
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable
from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.simulation.logged_cost import LoggedCost

Array = NDArray[np.float64]
Costs = Callable[[Array, Array], Array]

N, STEPS = 400, 20


def log(cost: Costs, *, noise: float = 0.0, s: Array | None = None, seed: int = 0) -> TransitionTable:
    """20 episodes of independent s in [-1, 1]^2 and a in [-1, 1], measured with noise."""
    rng = np.random.default_rng(seed)
    s = rng.uniform(-1.0, 1.0, (N, 2)) if s is None else s
    a = rng.uniform(-1.0, 1.0, (N, 1))
    seen = s + noise * rng.normal(size=s.shape)
    return TransitionTable.from_arrays(seen, a, cost(s, a), seen, np.zeros(N), np.arange(N) // STEPS)


def quadratic(s: Array, a: Array) -> Array:
    return (s[:, 0] - 0.3) ** 2 + 0.5 * s[:, 1] ** 2 + 0.1 * a[:, 0] ** 2 + 0.2 * s[:, 0] * a[:, 0]


def kinked(s: Array, a: Array) -> Array:
    return np.abs(s[:, 0]) + np.sin(3.0 * s[:, 1]) + a[:, 0] ** 2


def at(x: list[float]) -> tuple[Array, Array, Array]:
    return np.array([x[:2]]), np.array([x[2:]]), np.array([x[:2]])


POINTS = (np.random.default_rng(5).uniform(-1, 1, (300, 2)), np.random.default_rng(6).uniform(-1, 1, (300, 1)))
STEPS_OF = (*POINTS, POINTS[0])  # as arguments of costs


@pytest.fixture(scope="module")
def of_kinked() -> LoggedCost:
    return LoggedCost(log(kinked))


@pytest.fixture(scope="module")
def of_quadratic() -> LoggedCost:
    return LoggedCost(log(quadratic, noise=0.03))


# ---------------------------------------------------------------- which regression


def test_a_wavy_cost_is_a_network() -> None:
    cost = LoggedCost(log(lambda s, a: np.sin(4.0 * s[:, 0]) * np.cos(3.0 * s[:, 1]) + a[:, 0] ** 2))
    assert "a small network" in str(cost)
    assert cost.r2 > 0.9


def test_a_quadratic_under_noise_stays_one(of_quadratic: LoggedCost) -> None:
    """Networks would find structure in the noise."""
    cost = of_quadratic
    assert not cost.exact
    assert "a quadratic of states and inputs" in str(cost)
    for predicted in (cost(*STEPS_OF), cost.second(*STEPS_OF)):
        np.testing.assert_allclose(predicted, quadratic(*POINTS), atol=0.08)
    assert not np.array_equal(cost(*STEPS_OF), cost.second(*STEPS_OF))


def test_a_cost_with_kinks_has_norms_and_so_has_the_check(of_kinked: LoggedCost) -> None:
    assert "a quadratic with norms" in str(of_kinked)
    spread = float(np.std(kinked(*POINTS)))
    errors = [(f(*STEPS_OF) - kinked(*POINTS)).std() / spread for f in (of_kinked, of_kinked.second)]
    assert max(errors) < 0.1
    assert 1.0 - of_kinked.r2 == pytest.approx(max(errors) ** 2, abs=0.01)
    assert not of_kinked.alike
    assert not np.array_equal(of_kinked(*STEPS_OF), of_kinked.second(*STEPS_OF))


def test_what_the_successor_decides_is_its_mean() -> None:
    """L = (s+)^2 with s+ = 0.9 s + a + w: E[L | s, a] = (0.9 s + a)^2 + Var[w]."""
    w = 0.1 * np.random.default_rng(3).normal(size=N)
    cost = LoggedCost(log(lambda s, a: (0.9 * s[:, 0] + a[:, 0] + w) ** 2))
    s, a = POINTS
    np.testing.assert_allclose(cost(s, a, s), (0.9 * s[:, 0] + a[:, 0]) ** 2 + 0.01, atol=0.15)


def test_logged_rows_count_not_smoothed_ones() -> None:
    """Smoothing moved the states to a half: the cost of the logged ones is the one."""
    raw = log(quadratic)
    smooth = raw.with_states(0.5 * raw.observations, 0.5 * raw.next_observations)
    np.testing.assert_allclose(LoggedCost(smooth, logged=raw)(*STEPS_OF), quadratic(*POINTS), atol=1e-4)


def test_coordinates_that_a_cost_does_not_see() -> None:
    cost = LoggedCost(log(lambda s, a: s[:, 0] ** 2 + a[:, 0] ** 2), seen=1)
    s, a = POINTS
    np.testing.assert_allclose(cost(s + np.array([0.0, 1e6]), a, s), s[:, 0] ** 2 + a[:, 0] ** 2, atol=1e-4)


def test_a_log_that_is_too_short_for_anything() -> None:
    for n in (1, 3):
        s = np.linspace(0.0, 1.0, n)[:, None]
        cost = LoggedCost(TransitionTable.from_arrays(s, s, s[:, 0], s, np.zeros(n), np.zeros(n, int)))
        assert np.isfinite(cost(s, s, s)).all()
        assert np.isfinite(cost.second(s, s, s)).all()


# ---------------------------------------------------------------- beyond the data


def test_nothing_is_gained_beyond_the_data() -> None:
    """A saturating cost looks like a parabola that falls again: outside, it stays what it was at the border."""
    cost = LoggedCost(log(lambda s, a: np.tanh(3.0 * np.abs(s[:, 0])) + 0.1 * a[:, 0] ** 2))
    for f in (cost, cost.second):
        border, far = f(*at([1.0, 0.0, 0.0]))[0], [f(*at([x, 0.0, 0.0]))[0] for x in (1.5, 3.0, 10.0)]
        assert min(far) >= border - 1e-9
        assert border == pytest.approx(np.tanh(3.0), abs=0.1)


def test_a_quadratic_that_predicts_outer_rows_from_inner_ones_is_believed_as_far_again() -> None:
    """An input that earns: -a s_0, logged up to 1; under noise, and up to twice as far."""
    cost = LoggedCost(log(lambda s, a: -a[:, 0] * s[:, 0], noise=0.02))
    assert not cost.exact
    assert cost(*at([0.9, 0.0, 1.8]))[0] == pytest.approx(-1.62, abs=0.1)
    assert cost(*at([0.9, 0.0, 10.0]))[0] == pytest.approx(-1.8, abs=0.15)  # as at the border, near 2
    assert cost(*at([0.9, 0.0, -10.0]))[0] == pytest.approx(9.0, abs=0.5)  # what is dear grows


# ---------------------------------------------------------------- invariance


@settings(max_examples=3, deadline=None, phases=[Phase.generate])
@given(st.floats(1e-6, 1e6), st.floats(-1e3, 1e3))
def test_an_affine_change_of_the_cost_changes_nothing_else(
    of_quadratic: LoggedCost, scale: float, offset: float
) -> None:
    """L -> a (L + b), up to the rounding of the table to float32."""
    changed = LoggedCost(log(lambda s, a: scale * (quadratic(s, a) + offset), noise=0.03))
    np.testing.assert_allclose(changed(*STEPS_OF) / scale - offset, of_quadratic(*STEPS_OF), atol=1e-4)
    assert changed.r2 == pytest.approx(of_quadratic.r2, abs=1e-5)


def test_another_unit_of_the_cost_changes_no_network(of_kinked: LoggedCost) -> None:
    changed = LoggedCost(log(lambda s, a: 1024.0 * kinked(s, a)))
    for f, g in ((of_kinked, changed), (of_kinked.second, changed.second)):
        np.testing.assert_allclose(g(*STEPS_OF), 1024.0 * f(*STEPS_OF), rtol=1e-6, atol=1e-6)


# ---------------------------------------------------------------- the user's own


def test_weights_of_the_mpc_that_are_not_those_of_the_log() -> None:
    table = episodes()
    own = lq_plant.make_mpc()
    x, u = np.array([[30.0, -20.0]]), np.array([[15.0]])
    expected = lq_plant.quadratic(lq_plant.W, x) + lq_plant.quadratic(lq_plant.R, u)
    other = own.replace(stage_cost=QuadraticCost(W=3.0 * np.eye(2), R=np.eye(1)))
    for mpc in (own, other):
        cost = LoggedCost(table, mpc=mpc)
        assert cost.exact
        np.testing.assert_allclose(cost(x, u, x), expected, rtol=1e-3)
        assert cost.alike
        np.testing.assert_array_equal(cost.second(x, u, x), cost(x, u, x))
        assert "the MPC's own stage cost" in str(cost)


def test_a_stage_cost_that_is_no_number_somewhere_is_the_dearest_logged_one() -> None:
    class Root(QuadraticCost):
        def expression(self, x: ca.SX, u: ca.SX, p: object) -> ca.SX:
            return ca.sqrt(x[0] + 2.0) + u[0] ** 2

    table = log(lambda s, a: np.sqrt(s[:, 0] + 2.0) + a[:, 0] ** 2)
    model = Model(lambda x, u, p: 0.9 * x, nx=2, nu=1, dt=1.0, discrete=True)
    zero = QuadraticCost(W=np.eye(2), R=np.eye(1))
    mpc = MPC(
        model=model,
        stage_cost=Root(W=np.eye(2), R=np.eye(1)),
        terminal_cost=zero,
        horizon=3,
        discount=0.9,
        action_low=[-1],
        action_high=[1],
    )
    cost = LoggedCost(table, mpc=mpc)
    assert cost.known is not None
    assert cost(*at([2.0, 0.0, 0.0]))[0] == pytest.approx(2.0, abs=1e-3)
    assert cost(*at([-3.0, 0.0, 0.0]))[0] == pytest.approx(table.costs.max())
