"""Models with corners in the ddp solver: every problem solved, no plan worse than other methods find."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np
import pytest
from compiling import LIGHT_FLAGS, compiled_with
from scipy.optimize import minimize

from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import DDPSolver


@pytest.fixture(autouse=True, scope="module")
def compiled_lightly() -> Iterator[None]:
    """Here, too: corners are a matter of the models and of the rounded ones, whatever the compiler makes of them."""
    with compiled_with(LIGHT_FLAGS):
        yield


def tank(x: Any, u: Any, p: Any) -> Any:
    """A valve whose flow goes with v**0.8, and an outlet by Torricelli's law."""
    return 0.04 * u[0] ** 0.8 - 0.2 * ca.sqrt(ca.fmax(x[0], 0.0))


def heated(x: Any, u: Any, p: Any) -> Any:
    """A jacket whose valve acts a step late: the input of the step before is a state."""
    flow = 0.0012 * ca.fmax(x[2], 0.0) ** 0.8
    heat = 0.03 * (x[1] - x[0])
    step = ca.vertcat(x[0] + 5 * (heat - 0.002 * (x[0] - 20)), x[1] + 5 * (flow * (80 - x[1]) - 0.5 * heat))
    return ca.vertcat(step, u)


def dead_zone(x: Any, u: Any, p: Any) -> Any:
    return ca.vertcat(x[1], 4 * (u[0] - ca.fmax(ca.fmin(u[0], 0.3), -0.3)) - x[1])


def friction(x: Any, u: Any, p: Any) -> Any:
    return ca.vertcat(x[1], 3 * u[0] - x[1] - 0.8 * x[1] / (ca.fabs(x[1]) + 1e-3))


def saturation(x: Any, u: Any, p: Any) -> Any:
    return ca.vertcat(x[1], ca.fmin(ca.fmax(2 * u[0], -1), 1) - 0.3 * x[0] * ca.fabs(x[1]))


def relu(x: Any, u: Any, p: Any) -> Any:
    rng, h = np.random.default_rng(0), ca.vertcat(x, u)
    for n in (12, 12):
        h = ca.fmax(rng.normal(size=(n, h.numel())) / np.sqrt(h.numel()) @ h + 0.3 * rng.normal(size=n), 0)
    return x + 0.2 * rng.normal(size=(2, 12)) / np.sqrt(12) @ h


def servo(dynamics: Any, *, discrete: bool = False) -> MPC:
    cost, end = QuadraticCost(np.diag([1.0, 0.1]), [[0.05]]), QuadraticCost(np.diag([5.0, 1.0]))
    return MPC(Model(dynamics, 2, 1, 0.1, discrete=discrete), cost, end, 12, 0.98, [-1.0], [1.0])


def level() -> MPC:
    cost = QuadraticCost(np.eye(1), [[1e-6]], x_ref=[1.0], u_ref=[10.0])
    return MPC(Model(tank, 1, 1, 0.5), cost, QuadraticCost(np.eye(1), x_ref=[1.0]), 12, 0.98, [0.0], [100.0])


def temperature() -> MPC:
    weights, goal = np.diag([1.0, 0.0, 0.0]), [45.0, 0.0, 0.0]
    cost, end = QuadraticCost(weights, [[1e-4]], x_ref=goal), QuadraticCost(weights, x_ref=goal)
    return MPC(Model(heated, 3, 1, 5.0, discrete=True), cost, end, 20, 0.99, [0.0], [100.0])


def delayed() -> MPC:
    cost = QuadraticCost(np.eye(1), [[1e-6]], x_ref=[1.0], u_ref=[10.0])
    model = Model(tank, 1, 1, 0.5, delay=2)
    return MPC(model, cost, QuadraticCost(np.eye(1), x_ref=[1.0]), 12, 0.98, [0.0], [100.0])


CASES = {
    "delayed tank": (delayed, [0.0, 0.0, 0.0], [8.0, 100.0, 100.0]),
    "tank": (level, [0.0], [8.0]),
    "heated": (temperature, [20.0, 20.0, 0.0], [70.0, 75.0, 100.0]),
    "dead zone": (lambda: servo(dead_zone), [-2.0, -2.0], [2.0, 2.0]),
    "friction": (lambda: servo(friction), [-1.0, -1.0], [1.0, 1.0]),
    "saturation": (lambda: servo(saturation), [-2.0, -2.0], [2.0, 2.0]),
    "relu": (lambda: servo(relu, discrete=True), [-1.5, -1.5], [1.5, 1.5]),
}


def cost_of(mpc: MPC, x: np.ndarray, u: np.ndarray) -> float:
    J, weight = 0.0, 1.0
    for inputs in u.reshape(mpc.horizon, -1):
        J += weight * float(mpc.stage_function(x, inputs, mpc.theta))
        x, weight = mpc.model(x, inputs), weight * mpc.discount
    return J + weight * float(mpc.terminal_function(x, mpc.theta))


@pytest.mark.parametrize("name", CASES)
def test_closed_loops_over_corners_do_not_fail(name: str) -> None:
    make, low, high = CASES[name]
    mpc = make()
    solver = DDPSolver(mpc)
    x, plan, failed = np.random.default_rng(1).uniform(low, high, (8, mpc.nx)), None, 0
    for _ in range(12):
        plan = solver.solve(x, warm_start=plan)
        failed += np.count_nonzero(~plan.success)
        for state, inputs, value in zip(x[:2], plan.u[:2], plan.value[:2], strict=True):
            assert value == pytest.approx(cost_of(mpc, state, inputs), rel=1e-9)  # the exact model's, as its states
        x = mpc.model(x, plan.u0)
    assert failed <= (5 if name == "relu" else 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tank", "heated", "saturation"])
def test_no_step_within_the_bounds_is_better(name: str) -> None:
    """Scipy, which knows no corners but takes differences on its own, does not improve on the plans."""
    make, low, high = CASES[name]
    mpc = make()
    x = np.random.default_rng(2).uniform(low, high, (2, mpc.nx))
    solution = DDPSolver(mpc).solve(x)
    assert solution.success.all()
    bounds = list(zip(np.tile(mpc.action_low, mpc.horizon), np.tile(mpc.action_high, mpc.horizon), strict=True))
    for state, inputs, value in zip(x, solution.u, solution.value, strict=True):
        for method, limit in (("L-BFGS-B", "maxfun"), ("Powell", "maxfev")):
            found = minimize(
                lambda u, s=state: cost_of(mpc, s, u),
                inputs.ravel(),
                method=method,
                bounds=bounds,
                options={limit: 400},
            )
            assert found.fun > value - 2e-3 * (1 + abs(value))


def test_the_log_says_once_which_corners_there_are(caplog: pytest.LogCaptureFixture) -> None:
    solver = DDPSolver(level())
    with caplog.at_level(logging.INFO, logger="mpcoffline"):
        solver.solve(np.array([[3.0], [0.5]]))
        solver.solve(np.array([[2.0], [0.5]]))
    (message,) = [record.getMessage() for record in caplog.records if "corners" in record.getMessage()]
    assert "pow, half width 1" in message  # 1 % of the valve's 0 to 100
    assert "sqrt" in message


def test_smooth_problems_are_left_alone() -> None:
    solver = DDPSolver(nominal_mpc("mpcoffline/PendulumSwingUp-v0"), max_iterations=1)
    solution = solver.solve(np.array([-1.0, 0.0, 0.3]))
    assert not solution.success
    assert solver._rounding is not None
    assert not solver._rounding.corners
