"""MPCs as they act in simulations: nearly as on the plant, in a fraction of the iterations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mpcoffline import MPC
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.plants import nominal_mpc
from mpcoffline.simulation import quick
from mpcoffline.simulation.quick import quick_policy
from mpcoffline.solvers import Solution

Array = NDArray[np.float64]
STEPS = 40


@pytest.fixture(scope="module")
def pendulum() -> MPC:
    return nominal_mpc("mpcoffline/PendulumSwingUp-v0", alpha=1.0, seed=0)


def hanging(n: int) -> Array:
    """States from which swinging up takes many iterations."""
    phi = np.random.default_rng(0).uniform(0.6, 1.0, n) * np.pi
    return np.column_stack([np.cos(phi), np.sin(phi), np.zeros(n)])


def closed_loop(policy: MPCPolicy, x: Array) -> tuple[Array, list[int]]:
    """Costs of closed loops with the MPC's own model ``(n,)``, and what its solver took, step by step."""
    mpc, cost, state, taken = policy.mpc, np.zeros(len(x)), None, [policy.solver_stats.iterations]
    for _ in range(STEPS):
        u, state = policy.predict(x, state)
        cost += mpc.stage_function(x.T, u.T.astype(np.float64), mpc.theta).full().ravel()
        x = mpc.model(x, u.astype(np.float64))
        taken.append(policy.solver_stats.iterations)
    return cost, np.diff(taken).tolist()


def test_loops_of_unfinished_plans_cost_what_those_of_finished_ones_do(
    pendulum: MPC, monkeypatch: pytest.MonkeyPatch
) -> None:
    x = hanging(24)
    exact, needed = closed_loop(MPCPolicy(pendulum, "ddp"), x)
    monkeypatch.setattr(quick, "_FEW", 2)
    policy = quick_policy(pendulum)
    cost, taken = closed_loop(policy, x)
    np.testing.assert_allclose(cost, exact, rtol=1e-3)
    hurried = np.arange(STEPS) % quick._CARRIED > 0
    assert max(np.array(taken)[hurried]) <= 2 * len(x)
    assert max(np.array(needed)[hurried]) > 2 * len(x)
    assert policy.solver_stats.n_failures == 0  # an unfinished plan is none


def test_each_loop_begins_to_count_anew(pendulum: MPC) -> None:
    """So that it does not matter which loops a solver has been through before."""
    policy, x = quick_policy(pendulum), hanging(8)
    first = closed_loop(policy, x)
    policy.predict(x, policy.predict(x)[1])
    again = closed_loop(policy, x)
    np.testing.assert_array_equal(first[0], again[0])
    assert first[1] == again[1]


def test_what_fails_when_it_is_carried_through_is_counted(pendulum: MPC, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quick, "_ITERATIONS", 1)
    policy, x = quick_policy(pendulum), hanging(8)
    closed_loop(policy, x)
    assert policy.solver_stats.n_solves == len(x) * -(-STEPS // quick._CARRIED)  # and the others are no solves
    assert 0.0 < policy.solver_stats.failed_share <= 1.0


def test_simulated_solves_end_near_the_minimum(pendulum: MPC) -> None:
    """Values within 1e-6 and first inputs within 1e-3 of their range of those of the exact solver, on the pendulum."""
    mpc, rng = pendulum, np.random.default_rng(0)
    phi = rng.uniform(-0.6, 0.6, 40)
    x = np.column_stack([np.cos(phi), np.sin(phi), rng.uniform(-1.0, 1.0, 40)])
    near, exact = (policy.solver.solve(x) for policy in (quick_policy(mpc), MPCPolicy(mpc, "ddp")))
    assert near.success.all()
    np.testing.assert_allclose(near.value, exact.value, rtol=1e-6)
    span = float(mpc.action_high[0] - mpc.action_low[0])
    np.testing.assert_allclose(near.u0, exact.u0, atol=1e-3 * span)
    assert near.stats["iterations"].sum() <= exact.stats["iterations"].sum()


def test_what_stalls_on_the_way_is_no_failure_either(pendulum: MPC, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else more problems would have failed than were solved."""
    policy, x = quick_policy(pendulum), hanging(8)
    solve = policy.solver.solve

    def stalling(*args: Any, **kwargs: Any) -> Solution:
        found = solve(*args, **kwargs)
        return replace(found, success=np.zeros(len(x), dtype=bool)) if len(found.success) == len(x) else found

    monkeypatch.setattr(policy.solver, "solve", stalling)
    closed_loop(policy, x)
    stats = policy.solver_stats
    assert stats.n_failures == stats.n_solves == sum(stats.answers.values())
