"""Powers in C against those of CasADi."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.solvers import make_solver
from mpcoffline.solvers.ddp.emission import emit

POWERS = (0.25, 0.5, 0.75, 1.25, 1.5, 2.75, 3.0, 5.0, 6.0, -0.25, -0.5, -0.75, -1.0, -1.75, -3.0, 0.8, 7.0, 1.0 / 3.0)


@pytest.mark.parametrize("power", POWERS)
def test_a_plan_follows_a_model_with_powers(power: float) -> None:
    """The states of a plan are those that CasADi's function reaches, to rounding."""

    def step(x: Any, u: Any, p: Any) -> Any:
        return ca.vertcat(0.9 * x[0] + 0.05 * (1.0 + x[1] ** 2) ** power + 0.1 * u[0], 0.8 * x[1] + 0.1 * u[0])

    mpc = MPC(
        Model(step, 2, 1, 0.1, discrete=True),
        QuadraticCost(np.eye(2), np.eye(1)),
        QuadraticCost(np.eye(2)),
        horizon=10,
        discount=1.0,
        action_low=[-1.0],
        action_high=[1.0],
    )
    plan = make_solver(mpc, "ddp").solve(np.array([[0.5, 0.3], [-0.2, 0.9]])).plan
    for x, u in zip(plan.x, plan.u, strict=True):
        reached = mpc.dynamics_function(x[:-1].T, u.T, mpc.theta).full().T
        np.testing.assert_allclose(x[1:], reached, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("power", "called"), [(0.75, False), (-2.5, False), (3.0, False), (0.8, True), (7.25, True)])
def test_quarters_take_no_call_a_lane(power: float, called: bool) -> None:
    x = ca.SX.sym("x")
    assert ("vd_pow(" in emit("f", [x], x**power)) is called


def test_roots_are_taken_once() -> None:
    x = ca.SX.sym("x")
    assert emit("f", [x], ca.vertcat(x**0.25, x**-0.75, x**-1.75)).count("vd_sqrt(") == 2
