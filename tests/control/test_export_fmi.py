"""The exported FMU is the learned model, read by CasADi here, and by fmpy where that is: scripts/test_interop."""

from __future__ import annotations

import shutil
import sys
import zipfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from exported_problems import N_OBSERVATIONS, of_case
from task_ids import CARTPOLE, LINEAR, PENDULUM
from typer.testing import CliRunner

from mpcoffline import MPC, InvalidArgumentError, Model, MPCPolicy, Parameter, QuadraticCost
from mpcoffline.cli import app
from mpcoffline.control.export_fmi import export_fmi
from mpcoffline.mpc import Signal
from mpcoffline.mpc.integrators import Scheme
from mpcoffline.mpc.labels import Label, Labels

compiles = pytest.mark.skipif(
    not sys.platform.startswith("linux") or not any(map(shutil.which, ("cc", "gcc", "clang"))),
    reason="needs a C compiler",
)
CASES = [PENDULUM, CARTPOLE, "odd names"]


def problem(case: str) -> MPC:
    """That of a task; or names that are no identifiers, alike, or words of C or FMI, dead time and a signal."""
    if case != "odd names":
        return of_case(case)[0]
    model = Model(
        lambda x, u, p, d: ca.vertcat(x[1], (u[0] - p["time"] * x[1]) / p["m²"] + d.load + p["k"][1]),
        2,
        1,
        0.1,
        {"time": Parameter(0.3, unit="N s/m"), "m²": Parameter(2.0, 0.1, unit="kg·m²"), "k": [1.0, 0.7]},
        delay=2,
        signals=[Signal("load", "N", preview=3, usual=0.4)],
        labels=Labels((Label("φ (1)", "°"), Label("int", "m/s")), (Label("m²", "%"),)),
    )
    stage = QuadraticCost(np.eye(2), [[0.1]], x_ref=[0.5, 0.0])
    return MPC(model, stage, QuadraticCost(np.eye(2)), 10, 0.95, [-1.0], [2.0])


def unpacked(mpc: MPC, folder: Path) -> Path:
    (path,) = export_fmi(MPCPolicy(mpc), folder)
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder / "fmu")
    return folder / "fmu"


def points(mpc: MPC) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, inputs with signals, and parameters unlike those that were learned."""
    rng, layout = np.random.default_rng(0), mpc.layout
    x = rng.normal(size=(N_OBSERVATIONS, layout.n_states))
    acting = rng.uniform(-1.0, 1.0, (N_OBSERVATIONS, len(layout.acting)))
    return x, acting, mpc.model.space.theta * rng.uniform(1.0, 1.5, (N_OBSERVATIONS, mpc.model.space.size))


@compiles
@pytest.mark.parametrize("case", CASES)
def test_its_derivatives_are_those_of_the_model(case: str, tmp_path: Path) -> None:
    mpc = problem(case)
    here = Path.cwd()
    read = ca.DaeBuilder("read", str(unpacked(mpc, tmp_path)))
    assert Path.cwd() == here
    assert (read.nx(), read.nu(), read.np()) == (mpc.layout.n_states, len(mpc.layout.acting), mpc.model.space.size)
    rates, ode = read.create("rates", ["x", "u", "p"], ["ode"]), mpc.model.ode
    assert ode is not None
    for x, u, p in zip(*points(mpc), strict=True):
        np.testing.assert_allclose(rates(x, u, p).full(), ode(x, u, p).full(), rtol=1e-12, atol=1e-12)


@pytest.mark.interop
@compiles
@pytest.mark.parametrize("case", CASES)
def test_fmpy_finds_it_valid_and_simulates_it(case: str, tmp_path: Path) -> None:
    """A step with the input held, from any point, by name, is the model's, which is integrated finely here."""
    fmpy = pytest.importorskip("fmpy")
    from fmpy.validation import validate_fmu

    mpc = problem(case)
    (path,) = export_fmi(MPCPolicy(mpc), tmp_path)
    assert validate_fmu(str(path)) == []
    described = fmpy.read_model_description(str(path))
    names = [v.name for v in described.modelVariables if v.causality in ("output", "input")]
    start = [float(v.start) for v in described.modelVariables if v.causality == "parameter"]
    np.testing.assert_allclose(start, mpc.model.space.theta, rtol=1e-15)
    dt, n, fine = mpc.model.dt, mpc.layout.n_states, mpc.model.with_scheme(Scheme("rk4", 50)).plant
    assert float(described.defaultExperiment.stepSize) == dt
    for x, u, _ in list(zip(*points(mpc), strict=True))[:20]:
        values = dict(zip(names, np.concatenate([x, u]).tolist(), strict=True))
        run = fmpy.simulate_fmu(
            str(path), stop_time=dt, output_interval=dt, relative_tolerance=1e-10, start_values=values
        )
        assert run["time"][-1] == pytest.approx(dt)
        expected = fine(x, u, mpc.model.space.theta).full()[:, 0]
        np.testing.assert_allclose([run[name][-1] for name in names[:n]], expected, rtol=1e-6, atol=1e-7)


@pytest.mark.interop
@compiles
def test_its_sources_compile_elsewhere(tmp_path: Path) -> None:
    """By fmpy and its headers, the standard's own, as in a tool for another system."""
    pytest.importorskip("fmpy")
    from fmpy.build import build_platform_binary

    folder = unpacked(problem("odd names"), tmp_path)
    shutil.rmtree(folder / "binaries")
    (folder / "sources" / "fmi3Functions.h").unlink()
    build_platform_binary(str(folder))
    assert list((folder / "binaries").rglob("learned_model.so"))


def test_without_a_compiler_it_has_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    warned: list[str] = []
    monkeypatch.setattr("mpcoffline.control.export_fmi.warn_once", warned.append)
    folder = unpacked(problem(PENDULUM), tmp_path)
    assert not (folder / "binaries").exists()
    assert sorted(path.name for path in (folder / "sources").iterdir()) == [
        "buildDescription.xml",
        "fmi3Functions.h",
        "learned_model.c",
        "learned_model.h",
        "learned_model_wrap.c",
    ]
    assert "no C compiler" in warned[0]


def test_a_compiler_that_never_ends_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = tmp_path / "cc"
    compiler.write_text("#!/bin/sh\nexec sleep 600\n")
    compiler.chmod(0o755)
    monkeypatch.setattr("mpcoffline.control.export_fmi.compilers", lambda: [str(compiler)])
    monkeypatch.setattr("mpcoffline.control.export_fmi._SECONDS", 0.6)
    warned: list[str] = []
    monkeypatch.setattr("mpcoffline.control.export_fmi.warn_once", warned.append)
    assert not (unpacked(problem(PENDULUM), tmp_path / "out") / "binaries").exists()
    assert "no result within" in warned[0]


def test_a_map_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgumentError, match=r"model: expected an ordinary differential.*discrete map of 0.1 s"):
        export_fmi(MPCPolicy(problem(LINEAR)), tmp_path)
    assert not list(tmp_path.iterdir())


@compiles
def test_the_command_writes_one(tmp_path: Path) -> None:
    MPCPolicy(problem(PENDULUM)).save(tmp_path / "policy.zip")
    done = CliRunner().invoke(app, ["export", str(tmp_path / "policy.zip"), "--to", "fmi", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "model.fmu" in done.output.replace("\n", "")
    with zipfile.ZipFile(tmp_path / "model.fmu") as archive:
        assert "modelDescription.xml" in archive.namelist()
