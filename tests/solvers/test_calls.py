"""Models and costs that call functions: integrators and root finders are ipopt's by "auto", tables are arithmetic."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.solvers import make_solver
from mpcoffline.solvers.ddp import elimination
from mpcoffline.solvers.ddp.elimination import value_and_jacobian

X, U, P = ca.MX.sym("x", 2), ca.MX.sym("u", 1), ca.MX.sym("p", 1)
ODE = ca.vertcat(X[1], P * U - ca.sin(X[0]))
GRID = [np.linspace(-2.0, 2.0, 5)] * 3
VALUES = np.random.default_rng(0).normal(size=125)

Dynamics = Callable[[Any, Any, Any], Any]


def table(n: int, kind: str = "linear") -> Dynamics:
    """The pendulum with a table of its first n signals in it."""
    lookup = ca.interpolant(f"table{n}", kind, GRID[:n], VALUES[: 5**n])
    return lambda x, u, p: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * u - 0.01 * lookup(ca.vertcat(x, u)[:n]))


def integrator(plugin: str, options: dict[str, Any]) -> Dynamics:
    step = ca.integrator("step", plugin, {"x": X, "p": ca.vertcat(U, P), "ode": ODE}, 0.0, 0.1, options)
    return lambda x, u, p: step(x0=x, p=ca.vertcat(u, 1.0))["xf"]


def root_finder() -> Dynamics:
    z = ca.MX.sym("z")
    find = ca.rootfinder("find", "newton", ca.Function("g", [z, U, P], [z - U - 0.1 * ca.sin(z) * P]))
    return lambda x, u, p: ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * find(0.0, u, 1.0))


def arithmetic() -> Dynamics:
    """A function of three inputs that is arithmetic: expanded where it is called."""
    step = ca.Function("step", [X, U, P], [X + 0.1 * ODE])
    return lambda x, u, p: step(x, u, 1.0)


def mpc_of(dynamics: Dynamics, **changes: Any) -> MPC:
    mpc = MPC(
        Model(dynamics, 2, 1, 0.1, discrete=True),
        QuadraticCost(np.eye(2), [[0.1]]),
        QuadraticCost(np.eye(2)),
        6,
        0.95,
        [-1.0],
        [1.0],
    )
    return mpc.replace(**changes) if changes else mpc


CALLING: dict[str, Callable[[], Dynamics]] = {
    "cvodes": lambda: integrator("cvodes", {}),
    "rk": lambda: integrator("rk", {}),
    "root finder": root_finder,
}
ARITHMETIC: dict[str, Callable[[], Dynamics]] = {
    "function": arithmetic,
    "expanded rk": lambda: integrator("rk", {"simplify": True}),
    "1-D table": lambda: table(1),
    "2-D table": lambda: table(2),
    "3-D table": lambda: table(3),
    "spline": lambda: table(3, "bspline"),
}


@pytest.mark.parametrize("name", CALLING)
def test_models_that_call_functions_are_ipopts(name: str) -> None:
    mpc = mpc_of(CALLING[name]())
    with pytest.raises(InvalidArgumentError, match=r"ddp solver, got a call of another function.*Use ipopt"):
        make_solver(mpc, "ddp")
    solver = make_solver(mpc)
    assert solver.name == "ipopt"
    assert "ddp does not support a call of another function" in solver.reason
    found, expected = solver.solve([0.5, 0.0]), make_solver(mpc, "ipopt").solve([0.5, 0.0])
    assert found.success
    np.testing.assert_array_equal(found.u, expected.u)


@pytest.mark.parametrize("name", ARITHMETIC)
def test_functions_of_arithmetic_are_ddps(name: str) -> None:
    mpc = mpc_of(ARITHMETIC[name]())
    solver = make_solver(mpc)
    assert solver.name == "ddp"
    np.testing.assert_allclose(solver.value([0.5, 0.0]), make_solver(mpc, "ipopt").value([0.5, 0.0]), rtol=1e-7)


class TableCost(QuadraticCost):
    """A quadratic cost and the price of a table."""

    convex = False

    def expression(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        price = ca.interpolant("price", "bspline", [np.linspace(-9, 9, 7)], np.linspace(-1, 1, 7) ** 2)
        return super().expression(x, u, p) + price(x[0])


def test_costs_with_tables_are_ddps() -> None:
    mpc = mpc_of(arithmetic(), stage_cost=TableCost(np.eye(2), [[0.1]]))
    solver = make_solver(mpc)
    assert solver.name == "ddp"
    np.testing.assert_allclose(solver.value([0.5, 0.0]), make_solver(mpc, "ipopt").value([0.5, 0.0]), rtol=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_the_order_of_elimination_is_markowitzs(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """At each turn the one with the fewest paths through it, the first of equals, of all that are left."""
    rng = np.random.default_rng(seed)
    z = ca.SX.sym("z", 5)
    h = z
    for size in (9, 7, 4):
        h = ca.tanh(rng.normal(size=(size, h.numel())) @ h) + ca.sumsqr(h)
    eliminate = elimination.Graph.eliminate
    turns: list[int] = []

    def watched(graph: Any, k: int) -> None:
        left = [n for n in range(len(graph.values)) if n not in turns and graph.into[n] and graph.out_of[n]]
        assert k == min(left, key=lambda n: (graph.paths_through(n), n))
        turns.append(k)
        eliminate(graph, k)

    monkeypatch.setattr(elimination.Graph, "eliminate", watched)
    _, jacobian = value_and_jacobian(h, z, ca.SX.sym("theta", 0))
    assert len(turns) > 50
    ours, theirs = (ca.Function("J", [z], [ca.densify(part)]) for part in (jacobian, ca.jacobian(h, z)))
    point = rng.normal(size=5)
    np.testing.assert_allclose(ours(point).full(), theirs(point).full(), rtol=1e-10, atol=1e-12)
