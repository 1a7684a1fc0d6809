"""The exported problem of acados is ours; acados decides what ours decides, where its library was built.

It is not on PyPI, so that ``scripts/test_interop`` does not bring it: with ``ACADOS_SOURCE_DIR`` set and
acados_template on the path, ``pytest -m interop`` runs the last test.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from exported_problems import N_OBSERVATIONS, of_case, script_in
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline import MPCPolicy
from mpcoffline.control.export_acados import export_acados
from mpcoffline.core.errors import StorageError
from mpcoffline.solvers import DDPSolver

CASES = [LINEAR, PENDULUM, CARTPOLE, "late, with a signal", "late, with rates", "limits"]


@pytest.fixture
def described(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in of ``acados_template``: objects that keep what they are told."""

    class AcadosOcp:
        def __init__(self) -> None:
            self.model, self.cost, self.constraints = SimpleNamespace(), SimpleNamespace(), SimpleNamespace()
            self.solver_options, self.code_gen_options = SimpleNamespace(), SimpleNamespace()

    stand_in = ModuleType("acados_template")
    vars(stand_in).update(AcadosOcp=AcadosOcp, AcadosOcpSolver=object, ACADOS_INFTY=1e10)
    monkeypatch.setitem(sys.modules, "acados_template", stand_in)


def stage_of(problem: Any, at: str, x: np.ndarray, u: np.ndarray) -> tuple[float, float]:
    """Cost of a stage, as acados reckons it with the slacks that are needed, and the largest hard h."""
    model, cost, bounds = problem.model, problem.cost, problem.constraints
    expressions = [getattr(model, f"cost_expr_ext_cost{at}"), getattr(model, f"con_h_expr{at}", ca.SX(0, 1))]
    value, h = (each.full().ravel() for each in ca.Function("stage", [model.x, model.u], expressions)(x, u))
    if not h.size:
        return value.item(), -np.inf
    assert (getattr(bounds, f"lh{at}") <= -1e10).all()
    above = h - getattr(bounds, f"uh{at}")
    soft = getattr(bounds, f"idxsh{at}")
    slacks = np.maximum(above[soft], 0.0)
    price = getattr(cost, f"zu{at}") @ slacks + 0.5 * getattr(cost, f"Zu{at}") @ slacks**2
    return value.item() + price, np.max(np.delete(above, soft), initial=-np.inf)


@pytest.mark.usefixtures("described")
@pytest.mark.parametrize("case", CASES)
def test_the_described_problem_is_ours(case: str, tmp_path: Path) -> None:
    """Plans of ours keep its limits and cost what our solver says: discount, prices of violated limits and all."""
    mpc, observations = of_case(case)
    export_acados(MPCPolicy(mpc), tmp_path)
    problem = script_in(tmp_path, "acados_controller").ocp()
    model, options, bounds = problem.model, problem.solver_options, problem.constraints
    assert (options.N_horizon, options.tf) == (mpc.horizon, pytest.approx(mpc.horizon * mpc.model.dt))
    assert options.integrator_type == "DISCRETE"
    np.testing.assert_array_equal(bounds.lbu, mpc.action_low)
    np.testing.assert_array_equal(bounds.ubu, mpc.action_high)
    np.testing.assert_array_equal(bounds.idxbu, np.arange(mpc.nu))
    assert bounds.x0.shape == (mpc.nx,)
    np.testing.assert_allclose(options.cost_scaling, mpc.discount ** np.arange(mpc.horizon + 1.0))
    ahead = ca.Function("ahead", [model.x, model.u], [model.disc_dyn_expr])
    solved = DDPSolver(mpc).solve(mpc.state(observations[:10]))
    assert solved.success.all()
    violated = False
    for x, u, value in zip(solved.x, solved.u, solved.value, strict=True):
        cost = 0.0
        for k, weight in enumerate(options.cost_scaling):
            at = "_0" if k == 0 else "_e" if k == mpc.horizon else ""
            stage, hard = stage_of(problem, at, x[k], u[min(k, mpc.horizon - 1)])
            cost += weight * stage
            assert hard < 1e-6
            if k < mpc.horizon:
                np.testing.assert_allclose(ahead(x[k], u[k]).full().ravel(), x[k + 1], atol=1e-8)
        assert cost == pytest.approx(value, rel=1e-6)
        plain = sum(float(mpc.discount**k * mpc.stage_function(x[k], u[k], mpc.theta)) for k in range(mpc.horizon))
        plain += float(mpc.discount**mpc.horizon * mpc.terminal_function(x[-1], mpc.theta))
        violated |= value > plain + 1e-3
    assert violated == (case in ("limits", "late, with rates")), "prices of violated limits were not put to the test"


@pytest.mark.usefixtures("described")
def test_limits_are_imposed_where_something_can_be_done_about_them(tmp_path: Path) -> None:
    """Not on the state that is given: power, of the input, is the first stage's only limit."""
    mpc, _ = of_case("limits")
    export_acados(MPCPolicy(mpc), tmp_path)
    problem = script_in(tmp_path, "acados_controller").ocp()
    assert [len(getattr(problem.constraints, f"uh{at}")) for at in ("_0", "", "_e")] == [2, 4, 4]
    assert [list(getattr(problem.constraints, f"idxsh{at}")) for at in ("_0", "", "_e")] == [[], [2, 3], [0, 1, 2, 3]]
    np.testing.assert_allclose(problem.cost.zu, [3.0, 3.0])
    np.testing.assert_allclose(problem.cost.zu_e, [3.0, 3.0, 1.0, 1.0])
    np.testing.assert_allclose(problem.cost.Zu_e, [0.0, 0.0, 10.0, 10.0])


@pytest.mark.usefixtures("described")
def test_options_are_acados_own(tmp_path: Path) -> None:
    export_acados(MPCPolicy(of_case(LINEAR)[0]), tmp_path)
    problem = script_in(tmp_path, "acados_controller").ocp(nlp_solver_max_iter=7, nlp_solver_type="SQP_RTI")
    assert (problem.solver_options.nlp_solver_max_iter, problem.solver_options.nlp_solver_type) == (7, "SQP_RTI")


def test_its_files(tmp_path: Path) -> None:
    """Without acados: the files, loaded by CasADi alone, and a script that Python takes."""
    mpc, observations = of_case("limits")
    paths = export_acados(MPCPolicy(mpc), tmp_path)
    assert paths[0].name == "acados_controller.py"
    compile(paths[0].read_text(), str(paths[0]), "exec")
    assert "x[0]  observation 0" in paths[0].read_text()
    assert "NX, NU = 2, 1" in paths[0].read_text()
    loaded = {path.stem: ca.Function.load(str(path)) for path in paths[1:]}
    x, u = observations[0], np.array([0.3])
    np.testing.assert_allclose(loaded["dynamics"](x, u).full()[:, 0], mpc.model(x, u), rtol=1e-12)
    power = x[1] * u[0]
    expected = [power - 0.2, -power - 0.2, x[1] - 0.4, -x[1] - 0.4]
    np.testing.assert_allclose(loaded["limits"](x, u).full().ravel(), expected, rtol=1e-12)
    expected = [*expected[2:], x[0] - 0.1, -x[0] - 0.1]
    np.testing.assert_allclose(loaded["end_limits"](x).full().ravel(), expected, rtol=1e-12)


def test_what_cannot_be_written_is_refused_before_anything_is(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(StorageError):
        export_acados(MPCPolicy(of_case(LINEAR)[0]), tmp_path / "taken")


@pytest.mark.interop
@pytest.mark.parametrize("case", CASES)
def test_acados_decides_what_ours_decides(case: str, tmp_path: Path) -> None:
    pytest.importorskip("acados_template")
    mpc, observations = of_case(case)
    export_acados(MPCPolicy(mpc), tmp_path)
    controller = script_in(tmp_path, "acados_controller").Controller()
    width = np.asarray(mpc.action_high) - np.asarray(mpc.action_low)
    states = mpc.state(observations)
    solved = DDPSolver(mpc, tolerance=1e-16).solve(states)
    off = []
    for z, u, good in zip(states, solved.u, solved.success, strict=True):
        if not good:
            continue
        found = controller.solve(z, u)
        assert controller.status == 0
        off.append(np.max(np.abs(found - u[0]) / width))
    assert len(off) >= 0.99 * N_OBSERVATIONS
    assert max(off) < 1e-6
