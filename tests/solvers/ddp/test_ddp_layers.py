"""Models with layers in C: values and Jacobians against CasADi's, plans against ipopt's."""

from __future__ import annotations

import ctypes
import itertools
import re
from typing import Any

import casadi as ca
import numpy as np
import pytest
from compiling import LIGHT_FLAGS, compiled_with

from mpcoffline.mpc import MPC, Model, Parameter, QuadraticCost
from mpcoffline.solvers import DDPSolver, IpoptSolver
from mpcoffline.solvers.ddp.build import compiled
from mpcoffline.solvers.ddp.codegen import source

PROBE = """
void probe(const double *x, const double *u, const double *theta, double *out) {
    vd X[NX], U[NU], p[NP + NQ + 1], values[NX], slopes[NX * (1 + NZ)];
    for (int i = 0; i < NX; ++i) X[i] = V(x[i]);
    for (int i = 0; i < NU; ++i) U[i] = V(u[i]);
    for (int i = 0; i < NP; ++i) p[i] = V(theta[i]);
    gen_prepare(p, p + NP);
    model_values(X, U, p, values);
    model_slopes(X, U, p, slopes);
    for (int i = 0; i < NX; ++i) out[i] = values[i][0];
    for (int i = 0; i < NX * (1 + NZ); ++i) out[NX + i] = slopes[i][0];
}
"""


def silu(x: Any) -> Any:
    return x / (1 + ca.exp(-x))


def weights(sizes: tuple[int, ...], seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(seed)
    return [(rng.normal(size=(b, a)) / np.sqrt(a), 0.1 * rng.normal(size=b)) for a, b in itertools.pairwise(sizes)]


def problem(model: Model) -> MPC:
    cost = QuadraticCost(np.eye(model.nx), 0.1 * np.eye(model.nu))
    return MPC(model, cost, QuadraticCost(np.eye(model.nx)), 12, 0.95, [-1.0] * model.nu, [1.0] * model.nu)


def pure(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    h = ca.vertcat(x, u)
    layers = weights((5, 40, 32, 4))
    for k, (W, b) in enumerate(layers):
        h = W @ h + b
        h = h if k == 2 else ca.tanh(h) if k else ca.fmax(h, 0.1 * h)
    return h


def hybrid(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
    """Physics with parameters, a normalised network with a layer norm for what it lacks."""
    h = (ca.vertcat(x, u, p["load"]) - 0.1) / 1.7
    (W0, b0), (W1, b1), (W2, b2) = weights((6, 32, 32, 2), seed=1)
    h = silu(W0 @ h + b0)
    h = h + ca.if_else(W1 @ h > 0, W1 @ h, ca.expm1(W1 @ h)) + b1
    mean = ca.sum1(h) / 32
    h = (h - mean) / ca.sqrt(ca.sumsqr(h - mean) / 32 + 1e-5)
    push = W2 @ h + b2
    return ca.vertcat(x[2], x[3], (u[0] - p["c"] * x[2] - ca.sin(x[0]) + push[0]) / p["m"], push[1] - x[1] * x[3])


CASES = {
    "discrete": Model(lambda x, u, p: 0.8 * x + 0.1 * pure(x, u, p), 4, 1, 0.1, discrete=True),
    "Runge-Kutta": Model(pure, 4, 1, 0.1),
    "hybrid": Model(hybrid, 4, 1, 0.05, {"m": Parameter(1.3, low=0.1), "c": 0.2, "load": 0.4}),
}


@pytest.mark.parametrize("name", CASES)
def test_values_and_jacobians_are_casadis(name: str) -> None:
    mpc = problem(CASES[name])
    code = source(mpc)
    assert "layer_slopes(" in code
    assert "layer_constants(table" in code  # of the first layer
    with compiled_with(LIGHT_FLAGS):  # sooner; whole solvers with layers are compiled as shipped below
        library = compiled(code + PROBE)
    x, u, theta = ca.SX.sym("x", 4), ca.SX.sym("u", 1), ca.SX.sym("theta", mpc.space.size)
    reached = mpc.dynamics_function(x, u, theta)
    exact = ca.Function("J", [x, u, theta], [reached, ca.densify(ca.jacobian(reached, ca.vertcat(x, u)))])
    rng = np.random.default_rng(0)
    for _ in range(10):
        point, given = [*(rng.normal(size=n) for n in (4, 1)), mpc.theta], np.empty(4 * 7)
        library.probe(*(array.ctypes.data_as(ctypes.c_void_p) for array in (*point, given)))
        value, jacobian = (part.full() for part in exact(*point))
        for found, expected in ((given[:4], value[:, 0]), (given[4:8], value[:, 0]), (given[8:], jacobian.ravel())):
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)


@pytest.mark.slow
def test_plans_are_ipopts() -> None:
    mpc = problem(CASES["hybrid"])
    states = np.random.default_rng(5).normal(size=(1, 4))
    ours, theirs = DDPSolver(mpc).solve(states), IpoptSolver(mpc).solve(states)
    assert ours.success.all()
    assert (ours.value < theirs.value + 1e-6 * (1 + np.abs(theirs.value))).all()


@pytest.mark.parametrize("magnitude", [1e-9, 1e-3, 1.0, 19.0, 300.0])
def test_the_layers_own_exponentials_are_the_c_librarys(magnitude: float) -> None:
    code = (
        source(problem(CASES["discrete"]))
        + """
void elementary(const double *a, double *out) {
    for (int i = 0; i < 64; ++i) {
        out[i] = layer_exp(V(a[i]))[0], out[64 + i] = layer_expm1(V(a[i]))[0], out[128 + i] = layer_tanh(V(a[i]))[0];
    }
}
"""
    )
    a, given = magnitude * np.linspace(-1, 1, 64), np.empty(192)
    compiled(code).elementary(*(array.ctypes.data_as(ctypes.c_void_p) for array in (a, given)))
    for found, expected in zip(given.reshape(3, 64), (np.exp(a), np.expm1(a), np.tanh(a)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-15 * 4, atol=0)


def test_the_layers_exponentials_of_what_is_no_number_or_too_large() -> None:
    code = (
        source(problem(CASES["discrete"]))
        + """
void extremes(const double *a, double *out) {
    for (int i = 0; i < 5; ++i) out[i] = layer_exp(V(a[i]))[0], out[5 + i] = layer_tanh(V(a[i]))[0];
}
"""
    )
    a, given = np.array([np.nan, np.inf, -np.inf, 800.0, -800.0]), np.empty(10)
    compiled(code).extremes(*(array.ctypes.data_as(ctypes.c_void_p) for array in (a, given)))
    np.testing.assert_array_equal(given[:5], [np.nan, np.inf, 0.0, np.inf, 0.0])
    np.testing.assert_array_equal(given[5:], np.tanh(a))


def test_what_is_eliminated_before_a_layer_is_computed_no_more() -> None:
    """Of 16 steps of RK4 in front of a network, states are kept, and none of the hundreds of results between."""
    body = Model(lambda x, u, p: ca.vertcat(x[1], ca.sin(x[0]) - x[1] * x[0] ** 2 + u), 2, 1, 0.1, integrator="rk4:16")
    (W0, b0), (W1, b1), (W2, b2) = weights((3, 24, 24, 2))

    def corrected(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        hidden = ca.tanh(W1 @ ca.tanh(W0 @ ca.vertcat(x, u) + b0) + b1)
        return body.expression(x, u, ca.SX(0, 1)) + 0.1 * (W2 @ hidden + b2)

    kept = [int(n) for n in re.findall(r"vd v\[(\d+)\]", source(problem(Model(corrected, 2, 1, 0.1, discrete=True))))]
    assert kept
    assert max(kept) < 150
