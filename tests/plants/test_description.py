"""A described plant: its MPC against the same written by hand, and what is refused, by name and line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from two_tanks import dynamics, root, two_tanks

from mpcoffline import MPC, Input, InvalidArgumentError, Limit, Parameter, QuadraticCost, Signal, State, make_solver
from mpcoffline.estimation.findings import Finding, named
from mpcoffline.mpc import Constraint, ExpressionCost, StateBounds

rng = np.random.default_rng(0)
X, U = rng.uniform(1.0, 20.0, (5, 2)), rng.uniform(0.0, 6.0, (5, 1))


def derivative(x: np.ndarray[Any, Any], u: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    between = 0.07 * root(x[:, 0])
    return np.stack([0.07 * u[:, 0] - between, between - 0.06 * root(x[:, 1])], axis=1)


def test_its_model_moves_as_its_equations_say() -> None:
    mpc, h = two_tanks().mpc(), 1e-3 * 5.0
    x = X.copy()
    for _ in range(1000):  # Euler, a thousand steps
        x = x + h * derivative(x, U)
    y = np.column_stack([X, np.full(5, 12.0)])
    np.testing.assert_allclose(mpc.model(y, U)[:, :2], x, rtol=2e-4)
    np.testing.assert_array_equal(mpc.model(y, U)[:, 2], 12.0)


@pytest.mark.parametrize("form", ["list", "column", "mapping", "discrete"])
def test_dynamics_may_be_returned_in_any_form(form: str) -> None:
    def other(x: Any, u: Any, p: Any) -> Any:
        rates = dynamics(x, u, p)
        if form == "column":
            return ca.vertcat(*rates)
        return dict(zip(("h2", "h1"), reversed(rates), strict=True)) if form == "mapping" else rates

    plant = two_tanks(dynamics=other, discrete=form == "discrete")
    np.testing.assert_allclose(plant.rates_function(X.T, U.T, 12.0, [0.07, 0.07, 0.06]).full().T, derivative(X, U))
    if form == "discrete":
        y = np.column_stack([X, np.full(5, 12.0)])
        np.testing.assert_allclose(plant.mpc().model(y, U)[:, :2], derivative(X, U), rtol=1e-12)


def test_a_quadratic_expression_becomes_a_quadratic_cost_that_follows_the_signal() -> None:
    cost = two_tanks().mpc().stage_cost
    assert isinstance(cost, QuadraticCost)
    np.testing.assert_allclose(cost.W, np.diag([0.0, 1.0]))
    np.testing.assert_allclose(cost.R, [[0.02]])
    assert cost.tracks == {1: "set_point"}


def quadratic(x: Any, u: Any, d: Any, du: Any) -> Any:
    return (
        2 * (x.h2 - d.set_point + 1.0) ** 2
        + 0.5 * (x.h1 - 7) ** 2
        + 0.3 * (u.pump - 2) ** 2
        + 0.2 * (x.h1 - 7) * (u.pump - 2)
        + 4 * du.pump**2
        + 3
    )


def test_references_cross_terms_and_prices_on_changes_are_found_in_an_expression() -> None:
    cost = two_tanks(cost=quadratic).mpc().stage_cost
    assert isinstance(cost, QuadraticCost)
    values = cost.values
    np.testing.assert_allclose(values["H"], [[0.5, 0.0, 0.1], [0.0, 2.0, 0.0], [0.1, 0.0, 0.3]], atol=1e-12)
    np.testing.assert_allclose(values["x_ref"], [7.0, -1.0])
    np.testing.assert_allclose(values["u_ref"], [2.0])
    np.testing.assert_allclose(values["D"], [[4.0]])
    np.testing.assert_allclose(values["constant"], 3.0)


def test_weights_by_name_are_the_same_cost() -> None:
    plant = two_tanks(
        cost={"h2": 2.0, "h1": 0.5, "pump": 0.3},
        references={"h2": "set_point", "h1": 7, "pump": 2},
        changes={"pump": 4.0},
    )
    d, before = np.full((5, 1), 12.0), U[::-1]
    by_hand = (
        2 * (X[:, 1] - 12) ** 2 + 0.5 * (X[:, 0] - 7) ** 2 + 0.3 * (U - 2)[:, 0] ** 2 + 4 * (U - before)[:, 0] ** 2
    )
    np.testing.assert_allclose(plant.costs(X, U, d, before), by_hand)
    assert plant.mpc().stage_cost.values["D"] == pytest.approx(4.0)


@pytest.mark.parametrize(
    "cost",
    [
        lambda x, u, d: ca.fabs(x.h2 - d.set_point),
        lambda x, u, d: d.set_point * u.pump,  # a price
        lambda x, u: x.h1 * x.h2,  # not convex
        lambda x, u, d: ca.fmax(x.h2 - d.set_point, 0) ** 2 + u.pump**2,
        lambda x, u: x.h2**2 + u.pump**4,
    ],
)
def test_any_other_expression_stays_what_it_is(cost: Any) -> None:
    plant = two_tanks(cost=cost)
    mpc = MPC.from_json(plant.mpc().to_json())
    assert isinstance(mpc.stage_cost, ExpressionCost)
    y, d = np.column_stack([X, np.full(5, 12.0)]), np.full((5, 1), 12.0)
    got = mpc.stage_function(y.T, U.T, mpc.theta).full().ravel()
    np.testing.assert_allclose(got, plant.costs(X, U, d, U))
    rest = np.zeros((5, 1))
    np.testing.assert_allclose(mpc.terminal_function(y.T, mpc.theta).full().ravel(), plant.costs(X, rest, d, rest))


def test_limits_rates_delays_and_names_arrive_in_the_mpc() -> None:
    plant = two_tanks(
        inputs=[Input("pump", "V", 0, 6, rate=0.5, delay=2)],
        limits=[
            Limit("low", "h2", low=1.0),
            Limit("power", lambda x, u, d: u.pump * x.h1 - d.set_point, high=50, soft=(1, 2)),
        ],
    )
    mpc = MPC.from_json(plant.mpc().to_json())
    assert mpc.layout.delay == (2,)
    assert [str(label) for label in (*mpc.layout.y_labels, *mpc.layout.u_labels)] == [
        "h1 [cm]", "h2 [cm]", "set_point [cm]", "pump [V]"
    ]  # fmt: skip
    bounds, power, rates = mpc.constraints  # type: ignore[misc]
    assert isinstance(bounds, StateBounds)
    np.testing.assert_array_equal(bounds.low, [-np.inf, 1.0])
    assert isinstance(power, Constraint)
    assert power.soft == (1.0, 2.0)
    h = mpc.constraint_expression(power)(ca.SX([2, 3, 12, 1, 1]), ca.SX(4), ca.SX(mpc.theta))
    assert float(h) == pytest.approx(4 * 2 - 12 - 50)
    assert isinstance(rates, Constraint)
    solution = make_solver(mpc, "ipopt").solve(mpc.state([8.0, 6.0, 12.0], [3.0, 3.0]))
    assert solution.success
    moves = np.diff(np.append(3.0, solution.u.ravel()))
    assert np.abs(moves).max() == pytest.approx(0.5, abs=1e-4)


def test_parameters_get_bounds_of_their_own_sign() -> None:
    space = two_tanks(parameters={"k": 0.07, "c1": Parameter(0.07, low=0.05), "c2": -0.06}).mpc().model.space
    low, high = dict(zip(space.names, space.low, strict=True)), dict(zip(space.names, space.high, strict=True))
    assert (low["k"], high["k"]) == pytest.approx((7e-4, 7.0))
    assert (low["c1"], high["c1"]) == (0.05, np.inf)
    assert (low["c2"], high["c2"]) == pytest.approx((-6.0, -6e-4))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dynamics": lambda x, u: [x.h3, 0]}, r"dynamics \(test_description.py, line \d+\), x.h3: state: expected"),
        ({"dynamics": lambda x, u: [x.h1]}, r"dynamics \(test_description.py, line \d+\): expected 2 entries"),
        ({"dynamics": lambda x, u: {"h1": 1}}, "expected an entry for each state, got none for 'h2'"),
        ({"dynamics": lambda x, u: {"h1": 1, "h2": 1, "g": 1}}, "expected one of h1, h2, got 'g'"),
        ({"dynamics": lambda x, w: [0, 0]}, "an argument 'w'"),
        ({"dynamics": lambda x: [x.h1 if x.h1 > 1 else 0, 0]}, "expected arithmetic of CasADi"),
        ({"dynamics": lambda x: ["a", 0]}, "h1: expected a number or an expression"),
        ({"cost": lambda x, p: x.h1}, "expected a function of x, u, d, du"),
        ({"cost": {"h3": 1.0}}, "cost: expected one of h1, h2, pump, got 'h3'. Did you mean 'h2'"),
        ({"cost": {"h2": -1.0}}, "cost: h2: expected a finite number from 0"),
        ({"cost": {"h2": 1.0}, "references": {"h2": "setpoint"}}, "references: h2: expected one of set_point"),
        ({"references": {"h2": 1.0}}, "references: expected none beside a cost that is a function"),
        ({"states": []}, "states: expected one or more"),
        ({"states": [State("h1"), State("h1")]}, "expected different ones, got 'h1' twice"),
        ({"inputs": ["pump"]}, "inputs: expected a list of Input"),
        ({"limits": [Limit("high", "h9", high=1)]}, "limit 'high': of: expected one of h1, h2, pump"),
        ({"limits": [Limit("high", lambda x: x.h9, high=1)]}, r"limit 'high' \(test_description.py, line \d+\), x.h9"),
        ({"parameters": {"k": "much"}}, "parameter k: expected a number"),
        ({"parameters": {"a b": 1.0}}, "name of a parameter: expected a Python identifier"),
        ({"dt": 0}, "dt: expected a finite number above 0"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_told_by_name_and_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        two_tanks(**changes)


@pytest.mark.parametrize(
    ("quantity", "message"),
    [
        (lambda: State("h 1"), "name of a state: expected a Python identifier"),
        (lambda: State("h1", "cm", 5, 1), "state h1: range: expected low < high, got 5 to 1"),
        (lambda: State("h1", "cm", 0, 1, start=2), "state h1: start: expected a number"),
        (lambda: Input("u", "V", 0, 1, rate=0), "input u: rate: expected a finite number above 0"),
        (lambda: Input("u", "V", 0, 1, delay=-1), "input u: delay: expected an integer >= 0"),
        (lambda: Limit("l", "h1"), "limit 'l': expected low=, high= or both, got no bound. .* write high=0"),
        (lambda: Limit("l", 3), "limit 'l': expected the name of a state"),  # type: ignore[arg-type]
        (lambda: Limit("l", "h1", high="1"), "limit 'l': bounds: expected two numbers, got '1'"),  # type: ignore[arg-type]
        (lambda: Limit("l", "h1", high=float("nan")), "limit 'l': expected low <= high"),
        (lambda: Limit("l", "h1", 3.0, 1.0), "limit 'l': expected low <= high"),
        (lambda: Limit("l", "h1", 3.0, soft=(1, 2, 3)), "limit 'l': soft: expected a price, or a pair"),  # type: ignore[arg-type]
        (lambda: Signal("s", low=2, high=1), "range of signal s: expected low < high"),
        (lambda: Parameter(1.0, spread=2.0), "Parameter spread"),
    ],
)
def test_quantities_refuse_what_makes_no_sense(quantity: Any, message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        quantity()


def test_the_errors_place_is_that_of_the_line() -> None:
    def wrong(x: Any) -> Any:
        first = x.h1
        return [first, x.h7]

    line = wrong.__code__.co_firstlineno + 2
    with pytest.raises(InvalidArgumentError, match=f"{Path(__file__).name}, line {line}\\)"):
        two_tanks(dynamics=wrong)


def test_findings_call_columns_by_their_names() -> None:
    mpc = two_tanks().mpc()
    finding = Finding(
        "observations 0 and 1", "a sign", "that of action 0, observation 2 and observation 7", "", "error"
    )
    found = named(finding, mpc)
    assert (found.name, found.actual) == ("h1 and h2", "that of pump, set_point and observation 7")
    assert found.kind == "error"
