"""Integration of the model's ODE, against scipy's solve_ivp and expm."""

from __future__ import annotations

import json
import logging
from typing import Any

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.datasets import TransitionTable
from mpcoffline.envs import PLANTS
from mpcoffline.mpc import MPC, Model, NormCost, Parameter, QuadraticCost
from mpcoffline.mpc.expressions import function_to_json
from mpcoffline.mpc.torch_twin import TorchTwin
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import make_solver

Array = NDArray[np.float64]


def mpc_of(model: Model, reference: Any = None, bound: float = 1.0) -> MPC:
    reference = np.zeros(model.nx) if reference is None else np.asarray(reference, np.float64)
    cost = QuadraticCost(np.eye(model.nx), np.eye(model.nu), x_ref=reference)
    return MPC(model, cost, NormCost(reference), 15, 0.95, [-bound] * model.nu, [bound] * model.nu)


def solved(rate: Any, x: Array, u: Array, dt: float) -> Array:
    """One step from each state, all in one system, by scipy's DOP853."""

    def together(_: float, states: Array) -> Array:
        return np.concatenate(rate(states.reshape(x.T.shape), u.T))

    return np.asarray(
        solve_ivp(together, (0.0, dt), x.T.ravel(), "DOP853", rtol=1e-9, atol=1e-12).y[:, -1].reshape(x.T.shape).T
    )


def table_of(x: Array, u: Array, reached: Array) -> TransitionTable:
    return TransitionTable.from_arrays(x, u, np.zeros(len(x)), reached, np.zeros(len(x)))


def draw(n: int, nx: int, nu: int, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (n, nx)), rng.uniform(-1.0, 1.0, (n, nu))


# A motor: the current's time constant L / R is 20 times shorter than dt.
def motor(x: Any, u: Any, p: Any) -> ca.SX:
    return ca.vertcat((p["k"] * x[1] - p["d"] * x[0] - 0.3) / p["J"], (u[0] - p["R"] * x[1] - p["k"] * x[0]) / p["L"])


MOTOR = {"k": 0.05, "d": 1e-4, "J": 5e-4, "R": 1.0, "L": 1e-3}
MOTOR_DT = 0.02


def make_motor(**options: Any) -> Model:
    parameters = {name: Parameter(value, low=value / 8, high=8 * value) for name, value in MOTOR.items()}
    return Model(motor, 2, 1, MOTOR_DT, parameters, **options)


def exact_motor(x: Array, u: Array, k: float, d: float, J: float, R: float, L: float) -> Array:
    matrix = np.array([[-d / J, k / J, 0.0, -0.3 / J], [-k / L, -R / L, 1.0 / L, 0.0], [0.0] * 4, [0.0] * 4])
    return np.asarray(np.hstack([x, u, np.ones_like(u)]) @ expm(MOTOR_DT * matrix)[:2].T)


def test_an_affine_ode_is_solved_exactly() -> None:
    model, (x, u) = make_motor(), draw(50, 2, 1)
    assert str(model.scheme).startswith("exact")
    np.testing.assert_allclose(model(x, u), exact_motor(x, u, **MOTOR), rtol=1e-11, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-1.5, 1.5), min_size=5, max_size=5))
def test_it_is_exact_at_other_parameters(moved: list[float]) -> None:
    values = {name: value * np.exp(m) for (name, value), m in zip(MOTOR.items(), moved, strict=True)}
    model, (x, u) = make_motor().with_theta(np.array(list(values.values()))), draw(20, 2, 1)
    np.testing.assert_allclose(model(x, u), exact_motor(x, u, **values), rtol=1e-6, atol=1e-9)


def test_lqr_solves_a_stiff_motor_as_ddp_does() -> None:
    mpc = mpc_of(make_motor(), bound=12.0)
    assert make_solver(mpc, "auto").name in ("lqr", "ddp")
    quadratic = mpc.replace(terminal_cost=QuadraticCost(np.eye(2)))
    x, _ = draw(8, 2, 1)
    by_lqr, by_ddp = (make_solver(quadratic, name).solve(x) for name in ("lqr", "ddp"))
    assert by_lqr.success.all()
    assert by_ddp.success.all()
    np.testing.assert_allclose(by_ddp.value, by_lqr.value, rtol=1e-8)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 4), st.floats(-2.0, 3.0))
def test_exponentials_of_random_matrices(seed: int, nx: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    A, B, c = 10.0**size * rng.normal(size=(nx, nx)), rng.normal(size=(nx, 2)), rng.normal(size=nx)
    A -= (np.linalg.eigvals(A).real.max() + 0.1) * np.eye(nx)  # nothing grows
    model = Model(lambda x, u, p: p["A"] @ x + B @ u + c, nx, 2, 0.1, {"A": A}, integrator="exact")
    x, u = draw(5, nx, 2, seed)
    step = expm(0.1 * np.block([[A, B, c[:, None]], [np.zeros((3, nx + 3))]]))[:nx]
    expected = np.hstack([x, u, np.ones((5, 1))]) @ step.T
    np.testing.assert_allclose(model(x, u), expected, rtol=1e-8, atol=1e-9)


def test_an_affine_ode_of_many_states_goes_without_an_exponential_of_its_parameters() -> None:
    A = -np.eye(12) + 0.1
    assert str(Model(lambda x, u, p: p["A"] @ x + u[0], 12, 1, 0.1, {"A": A}).scheme) == "rk4:1"
    assert str(Model(lambda x, u, p: A @ x + u[0], 12, 1, 0.1).scheme).startswith("exact")


def van_der_pol(x: Any, u: Any, p: Any) -> ca.SX:
    return ca.vertcat(x[1], u[0] - x[0] + (1 - x[0] ** 2) * x[1])


def test_substeps_are_steps_of_a_part_of_the_time() -> None:
    x, u = draw(20, 2, 1)
    whole, part = (Model(van_der_pol, 2, 1, dt, integrator=how) for dt, how in ((0.4, "rk4:4"), (0.1, "rk4")))
    reached = x
    for _ in range(4):
        reached = part(reached, u)
    np.testing.assert_allclose(whole(x, u), reached, rtol=1e-14)


@pytest.mark.parametrize("integrator", ["rk5", "rk4:0", "rk4:1000000", "rk4:", "", None, 4])
def test_what_is_no_integrator(integrator: Any) -> None:
    with pytest.raises(InvalidArgumentError, match=r"integrator: expected 'auto', 'exact', 'rk4' or 'rk4:N'"):
        Model(van_der_pol, 2, 1, 0.1, integrator=integrator)


def test_integrators_that_do_not_fit_the_dynamics() -> None:
    with pytest.raises(InvalidArgumentError, match=r"integrator: expected .* not affine"):
        Model(van_der_pol, 2, 1, 0.1, integrator="exact")
    with pytest.raises(InvalidArgumentError, match=r"integrator: expected none for a discrete map"):
        Model(van_der_pol, 2, 1, 0.1, discrete=True, integrator="rk4")


def lag(tau: float) -> tuple[Any, Any]:
    """A mildly nonlinear plant behind a lag, in CasADi and in numbers."""

    def ode(x: Any, u: Any, p: Any) -> ca.SX:
        return ca.vertcat((u[0] - x[0]) / tau, x[0] - x[1] - 0.3 * x[1] ** 3)

    def rate(x: Array, u: Array) -> list[float]:
        return [(u[0] - x[0]) / tau, x[0] - x[1] - 0.3 * x[1] ** 3]

    return ode, rate


@pytest.mark.parametrize("tau", [1e-3, 4e-3, 2e-2, 1.0])
def test_a_lag_short_against_dt_is_right_before_there_are_data(tau: float) -> None:
    (ode, rate), (x, u) = lag(tau), draw(15, 2, 1)
    model = mpc_of(Model(ode, 2, 1, 0.05)).model
    np.testing.assert_allclose(model(x, u), solved(rate, x, u, 0.05), atol=1e-3)


def test_a_lag_that_no_substeps_follow_is_told(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        mpc_of(Model(lag(1e-5)[0], 2, 1, 0.05))
    assert "replace the fastest states by their steady state" in caplog.text


@pytest.mark.parametrize("name", [name for name, plant in PLANTS.items() if not plant.discrete])
def test_the_tasks_own_step_is_what_they_would_get(name: str) -> None:
    model = nominal_mpc(PLANTS[name].id, seed=0).model
    assert (model.integrator, str(model.scheme)) == ("rk4", "rk4:1")
    ode = model.ode
    assert ode is not None
    free = Model(
        lambda x, u, p: ode(x, u, ca.vertcat(*map(ca.vec, p.values()))),
        model.nx,
        model.nu,
        model.dt,
        {block.name: block.value for block in model.space},
    )
    given = nominal_mpc(PLANTS[name].id, seed=0)
    again = given.replace(model=free).model
    assert str(again.scheme) == "rk4:1"
    assert function_to_json(again.function) == function_to_json(model.function)


# A magnet that holds a ball, its coil's time constant shorter than dt; in other units of position and current.
def magnet(metre: float = 1.0, ampere: float = 1.0) -> tuple[Model, Array]:
    def ode(x: Any, u: Any, p: Any) -> ca.SX:
        z, v, i = x[0] / metre, x[1] / metre, x[2] / ampere
        return ca.vertcat(metre * v, metre * (9.81 - 1e-3 * i**2 / z**2), ampere * (u[0] - 12.0 * i) / p["L"])

    reference = np.array([0.01 * metre, 0.0, 0.01 * np.sqrt(9810.0) * ampere])
    return Model(ode, 3, 1, 0.001, {"L": Parameter(0.0048, low=1e-3, high=2e-2)}), reference


def test_a_magnet_gets_substeps_in_any_units() -> None:
    chosen = []
    for units in ((1.0, 1.0), (1000.0, 1.0), (1.0, 1e-3)):
        model, reference = magnet(*units)
        cost = QuadraticCost(np.eye(3), np.eye(1), x_ref=reference, u_ref=[12.0 * reference[2] / units[1]])
        chosen.append(str(MPC(model, cost, NormCost(reference), 20, 0.97, [0.0], [24.0]).model.scheme))
    assert len(set(chosen)) == 1
    assert chosen[0] in ("rk4:4", "rk4:8")


def test_an_mpc_chooses_once() -> None:
    model, reference = magnet()
    mpc = MPC(model, QuadraticCost(np.eye(3), np.eye(1), x_ref=reference), NormCost(reference), 20, 0.97, [0.0], [24.0])
    other = mpc.with_theta(mpc.theta * 1.1).replace(horizon=5)
    assert other.model.function is mpc.model.function
    assert str(model.scheme) == "rk4:1"  # what was given stays as it was


def stiff_log(dt: float = 0.05, tau: float = 0.02, n: int = 300) -> tuple[Model, TransitionTable, Array]:
    (ode, rate), (x, u) = lag(tau), draw(n, 2, 1)
    reached = solved(rate, x, u, dt)
    return Model(ode, 2, 1, dt, integrator="rk4"), table_of(x, u, reached), reached


def test_a_check_finds_the_errors_that_solve_ivp_finds() -> None:
    model, table, reached = stiff_log()
    check = model.check(table)
    missed = np.abs(model(table.observations, table.actions) - reached).max(axis=0)
    spread = (reached - table.observations).std(axis=0)
    assert check.largest == pytest.approx((missed / spread).max(), rel=1e-3)
    assert (check.scheme, check.substeps, check.n_rows) == ("rk4", 1, 300)
    assert "take integrator='rk4:2', or 'auto'" in str(check)
    assert str(model.suited_to_log(table).scheme) == "rk4:1"  # it was asked for


def test_the_log_decides_and_the_check_is_content() -> None:
    _, table, reached = stiff_log()
    free = Model(lag(0.02)[0], 2, 1, 0.05).suited_to_log(table)
    assert str(free.scheme) == "rk4:2"
    assert str(free.suited_to_log(table, finer=True).scheme) == "rk4:2"
    assert "Nothing to do" in str(free.check(table))
    spread = (reached - table.observations).std(axis=0)
    assert (np.abs(free(table.observations, table.actions) - reached) / spread).max() < 0.2


def test_checks_of_exact_models_and_maps() -> None:
    x, u = draw(100, 2, 1)
    table = table_of(x, u, exact_motor(x, u, **MOTOR))
    check = make_motor().check(table)
    assert check.scheme == "exact"
    assert check.largest < 1e-9
    assert "exact" in str(check)
    assert "as it is" in str(Model(lambda x, u, p: 0.9 * x, 2, 1, 0.1, discrete=True).check(table))


def test_a_jump_in_the_equations_is_called_that() -> None:
    """Where more substeps help by a factor of 2 instead of 16, more are not taken."""

    def friction(x: Any, u: Any, p: Any) -> ca.SX:
        return ca.vertcat(x[1], u[0] - 2.0 * ca.sign(x[1]))

    x, u = draw(2000, 2, 1)
    x[:, 1] *= 0.3
    reached = Model(friction, 2, 1, 0.1, integrator="rk4:64")(x, u)
    check = Model(friction, 2, 1, 0.1).check(table_of(x, u, reached))
    assert check.scheme == "rk4"  # its derivatives are those of an affine one
    assert "a kink or a jump" in check.advice


def test_rows_without_a_derivative_are_counted() -> None:
    x, u = draw(100, 1, 1)
    table = table_of(x, u, x + 0.1 * u)
    check = Model(lambda x, u, p: u - ca.sqrt(x), 1, 1, 0.1).check(table)
    assert check.n_rows == np.sum(x >= 0.0)
    assert f"{np.sum(x < 0.0)} rows have no finite dx/dt" in check.advice


def test_files_hold_the_ode_and_how_it_is_integrated() -> None:
    model, reference = magnet()
    cost = QuadraticCost(np.eye(3), np.eye(1), x_ref=reference)
    mpc = MPC(model, cost, NormCost(reference), 20, 0.97, [0.0], [24.0])
    again = MPC.from_json(json.loads(json.dumps(mpc.to_json())))
    assert (again.model.scheme, again.model.integrator) == (mpc.model.scheme, "auto")
    x, u = reference + 1e-3 * draw(30, 3, 1)[0], draw(30, 3, 1)[1]
    np.testing.assert_array_equal(again.model(x, u), mpc.model(x, u))
    assert again.model.with_scheme(mpc.model.scheme).scheme == mpc.model.scheme
    waiting = Model.from_json(json.loads(json.dumps(model.to_json())))
    assert not waiting.settled
    assert mpc.replace(model=waiting).model.scheme == mpc.model.scheme


@pytest.mark.parametrize(
    "changes",
    [{"scheme": "rk4:1000"}, {"scheme": None}, {"scheme": "exact:4"}, {"integrator": "euler"}, {"integrator": 3}],
)
def test_damaged_integrators_are_refused(changes: dict[str, Any]) -> None:
    data = Model(van_der_pol, 2, 1, 0.1).to_json()
    with pytest.raises(FileFormatError):
        Model.from_json(data | changes)


@pytest.mark.parametrize(
    "model", [make_motor(), Model(van_der_pol, 2, 1, 0.3, integrator="rk4:8")], ids=["exact", "rk4:8"]
)
def test_torch_has_the_same_steps(model: Model) -> None:
    x, u = draw(20, 2, 1)
    theta = torch.from_numpy(model.space.theta)
    twin = TorchTwin(model.function)(torch.from_numpy(x), torch.from_numpy(u), theta)
    np.testing.assert_allclose(twin.numpy(), model(x, u), rtol=1e-12)


def test_a_step_of_more_operations_than_may_be_is_refused_before_it_is_made() -> None:
    """As a small file could ask for: 64 substeps of an ODE that is long already."""

    def ode(x: ca.SX, u: ca.SX, _: object) -> ca.SX:
        for _ in range(5_000):
            x = ca.sin(x)
        return x + u

    document = Model(ode, 1, 1, 0.1, integrator="rk4").to_json()
    with pytest.raises(InvalidArgumentError, match="operations"):
        Model.from_json(document | {"integrator": "rk4:64", "scheme": "rk4:64"})
