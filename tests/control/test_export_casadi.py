"""The exported functions are the problem's, and ipopt on the exported program decides what ours decides."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from exported_problems import of_case, script_in
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline import MPCPolicy
from mpcoffline.control.export_casadi import export_casadi
from mpcoffline.core.errors import StorageError
from mpcoffline.solvers import DDPSolver


@pytest.mark.parametrize(
    ("case", "count"), [(PENDULUM, 100), ("late, with a signal", 20), ("late, with rates", 5), ("limits", 5)]
)
def test_ipopt_on_the_exported_program_decides_what_ours_decides(case: str, count: int, tmp_path: Path) -> None:
    mpc, observations = of_case(case)
    export_casadi(MPCPolicy(mpc), tmp_path)
    decide = script_in(tmp_path, "casadi_controller").controller()
    width = np.asarray(mpc.action_high) - np.asarray(mpc.action_low)
    states = mpc.state(observations[:count])
    solved = DDPSolver(mpc, tolerance=1e-12).solve(states)
    off = [
        np.max(np.abs(decide(z, u.T)[0] - u[0]) / width)
        for z, u, good in zip(states, solved.u, solved.success, strict=True)
        if good
    ]
    assert len(off) >= 0.8 * count
    assert np.quantile(off, 0.95) < 1e-6
    assert max(off) < 1e-4


def test_its_functions_are_those_of_the_problem(tmp_path: Path) -> None:
    mpc, observations = of_case("limits")
    paths = export_casadi(MPCPolicy(mpc), tmp_path)
    loaded = {path.stem: ca.Function.load(str(path)) for path in paths[1:]}
    x, u = observations[0], np.array([0.3])
    np.testing.assert_allclose(loaded["dynamics"](x, u).full()[:, 0], mpc.model(x, u), rtol=1e-12)
    assert float(loaded["stage_cost"](x, u)) == pytest.approx(float(mpc.stage_function(x, u, mpc.theta)), rel=1e-12)
    assert float(loaded["terminal_cost"](x)) == pytest.approx(float(mpc.terminal_function(x, mpc.theta)), rel=1e-12)
    assert "x[0]  observation 0" in paths[0].read_text()
    compile(paths[0].read_text(), str(paths[0]), "exec")


def test_a_plan_that_is_rolled_out_costs_what_the_solver_says(tmp_path: Path) -> None:
    """The value of ddp's plan, discount and prices of violated limits included, is f at its start."""
    for case in (PENDULUM, "limits", "late, with a signal"):
        mpc, observations = of_case(case)
        paths = export_casadi(MPCPolicy(mpc), tmp_path)
        loaded = {path.stem: ca.Function.load(str(path)) for path in paths[1:]}
        states = mpc.state(observations)
        solved = DDPSolver(mpc).solve(states)
        lbx, ubx, lbg, ubg = (each.full().ravel() for each in loaded["bounds"].call([]))
        for z, plan, x, value in zip(states[:10], solved.u, solved.x, solved.value, strict=False):
            w = loaded["start"](z, plan.T)
            cost, g = loaded["nlp"](w, z)
            assert float(cost) == pytest.approx(value, rel=1e-6)
            np.testing.assert_allclose(loaded["plan"](w, z)[0].full().T, x, atol=1e-8)
            w, g = w.full().ravel(), g.full().ravel()
            assert ((lbx - 1e-6 <= w) & (w <= ubx + 1e-6)).all()
            assert ((lbg - 1e-6 <= g) & (g <= ubg + 1e-6)).all()


def test_files_do_not_grow_with_the_horizon_times_the_model(tmp_path: Path) -> None:
    mpc, _ = of_case(CARTPOLE)
    sizes = []
    for horizon in (10, 40):
        paths = export_casadi(MPCPolicy(mpc.replace(horizon=horizon)), tmp_path / str(horizon))
        sizes.append(sum(path.stat().st_size for path in paths))
    assert sizes[1] < 3 * sizes[0]


def test_what_cannot_be_written_is_refused_before_anything_is(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(StorageError):
        export_casadi(MPCPolicy(of_case(LINEAR)[0]), tmp_path / "taken")
