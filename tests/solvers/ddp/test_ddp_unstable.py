"""The ddp solver on plants that are unstable over the horizon: input sequences alone lead to where all is lost."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from mpc_problems import residual_and_cost
from scipy.linalg import solve_discrete_are

from mpcoffline.mpc import MPC, Constraint, Model, QuadraticCost
from mpcoffline.solvers import DDPSolver, IpoptSolver


def upright(horizon: int, *, limited: bool = False) -> MPC:
    """A pole of 15 cm on a turning arm, 20 ms a step: an angle grows by a factor e in five, 3,000 times in forty."""

    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        s, c, w, v = ca.sin(x[1]), ca.cos(x[1]), x[2], x[3]
        mass, radius, length = 0.12, 0.2, 0.15
        inertia = 4 / 3 * mass * length**2
        a, b = 2.1e-3 + mass * radius**2 + inertia * s * s, -mass * radius * length * c
        arm = 0.35 * u[0] - 6e-3 * w - 2 * inertia * s * c * w * v - mass * radius * length * s * v * v
        pole = inertia * s * c * w * w + mass * 9.81 * length * s - 5e-4 * v
        det = a * inertia - b * b
        return ca.vertcat(w, v, (inertia * arm - b * pole) / det, (a * pole - b * arm) / det)

    limits = [Constraint(lambda x, u, p: x[0] - 2.0, "arm")] if limited else None
    stage, end = QuadraticCost(np.diag([0.1, 1, 0.001, 0.01]), [[0.05]]), QuadraticCost(np.diag([1, 20.0, 0.1, 1]))
    return MPC(Model(ode, 4, 1, 0.02), stage, end, horizon, 0.98, [-1.0], [1.0], constraints=limits)


@pytest.mark.parametrize("limited", [False, True])
def test_a_pole_is_held_upright_from_a_cold_start(limited: bool) -> None:
    """Nowhere dearer than ipopt's multiple shooting; a pole that falls, as ipopt's does once, costs over 100."""
    mpc, rng = upright(40, limited=limited), np.random.default_rng(0)
    x = rng.uniform(-1.0, 1.0, (6, 4)) * [0.5, 0.12, 0.5, 0.5]
    ours, theirs = DDPSolver(mpc).solve(x), IpoptSolver(mpc, n_starts=1).solve(x)
    assert ours.success.all()
    assert theirs.success.all()
    assert (ours.value < np.minimum(10.0, (1.0 + 1e-4) * theirs.value)).all()
    assert np.isclose(ours.value, theirs.value, rtol=1e-4).mean() > 0.5
    error, cost = residual_and_cost(mpc, ours)
    assert (error < 1e-9).all()
    np.testing.assert_allclose(ours.value, cost, rtol=1e-8)


def test_near_the_equilibrium_it_is_riccati() -> None:
    mpc = upright(150)
    x, u, theta = ca.SX.sym("x", 4), ca.SX.sym("u"), ca.SX.sym("theta", mpc.space.size)
    f = mpc.dynamics_function(x, u, theta)
    slopes = ca.Function("slopes", [x, u, theta], [ca.jacobian(f, x), ca.jacobian(f, u)])
    A, B = (part.full() * np.sqrt(mpc.discount) for part in slopes(np.zeros(4), 0.0, mpc.theta))
    P = solve_discrete_are(A, B, mpc.values["stage_cost.W"], mpc.values["stage_cost.R"])
    gain = -np.linalg.solve(mpc.values["stage_cost.R"] + B.T @ P @ B, B.T @ P @ A)
    states = 1e-3 * np.random.default_rng(1).normal(size=(8, 4))
    solution = DDPSolver(mpc).solve(states)
    assert solution.success.all()
    np.testing.assert_allclose(solution.u0, states @ gain.T, rtol=1e-3, atol=1e-5)


def test_alone_and_in_a_batch_it_is_the_same_to_the_bit() -> None:
    mpc = upright(40)
    x = np.random.default_rng(2).uniform(-1.0, 1.0, (11, 4)) * [0.5, 0.12, 0.5, 0.5]
    solver = DDPSolver(mpc)
    together = solver.solve(x)
    for one, u in zip(x, together.u, strict=True):
        np.testing.assert_array_equal(solver.solve(one).u, u)
