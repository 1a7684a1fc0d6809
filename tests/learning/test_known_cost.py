"""Known stage costs, on logs whose cost is made of a formula here."""

from __future__ import annotations

import logging
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from mpcoffline import MPC, Model, OfflineMPCLearner, QuadraticCost, TransitionTable
from mpcoffline.core.errors import UnknownIdError
from mpcoffline.diagnostics.measures import fit_errors
from mpcoffline.estimation import identify
from mpcoffline.learning import CostConfig, Known, StartConfig, known_cost
from mpcoffline.learning.bellman.stages import identified
from mpcoffline.learning.known_cost import _by_rows, as_logged, with_known_cost

Array = NDArray[np.float64]

W, R, REFERENCE = np.diag([2.0, 0.5]), np.array([[0.1]]), np.array([1.0, 0.0])


def mpc_of(W: Array = W, R: Array = R) -> MPC:
    """A cart of mass 1 with friction."""

    def ode(x: ca.SX, u: ca.SX, _: object) -> ca.SX:
        return ca.vertcat(x[1], u[0] - 0.5 * x[1])

    return MPC(
        model=Model(ode, nx=2, nu=1, dt=0.1),
        stage_cost=QuadraticCost(W, R, x_ref=REFERENCE),
        terminal_cost=QuadraticCost(10.0 * W, x_ref=REFERENCE),
        horizon=12,
        discount=0.95,
        action_low=[-5.0],
        action_high=[5.0],
    )


def states_and_inputs(seed: int = 0, n_episodes: int = 12, n_steps: int = 60) -> tuple[Array, Array]:
    """Of the cart under a noisy feedback, ``(E, T + 1, 2)`` and ``(E, T, 1)``."""
    rng = np.random.default_rng(seed)
    s, u = np.zeros((n_episodes, n_steps + 1, 2)), np.zeros((n_episodes, n_steps, 1))
    s[:, 0] = rng.uniform(-3.0, 3.0, (n_episodes, 2))
    f = mpc_of().dynamics_function
    for t in range(n_steps):
        u[:, t] = np.clip((REFERENCE - s[:, t]) @ [[1.0], [1.0]] + rng.normal(size=(n_episodes, 1)), -5.0, 5.0)
        s[:, t + 1] = f(s[:, t].T, u[:, t].T, mpc_of().theta).full().T
    return s, u


def quadratic(s: Array, u: Array, W: Array = W, R: Array = R) -> Array:
    """The cost by hand."""
    e = s[:, :-1] - REFERENCE
    return np.asarray(np.einsum("eti,ij,etj->et", e, W, e) + np.einsum("eti,ij,etj->et", u, R, u))


def table(s: Array, u: Array, cost: Array, ended: Array | None = None) -> TransitionTable:
    """The log."""
    n_episodes, n_steps = cost.shape
    return TransitionTable.from_arrays(
        observations=s[:, :-1].reshape(-1, 2),
        actions=u.reshape(-1, 1),
        costs=cost.ravel(),
        next_observations=s[:, 1:].reshape(-1, 2),
        terminations=np.zeros(cost.size, bool) if ended is None else ended.ravel(),
        episode_ids=np.repeat(np.arange(n_episodes), n_steps),
    )


@settings(max_examples=5, deadline=None)
@given(st.floats(-6.0, 6.0), st.floats(-1e3, 1e3))
def test_any_scale_and_offset_are_found(exponent: float, offset: float) -> None:
    """L = a Lhat + b, b in units of a."""
    s, u = states_and_inputs()
    scale = 10.0**exponent
    found = known_cost(mpc_of(), table(s, u, scale * (quadratic(s, u) + offset)))
    assert found is not None
    assert found.agreeing == 1.0
    assert found.scale == (1.0 if abs(scale - 1.0) < 0.05 else pytest.approx(scale, rel=1e-3))
    assert found.offset == pytest.approx(scale * offset, rel=1e-3, abs=1e-2 * scale)


def test_noise_in_the_states_is_told_from_another_cost() -> None:
    """The cost is that of the true states; what was logged of them is noisy."""
    s, u = states_and_inputs()
    noisy = s + 0.05 * np.random.default_rng(1).normal(size=s.shape)
    found = known_cost(mpc_of(), table(noisy, u, quadratic(s, u)))
    assert found is not None
    assert found.scale == 1.0
    assert 1e-5 < found.missed < 0.05
    for name, other in {
        "another weight": quadratic(s, u, W=np.diag([2.0, 0.8])),
        "a term in the input": quadratic(s, u, R=np.array([[0.4]])),
        "a kink": quadratic(s, u) + 2.0 * np.abs(s[:, :-1, 1]),
    }.items():
        assert known_cost(mpc_of(), table(noisy, u, other)) is None, name


def test_rows_in_which_the_plant_cuts_inputs_off_do_not_hide_it() -> None:
    """Here only |u| < 1.5 reaches the plant; the log has what was asked for."""
    s, u = states_and_inputs()
    cost = quadratic(s, np.clip(u, -1.5, 1.5), R=np.array([[3.0]]))
    mpc = mpc_of(R=np.array([[3.0]]))
    found = known_cost(mpc, table(s, u, cost))
    assert found is not None
    assert found.agreeing == pytest.approx(np.mean(np.abs(u) <= 1.5), abs=0.01)
    assert (found.scale, found.offset) == (1.0, pytest.approx(0.0, abs=1e-4))


def test_a_log_at_rest_does_not_show_its_cost() -> None:
    """1 - cos is a square near zero: a log that is at rest most of the time says nothing about the rest."""
    s, u = states_and_inputs()
    s[:, :40] = REFERENCE + 1e-3 * (s[:, :40] - REFERENCE)
    e = s[:, :-1, 0] - REFERENCE[0]
    cost = quadratic(s, u, W=np.diag([0.0, 0.5])) + 4.0 * (1.0 - np.cos(e))
    assert known_cost(mpc_of(), table(s, u, cost)) is None


def test_costs_that_are_one_number_say_nothing() -> None:
    """A bonus for being alive."""
    s, u = states_and_inputs()
    cost, ended = np.full(u.shape[:2], -1.0), np.zeros(u.shape[:2], bool)
    cost[:, -1], ended[:, -1] = 0.0, True
    found = known_cost(mpc_of(), table(s, u, cost, ended))
    assert found is not None
    assert found.constant
    assert found.offset == -1.0
    assert "does not" not in str(found)
    assert "end an episode" in str(found)


def test_other_weights_are_taken_over() -> None:
    """The form is the user's, its numbers are the log's."""
    s, u = states_and_inputs()
    data = table(s, u, quadratic(s, u))
    other = mpc_of(W=np.array([[1.0, 0.3], [0.3, 1.0]]), R=np.array([[1.0]]))
    assert known_cost(other, data) is None
    known = with_known_cost(Known(other, data), CostConfig("auto"))
    assert known.cost is not None
    values = known.mpc.values
    np.testing.assert_allclose(values["stage_cost.W"], W, atol=1e-3)
    np.testing.assert_allclose(values["stage_cost.R"], R, atol=1e-3)
    assert with_known_cost(Known(other, data), CostConfig()).cost is None  # by default it is fitted


def test_a_given_cost_stays_whatever_was_logged(caplog: pytest.LogCaptureFixture) -> None:
    """Also one of another scale; which relation was found is said."""
    s, u = states_and_inputs()
    mpc = mpc_of()
    for cost, option in (
        (50.0 * quadratic(s, u) + 7.0, {}),
        (np.abs(s[:, :-1]).sum(axis=2), {"stage_cost": "given"}),
    ):
        learner = OfflineMPCLearner(mpc, value_n_steps=30, **option)
        with caplog.at_level(logging.INFO, "mpcoffline"):
            learner.fit(table(s, u, cost), show_progress=False)
        assert "not learned but kept" in caplog.text
        for name in ("stage_cost.W", "stage_cost.R", "stage_cost.x_ref"):
            np.testing.assert_array_equal(learner.mpc.values[name], mpc.values[name])


def test_what_is_no_way_to_treat_the_cost_is_refused() -> None:
    """The nearest names are in the message."""
    with pytest.raises(UnknownIdError, match="stage_cost"):
        CostConfig("known")  # type: ignore[arg-type]


def test_a_learner_says_that_it_kept_the_cost(tmp_path: Path) -> None:
    """Also in its file; and the error of (FIT) is that of the scaled cost."""
    s, u = states_and_inputs()
    log = table(s, u, 100.0 * quadratic(s, u) + 7.0)
    learner = OfflineMPCLearner(mpc_of(), value_n_steps=30, hidden=(8,))
    assert learner.findings == ()
    learner.fit(log, show_progress=False)
    assert "L = 100 Lhat +7" in str(learner)
    learner.save(tmp_path / "learner.zip")
    again = OfflineMPCLearner.load(tmp_path / "learner.zip")
    assert again.result is not None
    assert learner.result is not None
    assert again.result.cost is not None
    assert (again.result.cost, again.findings) == (learner.result.cost, learner.findings)
    assert again.value_function is not None
    errors = fit_errors(mpc_of(), again.mpc, again.value_function, log, again.result)
    assert errors[0].after < 1e-3


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1.03, 0.0), (0.97, -4.0), (1.0, 1e-3)])
def test_what_is_exact_is_said_as_it_is(scale: float, offset: float) -> None:
    """A scale near 1 is no 1 where there is no noise, rounding is no offset."""
    s, u = states_and_inputs()
    found = known_cost(mpc_of(), table(s, u, scale * quadratic(s, u) + offset))
    assert found is not None
    assert found.scale == pytest.approx(scale, rel=1e-5)
    assert found.offset == pytest.approx(offset, abs=2e-5 * max(1.0, abs(offset)))
    assert (found.scale == 1.0) == (scale == 1.0)
    assert (found.offset == 0.0) == (offset == 0.0)
    cut = np.clip(u, -1.0, 1.0)
    part = table(s, u, scale * quadratic(s, cut) + offset)
    relation = known_cost(mpc_of(), part)
    assert relation is not None
    assert len(as_logged(mpc_of(), part, relation)) == pytest.approx(np.isclose(cut, u).sum(), abs=5)


def test_a_model_is_identified_where_the_plant_took_the_logged_input() -> None:
    """A cart whose drive gives at most 1: it moves, and pays, for what it gives."""
    s, u = states_and_inputs(n_episodes=20)
    given, f = np.clip(u, -1.0, 1.0), mpc_of().dynamics_function
    for t in range(u.shape[1]):
        s[:, t + 1] = f(s[:, t].T, given[:, t].T, mpc_of().theta).full().T
    log = table(s, u, quadratic(s, given))

    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return ca.vertcat(x[1], p["b"] * u[0] - p["c"] * x[1])

    rough = mpc_of().replace(model=Model(ode, nx=2, nu=1, dt=0.1, parameters={"b": 0.7, "c": 0.3}))
    cost = known_cost(rough, log)
    assert cost is not None
    assert cost.agreeing == pytest.approx(np.mean(given == u), abs=0.01)
    assert cost.agreeing < 0.7
    b, c = identify(rough, log).theta[:2]
    assert abs(b - 1.0) > 0.2  # as all rows have it
    b, c = identify(rough, as_logged(rough, log, cost)).theta[:2]
    np.testing.assert_allclose([b, c], [1.0, 0.5], rtol=1e-3)
    known = identified(Known(rough, log, cost=cost), StartConfig(init="identified"))
    np.testing.assert_allclose(known.mpc.theta[:2], [1.0, 0.5], rtol=1e-3)
    assert len(known.table) == len(log)
    assert as_logged(rough, log, None) is log


def test_costs_and_slopes_by_rows_are_casadis_for_operations_that_numpy_lacks_too() -> None:
    x, theta = ca.SX.sym("x", 2), ca.SX.sym("theta", 2)
    rows, values = np.random.default_rng(0).normal(size=(50, 2)), np.array([1.5, 0.7])
    for wrapped in (ca.remainder(x[0], 1.0), ca.sin(x[0])):
        function = ca.Function("f", [x, theta], [ca.vertcat(theta[0] * wrapped**2, theta[1] * x[1])])
        expected = np.stack([function(row, values).full()[:, 0] for row in rows])
        np.testing.assert_allclose(_by_rows(function)(rows, values), expected, rtol=1e-14, atol=1e-15)
