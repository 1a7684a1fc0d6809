"""Signals along the horizon, in dynamics and in costs, against problems written without them."""

from __future__ import annotations

import json
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import linprog

from mpcoffline import MPC, Constraint, Model, MPCPolicy, Parameter, QuadraticCost, Signal, StateBounds
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import LiftedCost, polynomial_features
from mpcoffline.mpc.component import Component
from mpcoffline.mpc.layout import Layout
from mpcoffline.mpc.parameters import ParameterSpace
from mpcoffline.solvers import make_solver

BOUNDS: dict[str, Any] = {"action_low": [-1.0], "action_high": [1.0]}


def tank(x: ca.SX, u: ca.SX, p: dict[str, ca.SX], d: Any = None) -> ca.SX:
    return 0.9 * x + 0.5 * u


def following(preview: int = 0, delay: int | None = None, horizon: int = 12) -> MPC:
    """A tank whose level follows a set-point in the observation."""
    model = Model(tank, 1, 1, 1.0, discrete=True, delay=delay, signals=[Signal("set_point", "cm", preview=preview)])
    tracks = {0: "set_point"}
    stage, end = QuadraticCost([[1.0]], [[0.1]], tracks=tracks), QuadraticCost([[3.0]], tracks=tracks)
    return MPC(model, stage, end, horizon, 0.95, **BOUNDS)


def fixed(set_point: float, horizon: int = 12) -> MPC:
    stage, end = QuadraticCost([[1.0]], [[0.1]], x_ref=[set_point]), QuadraticCost([[3.0]], x_ref=[set_point])
    return MPC(Model(tank, 1, 1, 1.0, discrete=True), stage, end, horizon, 0.95, **BOUNDS)


@pytest.mark.parametrize("name", ["lqr", "ddp", "ipopt"])
def test_one_policy_follows_each_set_point_as_an_mpc_of_its_own_would(name: str) -> None:
    solver = make_solver(following(), name)
    y = np.random.default_rng(0).uniform(-2.0, 2.0, (6, 2))
    found = solver.solve(y)
    assert found.success.all()
    for row, u, value in zip(y, found.u, found.value, strict=True):
        expected = make_solver(fixed(row[1]), "lqr").solve(row[:1])
        np.testing.assert_allclose(u, expected.u, atol=2e-4)
        assert value == pytest.approx(float(expected.value), rel=1e-5, abs=1e-6)


def test_a_previewed_set_point_is_the_reference_of_each_stage() -> None:
    """Against the same problem with one reference a stage; what lies beyond the preview is held."""
    coming = np.array([0.0, 0.0, 1.0, 1.5, -0.5])
    found = make_solver(following(preview=4), "lqr").solve(np.array([0.3, *coming]))
    along = np.append(coming, np.full(8, coming[-1]))[:, None]
    plain = fixed(0.0)
    theta = plain.theta_along({"stage_cost.x_ref": along, "terminal_cost.x_ref": along})
    expected = make_solver(plain, "ipopt").solve(np.array([[0.3]]), theta=theta)
    np.testing.assert_allclose(found.u, expected.u[0], atol=1e-5)
    assert found.value == pytest.approx(float(expected.value[0]), rel=1e-6)


class Trade(Component):
    """What is bought at the price of the step."""

    uses_signals = True

    def __init__(self) -> None:
        self.space = ParameterSpace([])

    def expression(self, x: ca.SX, u: ca.SX, p: dict[str, ca.SX], d: Any) -> ca.SX:
        return d.price * u[0] + 1e-6 * u[0] ** 2

    def terminal_expression(self, x: ca.SX, p: dict[str, ca.SX], d: Any) -> ca.SX:
        return 0.0 * d["price"]


def test_a_battery_with_a_price_preview_against_a_linear_programme() -> None:
    n, rng = 8, np.random.default_rng(3)
    battery = Model(lambda x, u, p: x + u, 1, 1, 1.0, discrete=True, signals=[Signal("price", preview=n - 1)])
    limits = [StateBounds([0.0, *[-np.inf] * n], [4.0, *[np.inf] * n])]
    mpc = MPC(battery, Trade(), Trade(), n, 1.0, [-1.5], [1.5], constraints=limits)
    solver = make_solver(mpc, "ipopt")
    for _ in range(4):
        prices, level = rng.uniform(0.1, 0.4, n), rng.uniform(0.5, 3.5)
        sums = np.tril(np.ones((n, n)))
        best = linprog(
            prices, np.vstack([sums, -sums]), np.append(np.full(n, 4.0 - level), np.full(n, level)), bounds=(-1.5, 1.5)
        )
        found = solver.solve(np.array([level, *prices]))
        assert found.success
        assert float(found.value) == pytest.approx(best.fun, abs=1e-4)
    read = MPC.from_json(json.loads(json.dumps(mpc.to_json())))
    z, u = rng.normal(size=mpc.nx), [0.7]
    assert float(read.stage_function(z, u, read.theta)) == pytest.approx(float(mpc.stage_function(z, u, mpc.theta)))


def test_a_limit_that_is_a_signal_holds_step_by_step_and_at_the_end() -> None:
    """An integrator drawn up to a ceiling that was previewed: as far as the lower of ceiling and reach allow."""
    n, ceiling = 5, np.array([9.0, 1.0, 0.4, 1.5, 0.2, 0.7])
    model = Model(lambda x, u, p: x + u, 1, 1, 1.0, discrete=True, signals=[Signal("top", preview=n)])
    limits = [
        Constraint(lambda x, u, p, d: x[0] - d.top, "ceiling"),
        Constraint(lambda x, p, d: x[0] - d["top"], "last ceiling", terminal=True),
    ]
    cost = QuadraticCost([[1.0]], [[1e-8]], x_ref=[3.0])
    mpc = MPC(model, cost, QuadraticCost([[1.0]], x_ref=[3.0]), n, 1.0, [-5.0], [5.0], constraints=limits)
    read = MPC.from_json(json.loads(json.dumps(mpc.to_json())))
    for problem in (mpc, read):
        found = make_solver(problem, "ipopt").solve(np.array([0.0, *ceiling]))
        assert found.success
        np.testing.assert_allclose(found.x[1:, 0], ceiling[1:], atol=1e-5)
    with pytest.raises(InvalidArgumentError, match="signal 'floor'"):
        mpc.replace(constraints=[Constraint(lambda x, u, p, d: d.floor - x[0])])


def test_dynamics_take_the_present_value_by_name() -> None:
    """dx/dt = -x + u + k inflow, the inflow held over the step: exactly known."""

    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX], d: Any) -> ca.SX:
        return -x + u + p["k"] * d.inflow

    signals = [Signal("price", preview=2), Signal("inflow", "l/s", preview=1)]
    model = Model(ode, 1, 1, 0.3, {"k": Parameter(0.7)}, delay=1, signals=signals)
    assert (model.ny, model.nx) == (6, 7)
    z = np.array([2.0, 0.1, 0.2, 0.3, 5.0, 6.0, 0.4])  # level, prices, inflows, u[k-1]
    decayed = np.exp(-0.3)
    expected = decayed * 2.0 + (1.0 - decayed) * (0.4 + 0.7 * 5.0)
    np.testing.assert_allclose(model(z, [9.0]), [expected, 0.2, 0.3, 0.3, 6.0, 6.0, 9.0], rtol=1e-6)
    read = Model.from_json(json.loads(json.dumps(model.to_json())))
    np.testing.assert_allclose(read(z, [9.0]), model(z, [9.0]), rtol=1e-12)
    assert read.layout == model.layout


def test_the_observation_has_the_signals_and_a_policy_takes_them() -> None:
    policy = MPCPolicy(following(preview=2, delay=2))
    assert policy.observation_space.shape == (4,)
    action, state = policy.predict(np.array([0.0, 1.0, 1.0, 1.0]))
    other, _ = policy.predict(np.array([0.0, -1.0, -1.0, -1.0]))
    np.testing.assert_allclose(action, -other, atol=1e-5)
    assert action[0] > 0.1
    assert state[2].shape == (1, 2)


def test_states_without_signals_get_usual_ones() -> None:
    layout = Layout.of(1, 1, 1, [Signal("feed", preview=1, usual=3.0)])
    np.testing.assert_array_equal(layout.usual_signals, [3.0, 3.0])
    model = Model(tank, 1, 1, 1.0, discrete=True, delay=1, signals=layout.signals)
    mpc = MPC(model, QuadraticCost([[1.0]], [[1.0]]), QuadraticCost([[1.0]]), 5, 0.9, **BOUNDS)
    np.testing.assert_array_equal(mpc.state([2.0]), [2.0, 3.0, 3.0, 0.0])
    np.testing.assert_array_equal(mpc.state([2.0, 5.0, 6.0]), [2.0, 5.0, 6.0, 0.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "set point"}, "a Python identifier"),
        ({"name": "lambda"}, "a Python identifier"),
        ({"name": "price", "preview": -1}, "preview"),
        ({"name": "price", "preview": 10**9}, "preview"),
        ({"name": "price", "usual": float("nan")}, "usual"),
    ],
)
def test_signals_that_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        Signal(**arguments)


def test_names_are_checked_where_they_are_used() -> None:
    with pytest.raises(InvalidArgumentError, match="names of signals: expected unique names"):
        Model(tank, 1, 1, 1.0, discrete=True, signals=[Signal("a"), Signal("a")])
    with pytest.raises(InvalidArgumentError, match="signals: expected a list of Signal"):
        Model(tank, 1, 1, 1.0, discrete=True, signals=["price"])  # type: ignore[list-item]
    with pytest.raises(InvalidArgumentError, match="signal 'inflow'"):
        Model(lambda x, u, p, d: x + d.inflow, 1, 1, 1.0, discrete=True, signals=[Signal("price")])
    with pytest.raises(InvalidArgumentError, match="set_point"):
        MPC(
            Model(tank, 1, 1, 1.0),
            QuadraticCost([[1.0]], tracks={0: "set_point"}),
            QuadraticCost([[1.0]]),
            5,
            0.9,
            [-1],
            [1],
        )
    with pytest.raises(InvalidArgumentError, match="tracks"):
        QuadraticCost([[1.0]], tracks={1: "set_point"})


def test_bounds_may_be_of_the_plants_states_alone() -> None:
    every = StateBounds([-np.inf, -np.inf, -np.inf, -np.inf], [0.4, np.inf, np.inf, np.inf])
    given = following(preview=2, delay=1)
    mpcs = [given.replace(constraints=[bounds]) for bounds in (every, StateBounds([-np.inf], [0.4]))]
    mpcs.append(MPC.from_json(json.loads(json.dumps(mpcs[1].to_json()))))
    for mpc in mpcs:
        np.testing.assert_array_equal(mpc.state_bounds[0].high, [0.4, *[np.inf] * 4])
    plans = [make_solver(mpc, "ipopt").solve(mpc.state([0.0, 1.0, 1.0, 1.0])) for mpc in mpcs[:2]]
    np.testing.assert_array_equal(plans[0].u, plans[1].u)
    assert plans[1].x.max(axis=0)[0] == pytest.approx(0.4, abs=1e-6)
    with pytest.raises(InvalidArgumentError, match="expected 1 numbers, one a state, or 4 with signals"):
        given.replace(constraints=[StateBounds([0.0, 0.0], [1.0, 1.0])])


def test_a_lifted_cost_follows_the_signals_that_its_quadratic_one_does() -> None:
    quadratic = following()
    lifted = quadratic.replace(
        stage_cost=LiftedCost.of(quadratic.stage_cost, polynomial_features(1)),  # type: ignore[arg-type]
        terminal_cost=LiftedCost.of(quadratic.terminal_cost, polynomial_features(1)),  # type: ignore[arg-type]
    )
    for mpc in (lifted, MPC.from_json(json.loads(json.dumps(lifted.to_json())))):
        for z in ([0.3, 1.0], [-0.5, -2.0]):
            for found, expected in (
                (mpc.stage_function(z, [0.2], mpc.theta), (z[0] - z[1]) ** 2 + 0.1 * 0.2**2),
                (mpc.terminal_function(z, mpc.theta), 3.0 * (z[0] - z[1]) ** 2),
            ):
                assert float(found) == pytest.approx(expected)
