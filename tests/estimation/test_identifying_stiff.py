"""Identification of stiff and fast plants: substeps from the log, and again at what was found."""

from __future__ import annotations

import logging
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from mpcoffline import OfflineMPCLearner
from mpcoffline.core.errors import InvalidDataError
from mpcoffline.datasets import TransitionTable
from mpcoffline.estimation.identification import ABSURD, identify_one_step
from mpcoffline.estimation.identifying import identify
from mpcoffline.mpc import MPC, Model, NormCost, Parameter, QuadraticCost

Array = NDArray[np.float64]


def mpc_of(model: Model) -> MPC:
    cost = QuadraticCost(np.eye(model.nx), np.eye(model.nu))
    return MPC(model, cost, NormCost(np.zeros(model.nx)), 10, 0.9, [-1.0] * model.nu, [1.0] * model.nu)


def table_of(x: Array, u: Array, reached: Array) -> TransitionTable:
    costs = (x**2).sum(axis=1) + (u**2).sum(axis=1)
    return TransitionTable.from_arrays(x, u, costs, reached, np.zeros(len(x)))


def draw(n: int, nx: int, nu: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(0)
    return rng.uniform(-1.0, 1.0, (n, nx)), rng.uniform(-1.0, 1.0, (n, nu))


def coil(tau: float, *, squared: bool, **options: Any) -> MPC:
    """A speed that a current drives, and the current with its time constant; dt = 0.1."""

    def ode(x: Any, u: Any, p: Any) -> ca.SX:
        force = x[1] + (0.2 * x[1] ** 2 if squared else 0.0)
        return ca.vertcat(p["k"] * force - x[0], (u[0] - x[1]) / p["tau"])

    parameters = {"k": Parameter(1.3, low=0.3, high=4.0), "tau": Parameter(tau, low=tau / 5, high=5 * tau)}
    return mpc_of(Model(ode, 2, 1, 0.1, parameters, **options))


def log_of_coil(tau: float, *, squared: bool, n: int = 400) -> TransitionTable:
    """The same with k = 1 from where it is known: the current's exponential, and Simpson's rule of 2000 intervals."""
    x, u = draw(n, 2, 1)
    t = np.linspace(0.0, 0.1, 2001)
    current = u + (x[:, 1:] - u) * np.exp(-t / tau)
    force = (current + (0.2 * current**2 if squared else 0.0)) * np.exp(t - 0.1)
    weights = np.where(np.arange(2001) % 2, 4.0, 2.0)
    weights[[0, -1]] = 1.0
    speed = np.exp(-0.1) * x[:, 0] + force @ weights * (0.1 / 2000 / 3.0)
    return table_of(x, u, np.column_stack([speed, current[:, -1]]))


def test_the_log_is_that_of_the_exponential() -> None:
    x, u, _, reached, _ = log_of_coil(0.03, squared=False).values()
    matrix = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0 / 0.03, 1.0 / 0.03], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(np.hstack([x, u]) @ expm(0.1 * matrix)[:2].T, reached, atol=1e-6)


@pytest.mark.parametrize("start", [0.012, 0.03, 0.08])
@pytest.mark.parametrize("squared", [False, True])
def test_a_short_time_constant_is_found_from_either_side(start: float, squared: bool) -> None:
    """With one Runge-Kutta step of 0.1 s there is another one that fits as well, and twice as wrong."""
    found = identify(coil(start, squared=squared), log_of_coil(0.025, squared=squared))
    np.testing.assert_allclose(found.theta[:2], [1.0, 0.025], rtol=0.02)
    np.testing.assert_array_equal(found.model.space.theta, found.theta[:2])
    assert found.model.scheme is not None
    assert found.model.scheme.kind == ("rk4" if squared else "exact")
    assert found.error_after < 0.02


def test_a_fit_takes_the_substeps_of_the_log_and_files_keep_them(tmp_path: Any) -> None:
    mpc, table = coil(0.08, squared=True), log_of_coil(0.025, squared=True)
    learner = OfflineMPCLearner(mpc, preset="paper", value_n_steps=5, fit_n_steps=5)
    learner.fit(table, show_progress=False)
    expected = mpc.model.suited_to_log(table).scheme
    assert learner.mpc.model.scheme == expected
    learner.save(tmp_path / "learner.zip")
    again = OfflineMPCLearner.load(tmp_path / "learner.zip")
    assert again.mpc.model.scheme == expected
    x, u = draw(20, 2, 1)
    np.testing.assert_array_equal(again.mpc.model(x, u), learner.mpc.model(x, u))
    assert learner.nominal_mpc.model is mpc.model


def exploding(x: Any, u: Any, p: Any) -> ca.SX:
    """A map that is linear but near the end of what was drawn, where it is absurd."""
    return p["a"] * x + u + ca.if_else(x > 0.99, 1e25, 0.0)


def test_absurd_predictions_are_counted_and_do_no_harm(caplog: pytest.LogCaptureFixture) -> None:
    x, u = draw(2000, 1, 1)
    table = table_of(x, u, 0.7 * x + u)
    mpc = mpc_of(Model(exploding, 1, 1, 0.1, {"a": 0.5}, discrete=True))
    with caplog.at_level(logging.WARNING):
        found = identify(mpc, table)
    assert found.absurd == (np.sum(table.observations > 0.99), 2000)
    assert found.theta[0] == pytest.approx(0.7, abs=0.01)
    assert f"{found.absurd[0]} of 2000 rows are absurd" in caplog.text
    assert found.errors_after.max() <= ABSURD


def test_what_predicts_no_row_is_an_error() -> None:
    x, u = draw(200, 1, 1)
    mpc = mpc_of(Model(lambda x, u, p: p["a"] * x + 1e12, 1, 1, 0.1, {"a": 0.5}, discrete=True))
    with pytest.raises(InvalidDataError, match=r"identification: expected data that the model can predict"):
        identify_one_step(mpc, table_of(x, u, x))
