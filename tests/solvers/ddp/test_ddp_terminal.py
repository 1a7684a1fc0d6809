"""A terminal cost that is a network, as loops in C, against CasADi's expression of it and against ipopt."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.mpc.networks import NetworkCost
from mpcoffline.solvers import make_solver
from mpcoffline.solvers.ddp import codegen, terminal
from mpcoffline.solvers.ddp.codegen import generated
from mpcoffline.solvers.ddp.terminal import TerminalNetwork
from mpcoffline.solvers.scaling import costs_of

SHAPES = [(3, (24, 24)), (10, (12, 9)), (2, (5,)), (9, (7, 6, 5)), (1, (4, 4))]


def network(nx: int, hidden: tuple[int, ...], seed: int = 0, delay: int = 0) -> MPC:
    """A stable plant whose terminal cost is a random network, with all that one has."""
    rng = np.random.default_rng(seed)
    A = ca.DM(0.9 * np.eye(nx) + 0.02 * rng.normal(size=(nx, nx)))
    cost = NetworkCost.random(
        nx,
        hidden,
        seed=seed,
        mean=0.1 * rng.normal(size=nx),
        std=1.0 + 0.1 * rng.random(nx),
        offset=3.0,
        scale=2.0,
        W=0.1 * np.eye(nx),
        x_ref=0.2 * rng.normal(size=nx),
    )
    return MPC(
        Model(lambda x, u, p: A @ x + 0.1 * ca.sin(u[0]), nx, 1, 0.1, discrete=True, delay=delay),
        QuadraticCost(np.eye(nx), np.eye(1)),
        cost,
        horizon=5,
        discount=0.9,
        action_low=[-1.0],
        action_high=[1.0],
    )


@pytest.mark.parametrize(("nx", "hidden"), SHAPES)
def test_solutions_are_those_of_ipopt(nx: int, hidden: tuple[int, ...]) -> None:
    mpc, x = network(nx, hidden), np.random.default_rng(1).normal(size=(4, nx))
    ours, reference = (make_solver(mpc, name).solve(x) for name in ("ddp", "ipopt"))
    assert ours.success.all()
    np.testing.assert_allclose(ours.value, reference.value, rtol=1e-9)
    np.testing.assert_allclose(ours.u0, reference.u0, atol=1e-5)


@given(st.sampled_from(SHAPES), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_derivatives_are_put_together_as_casadi_has_them(shape: tuple[int, tuple[int, ...]], seed: int) -> None:
    """With y, its gradient and its Hessian by CasADi in place of C."""
    mpc = network(*shape, seed)
    x, theta = ca.SX.sym("x", mpc.nx), ca.SX.sym("theta", mpc.space.size)
    parts = TerminalNetwork.of(mpc, x, theta)
    assert parts is not None
    whole = costs_of(mpc, x, ca.SX.sym("u"), theta).terminal
    # y as the expression that the cost is of, without its bias
    of_mpc = mpc.terminal_cost
    own = of_mpc.space.symbols(theta[mpc.space.slices["terminal_cost.weights_0"].start :])
    n = of_mpc.n_layers
    blind = {f"biases_{n - 1}": ca.SX(0), "offset": ca.SX(0), "scale": ca.SX(1), "W": ca.SX(mpc.nx, mpc.nx)}
    y = of_mpc.terminal_expression(x, {**own, **blind})
    z = ca.SX.sym("z", mpc.nx)
    of_z = ca.substitute(y, x, own["mean"] + own["std"] * z)
    hessian, gradient = ca.hessian(of_z, z)
    at_x = ca.substitute(ca.vertcat(of_z, gradient, upper(hessian)), z, parts.z)
    found = parts.expansion(at_x)
    true = ca.hessian(whole, x)
    compare = ca.Function(
        "compare",
        [x, theta],
        [ca.substitute(parts.cost, parts.y, y) - whole, found[0] - true[1], found[1] - true[0], true[0]],
    )
    values, gradients, hessians, size = compare(np.random.default_rng(seed).normal(size=mpc.nx), mpc.theta)
    assert float(ca.norm_inf(values)) < 1e-12
    assert float(ca.norm_inf(gradients)) < 1e-11
    assert float(ca.mmax(ca.fabs(hessians))) < 1e-11 * max(1.0, float(ca.mmax(ca.fabs(size))))


def upper(matrix: ca.SX) -> ca.SX:
    """The upper triangle, column by column."""
    return ca.vertcat(*(matrix[a, b] for b in range(matrix.shape[1]) for a in range(b + 1)))


def test_past_inputs_in_the_state_are_no_business_of_the_network() -> None:
    mpc = network(3, (6, 6), delay=2)
    x = np.random.default_rng(1).normal(size=(3, mpc.nx)) * 0.5
    ours, reference = (make_solver(mpc, name).solve(x) for name in ("ddp", "ipopt"))
    np.testing.assert_allclose(ours.value, reference.value, rtol=1e-9)


def test_weights_are_parameters_and_take_no_statements() -> None:
    """Other weights are the same code, and a wider network is hardly longer."""
    small, large = (generated(network(4, hidden)) for hidden in ((8, 8), (64, 64)))
    assert len(large) < len(small) + 500
    mpc = network(4, (8, 8))
    assert (
        generated(mpc.replace(terminal_cost=mpc.terminal_cost.with_theta(mpc.terminal_cost.space.theta * 1.1))) == small
    )


def test_other_terminal_costs_are_written_out() -> None:
    class Own(NetworkCost):
        """May have another expression."""

    mpc = network(2, (4, 4))
    own = Own.__new__(Own)
    own.__dict__.update(mpc.terminal_cost.__dict__)
    for cost in (QuadraticCost(np.eye(2)), own):
        other = replace(mpc, terminal_cost=cost)
        x, theta = ca.SX.sym("x", other.nx), ca.SX.sym("theta", other.space.size)
        assert TerminalNetwork.of(other, x, theta) is None


def test_what_does_not_fit_on_a_stack_is_written_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """16 derivatives of hidden results; the solutions are the same."""
    mpc, x = network(2, (4, 4)), np.random.default_rng(1).normal(size=(4, 2))
    loops = make_solver(mpc, "ddp").solve(x)
    assert "network_expand" in generated(mpc)
    monkeypatch.setattr(terminal, "_MOST", 15)
    codegen._KNOWN.clear()
    assert "network_expand" not in generated(mpc)
    written_out = make_solver(mpc, "ddp").solve(x)
    codegen._KNOWN.clear()
    np.testing.assert_allclose(loops.u, written_out.u, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(loops.value, written_out.value, rtol=1e-14)
