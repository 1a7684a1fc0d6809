"""States with past inputs: how they move, what costs and constraints see of them, and files of them."""

from __future__ import annotations

import json
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.linalg import solve_discrete_are

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC, Constraint, ExpressionCost, Model, Parameter, QuadraticCost, StateBounds
from mpcoffline.mpc.component import Component
from mpcoffline.mpc.layout import Layout
from mpcoffline.mpc.parameters import ParameterSpace
from mpcoffline.solvers import make_solver

A, B = np.array([[1.0, 0.1], [-0.3, 0.8]]), np.array([[0.02, 0.1], [0.2, -0.1]])


def plant(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    return ca.SX(A) @ x + p["gain"] * (ca.SX(B) @ u)


def make_model(delay: Any = None) -> Model:
    return Model(plant, 2, 2, 0.1, {"gain": Parameter(1.0, low=0.1)}, discrete=True, delay=delay)


def make_mpc(delay: Any = None, D: Any = None, **changes: Any) -> MPC:
    cost = QuadraticCost(np.diag([2.0, 0.5]), 0.1 * np.eye(2), x_ref=[0.3, -0.1], D=D)
    arguments = {"horizon": 25, "discount": 0.97, "action_low": [-9.0, -9.0], "action_high": [9.0, 9.0]} | changes
    return MPC(make_model(delay), cost, QuadraticCost(np.eye(2), x_ref=[0.3, -0.1]), **arguments)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 4), min_size=2, max_size=2), st.booleans(), st.integers(0, 1_000))
def test_a_delayed_model_is_the_plant_with_the_inputs_of_before(delay: list[int], previous: bool, seed: int) -> None:
    """Twelve steps of z+ = f(z, u) against the plain map, given by hand the inputs of ``delay`` steps before."""
    rng = np.random.default_rng(seed)
    model, plain = make_model(delay), make_model()
    if previous:
        model = model.with_previous()
    inputs, past = rng.normal(size=(12, 2)), rng.normal(size=2)
    applied = np.vstack([np.tile(past, (5, 1)), inputs])
    x = rng.normal(size=2)
    z = np.concatenate([x, model.layout.filled(past)])
    for k, u in enumerate(inputs):
        z = model(z, u)
        x = plain(x, [applied[5 + k - d, i] for i, d in enumerate(delay)])
        np.testing.assert_allclose(z[:2], x, rtol=1e-12, atol=1e-12)
    i, ages = model.layout.ages
    np.testing.assert_array_equal(z[2:], inputs[12 - ages, i])


def test_only_what_is_needed_is_carried() -> None:
    assert make_model([3, 0]).layout.names == ("u0[k-1]", "u0[k-2]", "u0[k-3]")
    assert make_model([3, 0]).with_previous().layout.names == ("u0[k-1]", "u0[k-2]", "u0[k-3]", "u1[k-1]")
    assert make_model(0).layout.is_plain
    assert (make_model(0).delay, make_model().delay, make_model(2).delay) == ((0, 0), None, (2, 2))
    assert make_model(2).with_delay(None).nx == 2


def test_batches_move_as_the_function_does() -> None:
    layout, rng = make_model([2, 1]).layout, np.random.default_rng(0)
    z, u = rng.normal(size=(4, 3, layout.nx)), rng.normal(size=(4, 3, 2))
    x, acting = layout.split(z, u)
    reached = layout.joined(x @ A.T + acting @ B.T, z, u)
    np.testing.assert_allclose(reached, make_model([2, 1])(z, u), rtol=1e-13)
    np.testing.assert_array_equal(reached[..., 2:], layout.remembered(z[..., 2:], u))


def test_costs_and_constraints_are_functions_of_the_observation() -> None:
    limits = [StateBounds([-5.0, -np.inf], [5.0, 4.0]), Constraint(lambda x, u, p: x[0] * x[1] - 3.0, name="product")]
    mpc, plain = make_mpc([2, 1], constraints=limits), make_mpc(constraints=limits)
    z, u = np.arange(5.0), [0.5, -1.0]
    np.testing.assert_allclose(
        mpc.stage_function(z, u, mpc.theta).full(), plain.stage_function(z[:2], u, plain.theta).full()
    )
    np.testing.assert_allclose(mpc.terminal_function(z, mpc.theta).full(), plain.terminal_function(z[:2], plain.theta))
    assert mpc.constraint_function is not None
    assert float(mpc.constraint_function(z, u, mpc.theta)) == pytest.approx(-3.0)
    np.testing.assert_array_equal(mpc.state_bounds[0].low, [-5.0, *[-np.inf] * 4])
    np.testing.assert_array_equal(mpc.reference, [0.3, -0.1])


def test_a_cost_of_the_whole_state_gets_it() -> None:
    W = np.diag([1.0, 2.0, 3.0, 4.0])
    mpc = make_mpc([1, 1]).replace(terminal_cost=QuadraticCost(W))
    assert float(mpc.terminal_function([1.0, 1.0, 1.0, 1.0], mpc.theta)) == pytest.approx(10.0)
    with pytest.raises(InvalidArgumentError, match="terminal_cost: expected a cost for nx = 2"):
        make_mpc([1, 2]).replace(terminal_cost=QuadraticCost(W))


def test_prices_on_changes_against_a_riccati_solution_of_the_augmented_plant() -> None:
    """Written out by hand in (x, u_before), the discounted problem with D has a Riccati solution."""
    gamma, W, R, D = 0.97, np.diag([2.0, 0.5]), 0.1 * np.eye(2), np.array([[0.7, 0.1], [0.1, 0.3]])
    F = np.block([[A, np.zeros((2, 2))], [np.zeros((2, 4))]])
    G = np.vstack([B, np.eye(2)])
    Q, S = np.block([[W, np.zeros((2, 2))], [np.zeros((2, 2)), D]]), np.vstack([np.zeros((2, 2)), -D])
    root = np.sqrt(gamma)
    P = solve_discrete_are(root * F, root * G, Q, R + D, s=S)
    gain = np.linalg.solve(R + D + gamma * G.T @ P @ G, S.T + gamma * G.T @ P @ F)
    free = [np.inf, np.inf]
    model = make_model().with_previous()
    mpc = MPC(model, QuadraticCost(W, R, D=D), QuadraticCost(P), 20, gamma, np.negative(free), free)
    z = np.random.default_rng(0).normal(size=(5, 4))
    solution = make_solver(mpc).solve(z)
    np.testing.assert_allclose(solution.u0, -z @ gain.T, atol=1e-8)
    np.testing.assert_allclose(solution.value, np.einsum("bi,ij,bj->b", z, P, z), rtol=1e-8)


@pytest.mark.parametrize("name", ["lqr", "ddp", "ipopt"])
def test_solvers_agree_on_a_delayed_problem_with_the_plain_one_later(name: str) -> None:
    """With a delay of 3, inputs of now do nothing for 3 steps: the plan is the plain MPC's from where it is then."""
    cost, end = QuadraticCost(np.diag([2.0, 0.5])), QuadraticCost(np.eye(2))
    free = {"discount": 0.97, "action_low": [-0.5, -0.5], "action_high": [0.5, 0.5]}
    delayed = MPC(make_model(3), cost, end, 23, **free)
    plain = MPC(make_model(), cost, end, 20, **free)
    rng = np.random.default_rng(1)
    x, past = rng.normal(size=2), rng.uniform(-0.5, 0.5, (3, 2))  # oldest first
    z = np.concatenate([x, past[::-1, 0], past[::-1, 1]])
    for u in past:
        x = make_model()(x, u)
    found, expected = make_solver(delayed, name).solve(z), make_solver(plain, "lqr").solve(x)
    assert found.success
    np.testing.assert_allclose(found.u[:3], expected.u[:3], atol=2e-4)


@pytest.mark.parametrize("delay", [None, 0, [2, 1]])
@pytest.mark.parametrize("D", [None, np.eye(2)])
def test_files_hold_delays(delay: Any, D: Any) -> None:
    mpc = make_mpc(delay, D)
    read = MPC.from_json(json.loads(json.dumps(mpc.to_json())))
    assert (read.layout, read.model.delay) == (mpc.layout, mpc.model.delay)
    z, u = np.random.default_rng(0).normal(size=mpc.nx), [0.3, -0.2]
    np.testing.assert_allclose(read.model(z, u), mpc.model(z, u), rtol=1e-14)
    assert float(read.stage_function(z, u, read.theta)) == float(mpc.stage_function(z, u, mpc.theta))


class Jumpy(Component):
    """|x|^2, and a price on changes of the second input; of a class that no file can name."""

    uses_previous = True

    def __init__(self) -> None:
        self.space = ParameterSpace([])

    def expression(self, x: ca.SX, u: ca.SX, p: dict[str, ca.SX], previous: ca.SX) -> ca.SX:
        return ca.sumsqr(x) + 3.0 * (u[1] - previous[1]) ** 2


def test_an_own_cost_of_changes() -> None:
    mpc = make_mpc([1, 0]).replace(stage_cost=Jumpy())
    assert mpc.layout.names == ("u0[k-1]", "u1[k-1]")
    z, u = [1.0, 2.0, 7.0, 0.5], [9.0, 1.5]
    assert float(mpc.stage_function(z, u, mpc.theta)) == pytest.approx(5.0 + 3.0)
    read = MPC.from_json(json.loads(json.dumps(mpc.to_json())))
    assert isinstance(read.stage_cost, ExpressionCost)
    assert float(read.stage_function(z, u, read.theta)) == pytest.approx(8.0)


@pytest.mark.parametrize(
    ("delay", "message"),
    [
        (-1, "delay"),
        (1.5, "delay"),
        ([1, 2, 3], "delay: expected one number, or 2, one an input"),
        ([1, -2], "delay"),
        (10_000, "nx"),
    ],
)
def test_delays_that_are_refused(delay: Any, message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        make_model(delay)


def test_states_of_other_sizes_are_refused() -> None:
    mpc = make_mpc([2, 0])
    np.testing.assert_array_equal(mpc.state([1.0, 2.0]), [1.0, 2.0, 0.0, 0.0])
    np.testing.assert_array_equal(mpc.state([[1.0, 2.0]], [3.0, 4.0]), [[1.0, 2.0, 3.0, 4.0]])
    with pytest.raises(InvalidArgumentError, match="past: expected shape"):
        mpc.state([1.0, 2.0], [3.0])
    with pytest.raises(InvalidArgumentError, match="y: expected shape"):
        mpc.state([1.0])


def test_what_counts_as_applied_before_is_the_reference_input_within_bounds() -> None:
    cost = QuadraticCost(np.eye(2), np.eye(2), u_ref=[0.5, 30.0])
    mpc = make_mpc([1, 1]).replace(stage_cost=cost)
    np.testing.assert_array_equal(mpc.usual_input, [0.5, 9.0])
    np.testing.assert_array_equal(Layout.of(2, 2, [2, 1]).filled(mpc.usual_input), [0.5, 0.5, 9.0])
