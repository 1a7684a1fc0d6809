"""Solvers in other units, from other zeros: the same plans, judged alike."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray
from riccati import optimum

from mpcoffline.mpc import MPC, Block, Model, ParameterSpace, Penalty, QuadraticCost, StateBounds
from mpcoffline.mpc.constraints import Constraint
from mpcoffline.mpc.expression_cost import ExpressionCost
from mpcoffline.solvers import make_solver

Array = NDArray[np.float64]
HORIZON, DISCOUNT = 15, 0.95
CONSTANTS = (1.0 - DISCOUNT**HORIZON) / (1.0 - DISCOUNT)  # what a constant 1 of the stage cost adds to V


class Units:
    """x -> zero + state x, u -> input u, L -> cost L + constant, h -> constraint h."""

    def __init__(
        self,
        state: Any = (1.0, 1.0),
        input: float = 1.0,
        cost: float = 1.0,
        constant: float = 0.0,
        zero: Any = (0.0, 0.0),
        constraint: float = 1.0,
    ) -> None:
        self.state, self.zero = np.asarray(state, dtype=float), np.asarray(zero, dtype=float)
        self.input, self.cost, self.constant, self.constraint = input, cost, constant, constraint

    def problem(self, kind: str) -> MPC:
        """One of four plants: a double integrator, a pendulum, a bounded one, one whose cost is no quadratic form.

        Units are parameters, so that each plant's solver is compiled once.
        """

        def plain(x: ca.SX, u: ca.SX, p: Any) -> tuple[ca.SX, ca.SX]:
            return (x - p["zero"]) / p["state"], u / p["input"]

        def step(x: ca.SX, u: ca.SX, p: Any) -> ca.SX:
            y, v = plain(x, u, p)
            pull = 3.0 * ca.sin(y[0]) - 0.1 * y[1] if kind == "pendulum" else 0.0
            rate = y[1] + 0.1 * (v[0] + pull)
            return p["zero"] + p["state"] * ca.vertcat(y[0] + 0.1 * rate, rate)

        def smooth(x: ca.SX, u: ca.SX, p: Any) -> ca.SX:
            y, v = plain(x, u, p)
            return p["cost"] * (ca.log(1.0 + y[0] ** 2) + 0.1 * y[1] ** 2 + 0.05 * v[0] ** 2) + p["constant"]

        units = {"state": self.state, "zero": self.zero, "input": self.input}
        space = ParameterSpace(
            [Block.free(n, v, "cost") for n, v in (units | {"cost": self.cost, "constant": self.constant}).items()]
        )
        x, u, theta = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("theta", space.size)
        own = ExpressionCost(ca.Function("L", [x, u, theta], [smooth(x, u, space.symbols(theta))]), space)
        weight = self.cost * np.diag(np.array([1.0, 0.1]) / self.state**2)
        quadratic = QuadraticCost(weight, [[0.05 * self.cost / self.input**2]], None, self.zero, None, self.constant)
        speed = StateBounds(
            self.zero - self.state * np.array([np.inf, 0.6]), self.zero + self.state * np.array([np.inf, 0.6])
        )
        corner = Constraint(
            lambda x, u, p: self.constraint * ((x[0] - self.zero[0]) / self.state[0] + u[0] / self.input - 1.2),
            "corner",
            Penalty(5.0 * self.cost / self.constraint, self.cost / self.constraint**2),
        )
        return MPC(
            Model(step, 2, 1, 0.1, units, discrete=True),
            own if kind == "economic" else quadratic,
            QuadraticCost(10.0 * weight, x_ref=self.zero),
            HORIZON,
            DISCOUNT,
            [-2.0 * self.input],
            [2.0 * self.input],
            [speed, corner] if kind == "constrained" else None,
        )

    def solve(self, kind: str, solver: str, y: Array) -> tuple[Array, Array, Array]:
        """Inputs, values and success of the states y, in plain units."""
        found = make_solver(self.problem(kind), solver).solve(self.zero + self.state * y)
        return found.u / self.input, (found.value - self.constant * CONSTANTS) / self.cost, found.success


def states(seed: int, n: int = 4) -> Array:
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (n, 2)) * [1.0, 0.35]


KINDS = [("linear", "lqr"), ("linear", "ddp"), ("pendulum", "ddp"), ("economic", "ddp"), ("constrained", "ipopt")]
powers = st.integers(-20, 20).map(lambda k: 2.0**k)
factors = st.floats(-6.0, 6.0).map(lambda k: 10.0**k)


@pytest.mark.parametrize(("kind", "solver"), KINDS)
@settings(max_examples=3, deadline=None)
@given(scales=st.tuples(powers, powers, powers), cost=powers, constraint=powers, seed=st.integers(0, 99))
def test_powers_of_two_change_nothing(
    kind: str, solver: str, scales: tuple[float, float, float], cost: float, constraint: float, seed: int
) -> None:
    y = states(seed)
    units = Units(scales[:2], scales[2], cost, constraint=constraint)
    u, value, success = units.solve(kind, solver, y)
    expected, expected_value, expected_success = Units().solve(kind, solver, y)
    np.testing.assert_array_equal(success, expected_success)
    np.testing.assert_allclose(value, expected_value, rtol=1e-12)
    np.testing.assert_allclose(u, expected, atol=2e-6)


@pytest.mark.parametrize(("kind", "solver"), KINDS)
@settings(max_examples=3, deadline=None)
@given(
    scales=st.tuples(factors, factors, factors),
    cost=factors,
    constant=st.floats(-1e6, 1e6),
    zero=st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)),
    seed=st.integers(0, 99),
)
def test_no_unit_or_offset_matters(
    kind: str,
    solver: str,
    scales: tuple[float, float, float],
    cost: float,
    constant: float,
    zero: tuple[float, float],
    seed: int,
) -> None:
    y = states(seed)
    state = np.array(scales[:2])
    units = Units(state, scales[2], cost, cost * constant, state * zero, constraint=scales[0])
    u, value, success = units.solve(kind, solver, y)
    expected, expected_value, expected_success = Units().solve(kind, solver, y)
    np.testing.assert_array_equal(success, expected_success)
    # States and values are known to rounding of the numbers that they are written in: 1e6 spreads from zero.
    np.testing.assert_allclose(value[success], expected_value[success], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(u[success], expected[success], atol=2e-4)


@pytest.mark.parametrize("solver", ["lqr", "ddp", "ipopt"])
@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1.0, 1e6])
def test_an_integrator_in_any_unit(solver: str, unit: float) -> None:
    """By hand: 1.91 for x_0 = 1 and |u| <= 0.3."""
    mpc = MPC(
        Model(lambda x, u, p: x + u, 1, 1, 1.0, discrete=True),
        QuadraticCost([[1.0]], [[1.0]]),
        QuadraticCost([[1.0]]),
        3,
        1.0,
        [-0.3 * unit],
        [0.3 * unit],
    )
    solution = make_solver(mpc, solver).solve([unit])
    assert solution.success
    assert solution.value == pytest.approx(1.91 * unit**2, rel=1e-6)
    np.testing.assert_allclose(solution.u[:, 0] / unit, [-0.3, -0.3, -0.2], atol=1e-6)


@pytest.mark.parametrize("solver", ["lqr", "ddp", "ipopt"])
@pytest.mark.parametrize("wide", [1e3, 1e6])
def test_bounds_that_are_far_away_say_nothing(solver: str, wide: float) -> None:
    A, B, W, R = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.01], [0.1]]), np.diag([1.0, 0.1]), np.array([[0.05]])
    best = optimum(A, B, W, R, DISCOUNT)
    mpc = (
        Units()
        .problem("linear")
        .replace(action_low=[-wide], action_high=[wide], terminal_cost=QuadraticCost((best.P + best.P.T) / 2.0))
    )
    x = np.array([1.0, -0.3])
    solution = make_solver(mpc, solver).solve(x)
    assert solution.success
    np.testing.assert_allclose(solution.u0, best.K @ x, rtol=1e-5)


@pytest.mark.parametrize(("kind", "solver"), [("linear", "lqr"), *KINDS[1:], ("linear", "ipopt")])
@pytest.mark.parametrize("zero", [(0.0, 0.0), (np.pi, -20.0), (1e5, 3e-4)])
def test_at_rest(kind: str, solver: str, zero: tuple[float, float]) -> None:
    """At the reference nothing is to be done, and no size of anything is known."""
    found = make_solver(Units(zero=zero).problem(kind), solver).solve(np.array(zero))
    assert found.success
    np.testing.assert_allclose(found.u, 0.0, atol=1e-6)
    assert abs(found.value) < 1e-9


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1.0, 1e6])
def test_an_infeasible_plan_is_never_a_success(unit: float) -> None:
    """From 0.9 the speed cannot be below 0.3 a step later."""
    mpc = Units((unit, unit), unit).problem("linear")
    bounds = StateBounds([-np.inf, -0.3 * unit], [np.inf, 0.3 * unit])
    solver = make_solver(mpc.replace(constraints=[bounds]))
    solution = solver.solve(np.array([1.0, 0.9]) * unit)
    assert not solution.success
    assert solver.violation(np.array([[1.0, 0.9]]) * unit, solution.u[None]) > 0.0
    assert solver.solve(np.array([1.0, 0.2]) * unit).success


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_small_constraints_are_constraints(scale: float) -> None:
    """h -> c h: the same bound on the input's size, whatever h is measured in."""
    limit = Constraint(lambda x, u, p: scale * (u[0] ** 2 - 0.25), "limit")
    mpc = Units().problem("linear").replace(constraints=[limit])
    solution = make_solver(mpc).solve([1.0, 0.0])
    assert solution.success
    np.testing.assert_allclose(np.abs(solution.u).max(), 0.5, rtol=1e-6)


def test_unbounded_inputs_of_a_state_with_past_inputs_have_a_size() -> None:
    """By the stage cost at the reference; Riccati knows the plan."""
    model = Model(
        lambda x, u, _: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * u[0] - 0.2 * u[1]), 2, 2, 0.1, discrete=True, delay=2
    )
    reference, free = [1.0, 0.0], [np.inf, np.inf]
    cost, end = (QuadraticCost(np.eye(2), R, x_ref=reference) for R in (0.1 * np.eye(2), None))
    mpc = MPC(model, cost, end, HORIZON, DISCOUNT, [-np.inf, -np.inf], free)
    z = mpc.state([0.3, -0.2])
    np.testing.assert_allclose(make_solver(mpc, "ddp").solve(z).u, make_solver(mpc, "lqr").solve(z).u, atol=1e-6)
