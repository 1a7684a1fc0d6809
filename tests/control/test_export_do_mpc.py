"""The exported controller of do-mpc decides what ours decides; run where do-mpc is installed: scripts/test_interop."""

from __future__ import annotations

import sys
from importlib import import_module, invalidate_caches
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from exported_problems import N_OBSERVATIONS, of_case
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline import MPCPolicy
from mpcoffline.control.export_do_mpc import export_do_mpc
from mpcoffline.solvers import DDPSolver


@pytest.mark.interop
@pytest.mark.parametrize("case", [LINEAR, PENDULUM, CARTPOLE, "late, with a signal", "late, with rates", "limits"])
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
    solved = DDPSolver(mpc, tolerance=1e-16).solve(states)  # at 1e-12 inputs are up to 1.4e-6 from where both end
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
    assert len(off) >= 0.99 * N_OBSERVATIONS
    assert max(off) < 1e-6


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
