"""Powers, roots and reciprocals in C against those of CasADi."""

from __future__ import annotations

import ctypes
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.solvers import make_solver
from mpcoffline.solvers.ddp.build import compiled
from mpcoffline.solvers.ddp.codegen import text
from mpcoffline.solvers.ddp.emission import emit

POWERS = (0.25, 0.5, 0.75, 1.25, 1.5, 2.75, 3.0, 5.0, 6.0, -0.25, -0.5, -0.75, -1.0, -1.75, -3.0, 0.8, 7.0, 1.0 / 3.0)


def assert_plans_follow(step: Any, horizon: int) -> None:
    """The states of plans are those that CasADi's function reaches, to rounding."""
    mpc = MPC(
        Model(step, 2, 1, 0.1, discrete=True),
        QuadraticCost(np.eye(2), np.eye(1)),
        QuadraticCost(np.eye(2)),
        horizon=horizon,
        discount=1.0,
        action_low=[-1.0],
        action_high=[1.0],
    )
    plan = make_solver(mpc, "ddp").solve(np.array([[0.5, 0.3], [-0.2, 0.9]])).plan
    for x, u in zip(plan.x, plan.u, strict=True):
        reached = mpc.dynamics_function(x[:-1].T, u.T, mpc.theta).full().T
        np.testing.assert_allclose(x[1:], reached, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("power", POWERS)
def test_a_plan_follows_a_model_with_powers(power: float) -> None:
    def step(x: Any, u: Any, p: Any) -> Any:
        return ca.vertcat(0.9 * x[0] + 0.05 * (1.0 + x[1] ** 2) ** power + 0.1 * u[0], 0.8 * x[1] + 0.1 * u[0])

    assert_plans_follow(step, horizon=10)


@pytest.mark.parametrize(("power", "called"), [(0.75, False), (-2.5, False), (3.0, False), (0.8, True), (7.25, True)])
def test_quarters_take_no_call_a_lane(power: float, called: bool) -> None:
    x = ca.SX.sym("x")
    assert ("vd_pow(" in emit("f", [x], x**power)) is called


def test_roots_are_taken_once() -> None:
    x = ca.SX.sym("x")
    assert emit("f", [x], ca.vertcat(x**0.25, x**-0.75, x**-1.75)).count("vd_sqrt(") == 2


def net(x: ca.SX) -> ca.SX:
    """A neuron, whose root is of what is positive for sure."""
    return x / ca.sqrt(1.0 + x**2)


def test_one_over_a_root_takes_neither_root_nor_division() -> None:
    x = ca.SX.sym("x")
    code = emit("f", [x], ca.vertcat(net(x), ca.gradient(net(x), x)))
    assert code.count("vd_rsqrt(") == 1
    assert "vd_sqrt(" not in code
    assert "1.0 /" not in code


@pytest.mark.parametrize("of", [lambda x: x, lambda x: x**2, lambda x: x**2 - 1.0, lambda x: 1e-300 + x**2])
def test_roots_of_what_may_not_be_positive_are_divided_by(of: Any) -> None:
    """Zero, negative and denormal numbers have to give inf and NaN, as everywhere."""
    x = ca.SX.sym("x")
    code = emit("f", [x], 3.0 / ca.sqrt(of(x)))
    assert "vd_rsqrt(" not in code
    assert "1.0 /" in code


def test_reciprocals_cross_the_pieces_of_a_long_function() -> None:
    """Of 400 neurons and 200 roots, divided by early and late."""

    def step(x: Any, u: Any, p: Any) -> Any:
        signals = [net(0.01 * k + (1.0 + 0.001 * k) * x[0]) for k in range(400)]
        roots = [ca.sqrt(2.0 + (x[1] + 0.01 * k) ** 2) for k in range(200)]
        late = sum(signals[::-1]) + sum(1.0 / root for root in roots) + 1e-3 * sum(roots)
        return ca.vertcat(0.9 * x[0] + 1e-3 * late / (3.0 + x[1] ** 2), 0.8 * x[1] + 0.1 * u[0] / (3.0 + x[1] ** 2))

    assert_plans_follow(step, horizon=3)


def test_reciprocal_roots_are_exact_to_rounding() -> None:
    """``vd_rsqrt`` itself against numpy over all magnitudes that it is for."""
    loop = "for (long i = 0; i < n; i += LANES) { vd v; for (int l = 0; l < LANES; ++l) v[l] = a[i + l];"
    store = "v = vd_rsqrt(v); for (int l = 0; l < LANES; ++l) r[i + l] = v[l]; }"
    library = compiled(f"{text('vector.h')}\nvoid rsqrt(const double *a, double *r, long n) {{ {loop} {store} }}\n")
    a = np.exp(np.random.default_rng(0).uniform(np.log(1e-290), np.log(1e290), 80_000))
    found = np.empty_like(a)
    library.rsqrt(ctypes.c_void_p(a.ctypes.data), ctypes.c_void_p(found.ctypes.data), ctypes.c_long(len(a)))
    assert np.abs(found * np.sqrt(a) - 1.0).max() < 6e-16
