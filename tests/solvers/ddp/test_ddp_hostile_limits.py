"""Limits that contradict each other, states far out: ddp ends, claims nothing that is not so, and misuses no memory."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from compiling import LIGHT_FLAGS, QUICK_FLAGS, compiled_with
from hostile_limits import (
    Claims,
    Exported,
    hostile_problem,
    hostile_states,
    hostile_thetas,
    sanitized,
    spoiled,
    wrong_claims,
)

from mpcoffline.solvers import DDPSolver


@pytest.mark.parametrize(("seed", "tellable"), [(11, True), (6, False), (8, False)])
def test_hostile_problems(seed: int, tellable: bool) -> None:
    """Contradicting limits are told; units of 1e-200 and prices of 1e250 give no NaN for a solution."""
    _, mpc = hostile_problem(seed)
    mpc = mpc.replace(horizon=8)
    x = hostile_states(mpc.nx, 32, np.random.default_rng(seed))
    with compiled_with(QUICK_FLAGS):
        solver = DDPSolver(mpc)
    cold = solver.solve(x)
    for solution in (cold, solver.solve(x, warm_start=cold.plan.shifted())):
        good = solution.success
        for array in (solution.value, solution.u, solution.x):
            assert np.isfinite(array[good]).all()
        assert (solver.violation(x[good], solution.u[good]) == 0.0).all()
        assert np.isfinite(solution.multipliers[good]).all()
        if tellable:
            assert not good.any()
            assert solution.status.count("infeasible") >= 24  # the others lead out of what numbers can hold


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
@pytest.mark.parametrize("seed", [0, 8])
def test_hostile_parameters_and_the_exported_c(seed: int, tmp_path: Path) -> None:
    """Claims are true by CasADi's functions; the C agrees, keeps its budget, and gives inputs in bounds for NaN."""
    _, mpc = hostile_problem(seed)
    mpc, rng = mpc.replace(horizon=8), np.random.default_rng(seed)
    with compiled_with(LIGHT_FLAGS):
        solver = DDPSolver(mpc)
    x, theta = hostile_states(mpc.nx, 60, rng), hostile_thetas(mpc, 60, rng)
    theta[1::2] = mpc.theta
    cold = solver.solve(x, theta)
    budget = 4 * solver.n_starts + solver.max_iterations * -(-solver.n_starts // 4)
    assert wrong_claims(solver, x, theta, cold, budget) == Claims(0, 0, 0, 0)
    warm = solver.solve(x, theta, warm_start=cold.plan.shifted())
    assert wrong_claims(solver, x, theta, warm, budget + solver.max_iterations) == Claims(0, 0, 0, 0)
    controller = Exported(mpc, tmp_path, "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    answers, counts, u = controller(np.ones(60), theta, x, 300.0)
    both = cold.success & (answers == 0)
    assert (counts <= budget + 4 * -(-solver.n_starts // 4)).all()
    moved = solver.solve(x * (1.0 + 1e-13), theta)  # where that finds another minimum, the C may, too
    near = 1e-6 * (1.0 + np.abs(cold.u0))
    steady = both & moved.success & (np.abs(moved.u0 - cold.u0) <= near).all(axis=1)
    assert (np.abs(u - cold.u0) <= near)[steady].all()
    _, _, inputs = controller(np.arange(60) % 10 == 0, spoiled(theta, rng), spoiled(x, rng), 300.0)
    assert ((inputs >= np.asarray(mpc.action_low)) & (inputs <= np.asarray(mpc.action_high))).all()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("clang") is None, reason="no clang")
def test_under_sanitizers(tmp_path: Path) -> None:
    """Memory, shifts, conversions, overflows: a program of the generated C ends in order, with the same costs."""
    _, mpc = hostile_problem(1)
    mpc = mpc.replace(horizon=6)
    x = hostile_states(mpc.nx, 12, np.random.default_rng(0))
    status, cost = sanitized(mpc, x, tmp_path)
    assert (status[0] != 0).all()  # they contradict each other
    with compiled_with(QUICK_FLAGS):
        solution = DDPSolver(mpc, n_starts=8, max_iterations=60).solve(x)
    again = status[0] == 4
    assert again.sum() >= 6
    np.testing.assert_allclose(solution.value[again], cost[0][again], rtol=1e-3)
