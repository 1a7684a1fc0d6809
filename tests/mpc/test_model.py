"""The prediction model: its integrator, its parameters, and what it refuses."""

from __future__ import annotations

import json
import math
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.mpc import Model, Parameter


def oscillator(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    """Van der Pol with mass and damping."""
    return ca.vertcat(x[1], (u[0] - x[0] + p["c"] * (1 - x[0] ** 2) * x[1]) / p["m"])


def make_oscillator(dt: float = 0.05) -> Model:
    return Model(oscillator, 2, 1, dt, {"m": Parameter(1.3, low=0.1, unit="kg"), "c": 0.7})


def exact_oscillator(state: np.ndarray, u: float, dt: float) -> np.ndarray:
    def rhs(_: float, s: np.ndarray) -> list[float]:
        return [s[1], (u - s[0] + 0.7 * (1 - s[0] ** 2) * s[1]) / 1.3]

    return np.asarray(solve_ivp(rhs, (0.0, dt), state, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1])


def test_ode_is_integrated_by_rk4() -> None:
    """The local error of RK4 is c dt^5: small, and 32 times smaller at half the step."""
    rng = np.random.default_rng(0)
    coarse, fine = [], []
    for state, u in zip(rng.uniform(-2, 2, (30, 2)), rng.uniform(-1, 1, 30), strict=True):
        for dt, errors in ((0.1, coarse), (0.05, fine)):
            reached = make_oscillator(dt)(state, [u])
            errors.append(np.abs(reached - exact_oscillator(state, u, dt)).max())
    assert max(fine) < 1e-6
    assert 24 < np.median(np.array(coarse) / np.array(fine)) < 42


def test_discrete_map_is_taken_as_it_is() -> None:
    A, B = np.arange(6.0).reshape(2, 3)[:, :2] + 1, np.array([[1.0], [-2.0]])
    model = Model(lambda x, u, p: p["A"] @ x + p["B"] @ u, 2, 1, 0.1, {"A": A, "B": B}, discrete=True)
    x, u = np.random.default_rng(0).normal(size=(7, 2)), np.random.default_rng(1).normal(size=(7, 1))
    np.testing.assert_allclose(model(x, u), x @ A.T + u @ B.T, rtol=1e-14)


def test_array_parameters_are_row_major_in_theta() -> None:
    A = np.array([[1.0, 2.0], [3.0, 4.0]])
    model = Model(lambda x, u, p: p["A"] @ x + u[0], 2, 1, 0.1, {"A": A}, discrete=True)
    np.testing.assert_array_equal(model.space.theta, [1, 2, 3, 4])
    other = model.with_theta(np.array([5.0, 6.0, 7.0, 8.0]))
    np.testing.assert_allclose(other([1.0, 10.0], [0.0]), [65.0, 87.0])
    np.testing.assert_array_equal(other.values["A"], [[5, 6], [7, 8]])
    np.testing.assert_array_equal(model.values["A"], A)  # the first model is as it was


def test_vector_parameters_are_columns() -> None:
    model = Model(lambda x, u, p: x + p["d"] * u[0], 3, 1, 0.1, {"d": [1.0, 2.0, 3.0]}, discrete=True)
    np.testing.assert_allclose(model([0, 0, 0], [2.0]), [2, 4, 6])


def test_batches_and_broadcasting() -> None:
    model = make_oscillator()
    x, u = np.random.default_rng(0).normal(size=(4, 3, 2)), np.random.default_rng(1).normal(size=(4, 3, 1))
    reached = model(x, u)
    assert reached.shape == (4, 3, 2)
    np.testing.assert_array_equal(reached[2, 1], model(x[2, 1], u[2, 1]))
    np.testing.assert_array_equal(model(x, u[0, 0]), model(x, np.broadcast_to(u[0, 0], (4, 3, 1))))
    np.testing.assert_array_equal(model(x[0, 0], u), model(np.broadcast_to(x[0, 0], (4, 3, 2)), u))


@pytest.mark.parametrize(
    ("x", "u", "name"), [(np.zeros(4), [0.0], "x"), ([0.0, 0.0], np.zeros(2), "u"), (0.0, [0.0], "x")]
)
def test_wrong_shapes_are_refused(x: Any, u: Any, name: str) -> None:
    with pytest.raises(InvalidArgumentError, match=rf"{name}: expected shape \(\.\.\., \d\), got shape"):
        make_oscillator()(x, u)


def test_model_without_parameters() -> None:
    model = Model(lambda x, u, p: x + u, 1, 1, 0.1, discrete=True)
    assert model.space.size == 0
    assert model([1.0], [2.0]) == 3.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"nx": 0}, "nx: expected a positive integer"),
        ({"nu": -1}, "nu: expected a positive integer"),
        ({"nx": 2.7}, "nx: expected a positive integer, got 2.7"),
        ({"dt": 0.0}, "dt, in s: expected a finite number above 0"),
        ({"dt": -0.1}, "dt, in s: expected a finite number above 0"),
        ({"dt": np.nan}, "dt, in s: expected a finite number above 0"),
        ({"dt": None}, "dt, in s: expected a finite number above 0, got None"),
    ],
)
def test_bad_sizes(changes: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"nx": 2, "nu": 1, "dt": 0.1, "parameters": {"m": 1.0, "c": 1.0}}
    with pytest.raises(InvalidArgumentError, match=message):
        Model(oscillator, **(arguments | changes))


def python_if(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    return x if x[0] > 0 else -x


@pytest.mark.parametrize(
    "dynamics",
    [
        lambda x, u, p: ca.vertcat(math.sin(x[0]), x[1]),
        lambda x, u, p: np.array(["not", "numbers"]),
        lambda x, u, p: ca.vertcat(x[7], x[0]),
        lambda x, u, p: None,
        python_if,
    ],
    ids=["math.sin", "strings", "index", "None", "if"],
)
def test_dynamics_that_casadi_cannot_trace(dynamics: Any) -> None:
    with pytest.raises(InvalidArgumentError, match=r"(?s)dynamics: expected a function of CasADi SX.*casadi\.sin"):
        Model(dynamics, 2, 1, 0.1)


def test_dynamics_of_the_wrong_shape() -> None:
    for dynamics in (lambda x, u, p: x[0], lambda x, u, p: x.T, lambda x, u, p: ca.vertcat(x, u)):
        for discrete in (False, True):
            with pytest.raises(InvalidArgumentError, match="dynamics: expected a column of 2 expressions"):
                Model(dynamics, 2, 1, 0.1, discrete=discrete)


def test_a_name_that_is_no_parameter() -> None:
    with pytest.raises(InvalidArgumentError, match=r"dynamics: expected parameters m, got p\['mass'\]"):
        Model(lambda x, u, p: x / p["mass"], 2, 1, 0.1, {"m": 1.0})


def test_it_names_its_parameters() -> None:
    assert repr(Model(lambda x, u, p: p["A"] @ x, 2, 1, 0.1, {"A": np.eye(2), "m": 1.0})) == "Model(A (2, 2), m = 1)"


def test_json_roundtrip_bit_for_bit() -> None:
    model = make_oscillator()
    again = Model.from_json(json.loads(json.dumps(model.to_json())))
    assert (again.nx, again.nu, again.dt) == (2, 1, 0.05)
    x, u = np.random.default_rng(0).normal(size=(50, 2)), np.random.default_rng(1).normal(size=(50, 1))
    np.testing.assert_array_equal(again(x, u), model(x, u))
    np.testing.assert_array_equal(again.space.low, model.space.low)


def test_json_of_other_sizes_is_refused() -> None:
    with pytest.raises(FileFormatError, match="model: expected inputs of sizes"):
        Model.from_json(make_oscillator().to_json() | {"nx": 3})
