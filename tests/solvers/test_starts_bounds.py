"""Starts and solves under input bounds of any kind: one-sided, far from zero, without any, of any size."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mpcoffline import MPC, Model, MPCPolicy, QuadraticCost, make_solver
from mpcoffline.solvers.starts import candidate_inputs

SOLVERS = ("lqr", "ddp", "ipopt")
_NUMBERS = st.floats(-1e12, 1e12, allow_nan=False)


def pendulum(low: list[float], high: list[float]) -> MPC:
    model = Model(lambda x, u, p: ca.vertcat(x[1], ca.sum1(u) - ca.sin(x[0])), 2, len(low), 0.1)
    return MPC(model, QuadraticCost(np.eye(2), 0.1 * np.eye(len(low))), QuadraticCost(np.eye(2)), 20, 0.95, low, high)


def integrator(low: float, high: float, unit: float = 1.0, target: float = 0.0) -> MPC:
    """x+ = 0.8 x + u, in any unit of x and u, held at a target."""
    weight, x_ref, u_ref = [[unit**-2]], [target * unit], [0.2 * target * unit]
    model = Model(lambda x, u, p: 0.8 * x + u, 1, 1, 0.1, discrete=True)
    cost = QuadraticCost(weight, [[0.1 * unit**-2]], x_ref=x_ref, u_ref=u_ref)
    return MPC(model, cost, QuadraticCost(weight, x_ref=x_ref), 12, 0.95, [low * unit], [high * unit])


@st.composite
def bounds(draw: st.DrawFn) -> tuple[list[float], list[float]]:
    low, high = [], []
    for _ in range(draw(st.integers(1, 3))):
        ends = sorted([draw(_NUMBERS), draw(_NUMBERS)])
        if ends[0] == ends[1]:
            ends[1] += 1.0
        low.append(ends[0] if draw(st.booleans()) else -np.inf)
        high.append(ends[1] if draw(st.booleans()) else np.inf)
    return low, high


@given(bounds())
@settings(max_examples=60, deadline=None)
def test_starts_are_finite_and_within_any_bounds(ends: tuple[list[float], list[float]]) -> None:
    low, high = ends
    inputs = candidate_inputs(pendulum(low, high))
    assert np.isfinite(inputs).all()
    assert ((inputs >= low) & (inputs <= high)).all()
    np.testing.assert_array_equal(inputs[0], np.broadcast_to(np.clip(0.0, low, high), inputs[0].shape))


@given(st.floats(-1e6, 1e6), st.sampled_from([1e-6, 1.0, 1e9]))
@settings(max_examples=30, deadline=None)
def test_a_lower_bound_alone_is_an_upper_one_mirrored(bound: float, unit: float) -> None:
    above = candidate_inputs(pendulum([bound * unit], [np.inf]))
    below = candidate_inputs(pendulum([-np.inf], [bound * unit]))
    reach, fall = above - bound * unit, bound * unit - below
    slack = 1e-9 * max(abs(bound * unit), 1.0)
    assert reach.min() >= 0.0
    assert fall.min() >= 0.0
    assert abs(reach.max() - fall.max()) <= slack * 1e5
    if bound:  # the sizes are multiples of the bound: no unit matters
        assert reach.max() == pytest.approx(1e4 * abs(bound * unit))


@pytest.mark.parametrize(
    ("low", "high"), [(0, np.inf), (1.01, np.inf), (10, np.inf), (-np.inf, -5), (-np.inf, np.inf), (-1e308, 1e308)]
)
def test_ddp_and_ipopt_agree_under_one_sided_bounds(low: float, high: float) -> None:
    mpc = pendulum([low], [high])
    ddp, oracle = (make_solver(mpc, name).solve([1.0, 0.0]) for name in ("ddp", "ipopt"))
    assert ddp.success
    assert oracle.success
    np.testing.assert_allclose(ddp.value, oracle.value, rtol=1e-6)
    assert low <= ddp.u0[0] <= high
    actions, _ = MPCPolicy(mpc).predict([1.0, 0.0])
    np.testing.assert_allclose(actions, ddp.u0, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("low", "high"), [(0.3, np.inf), (-np.inf, 0.1), (-np.inf, np.inf), (0.15, 0.25)])
def test_a_target_far_from_zero_is_held_whatever_the_bounds(solver: str, low: float, high: float) -> None:
    """At the target, 0.2 target is the input that holds it: the policy's, clipped."""
    target = 1.0
    policy, x, plan = MPCPolicy(integrator(low, high, target=target), solver), np.array([3.0]), None
    for _ in range(80):
        u, plan = policy.predict(x, plan)
        x = 0.8 * x + u
    held = np.clip(0.2 * target, low, high)
    if held == 0.2 * target:
        np.testing.assert_allclose(x, target, atol=1e-3)
    else:
        np.testing.assert_allclose(u, held, atol=1e-6)
    assert policy.solver_stats.n_failures == 0


def test_a_float32_action_at_a_bound_that_is_large_against_its_range_is_taken() -> None:
    low = 1000.1
    solver = make_solver(pendulum([low], [low + 1e-4]))
    action = np.float32(low)  # below the bound by more than a millionth of the range
    assert float(action) != low
    assert np.isfinite(solver.q_value([1.0, 0.0], [action]))
