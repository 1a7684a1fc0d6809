"""The exported controller of do-mpc decides what ours decides; run where do-mpc is installed: scripts/test_interop."""

from __future__ import annotations

import sys
from importlib import import_module, invalidate_caches
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from mpc_problems import random_states
from numpy.typing import NDArray
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline import MPCPolicy
from mpcoffline.control.export_do_mpc import export_do_mpc
from mpcoffline.mpc import MPC, Constraint, Model, Penalty, QuadraticCost, Signal, StateBounds
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import DDPSolver

N_OBSERVATIONS = 100


def of_case(case: str) -> tuple[MPC, NDArray[np.float64]]:
    """A problem of 20 steps, and observations."""
    rng = np.random.default_rng(0)
    if case in (LINEAR, PENDULUM, CARTPOLE):
        return nominal_mpc(case).replace(horizon=20), random_states(case, N_OBSERVATIONS)
    stage, goal = QuadraticCost(np.diag([1.0, 0.1]), [[0.1]]), QuadraticCost(np.eye(2))
    if case == "late, with a signal":
        model = Model(
            lambda x, u, p, d: ca.vertcat(x[0] + 0.2 * x[1] + 0.1 * d.load, 0.9 * x[1] + 0.2 * ca.sin(u[0])),
            2,
            1,
            0.2,
            discrete=True,
            delay=2,
            signals=[Signal("load", usual=0.3)],
        )
        observations = rng.uniform(-1.0, 1.0, (N_OBSERVATIONS, 3))
        priced = QuadraticCost(np.diag([1.0, 0.1]), [[0.1]], D=[[0.2]])
        return MPC(model, priced, goal, 20, 0.95, [-1.0], [1.0]), observations
    limits = [
        StateBounds([-np.inf, -0.4], [np.inf, 0.4], "speed", Penalty(3.0)),
        Constraint(lambda x, u, p: ca.vertcat(x[1] * u[0] - 0.2, -x[1] * u[0] - 0.2), "power"),
        Constraint(lambda x, p: ca.vertcat(x[0] - 0.1, -x[0] - 0.1), "end", Penalty(1.0, 5.0), terminal=True),
    ]
    model = Model(lambda x, u, p: ca.vertcat(x[0] + 0.2 * x[1], x[1] + 0.2 * ca.sin(u[0])), 2, 1, 0.2, discrete=True)
    observations = rng.uniform([-1.0, -0.5], [1.0, 0.5], (N_OBSERVATIONS, 2))
    return MPC(model, stage, goal, 20, 0.97, [-1.0], [1.0], constraints=limits), observations


@pytest.mark.interop
@pytest.mark.parametrize("case", [LINEAR, PENDULUM, CARTPOLE, "late, with a signal", "limits"])
def test_do_mpc_decides_what_ours_decides(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("do_mpc")
    mpc, observations = of_case(case)
    export_do_mpc(MPCPolicy(mpc), tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("do_mpc_controller", None)
    invalidate_caches()
    script = import_module("do_mpc_controller")
    controller: Any = script.controller()
    width = np.asarray(mpc.action_high) - np.asarray(mpc.action_low)
    states = mpc.state(observations)
    solved = DDPSolver(mpc, tolerance=1e-12).solve(states)
    off = []
    for z, x, u, good in zip(states, solved.x, solved.u, solved.success, strict=True):
        if not good:
            continue
        for k in range(mpc.horizon + 1):
            controller.opt_x_num["_x", k, 0, -1] = x[k]
            if k < mpc.horizon:
                controller.opt_x_num["_u", k, 0] = np.append(u[k], np.zeros(script.N_SLACKS))
        found = controller.make_step(z.reshape(-1, 1))[: mpc.nu].ravel()
        off.append(np.max(np.abs(found - u[0]) / width))
    assert len(off) >= 0.8 * N_OBSERVATIONS
    assert np.quantile(off, 0.95) < 1e-6
    assert max(off) < 1e-4


def test_its_functions_are_those_of_the_problem(tmp_path: Path) -> None:
    """Without do-mpc: the files, loaded by CasADi alone, and a script that Python takes."""
    mpc, observations = of_case("limits")
    paths = export_do_mpc(MPCPolicy(mpc), tmp_path)
    assert paths[0].name == "do_mpc_controller.py"
    compile(paths[0].read_text(), str(paths[0]), "exec")
    loaded = {path.stem: ca.Function.load(str(path)) for path in paths[1:]}
    x, u = observations[0], np.array([0.3])
    np.testing.assert_allclose(loaded["ahead"](x, u).full()[:, 0], mpc.model(x, u), rtol=1e-12)
    slacks = loaded["stage_cost"].numel_in(1) - 1
    cost = float(loaded["stage_cost"](x, np.append(u, np.zeros(slacks)), 1.0, 0.0))
    assert cost == pytest.approx(float(mpc.stage_function(x, u, mpc.theta)), rel=1e-12)
    assert float(loaded["terminal_cost"](x)) == pytest.approx(float(mpc.terminal_function(x, mpc.theta)), rel=1e-12)
    assert "x[0]  observation 0" in paths[0].read_text()
