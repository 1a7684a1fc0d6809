"""Exported C compiles for every name and unit, as C99 and as C++, and its test tells a controller that does nothing."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from mpcoffline import MPC, Model, MPCPolicy, Parameter, QuadraticCost
from mpcoffline.control.export import export_c
from mpcoffline.mpc import NetworkCost

STRICT = ("-Wall", "-Wextra", "-Werror", "-pedantic", "-O0")
COMPILERS = {
    "C99, gcc": ("gcc", "-std=c99"),
    "C++11, g++": ("g++", "-std=c++11"),
    "C++20, g++": ("g++", "-std=c++20"),
    "C99, clang": ("clang", "-std=c99"),
    "C++, clang": ("clang++", "-std=c++11"),
}
# Names that are no identifiers, are one and the same, are words of C, or would end a comment; units likewise.
PARAMETERS = {
    "k-1": "N*/m",
    "k_1": "*/ int x /*",
    "k 1": "/*",
    "m²": "kg·m²",
    "φ": "°",
    "int": "%",
    "2nd": "**/",
    "model": "/",
    "a.b": "*",
    "a__b": "1/s",
}


def named(parameters: dict[str, str], *, size: float = 1.0, **changes: object) -> MPC:
    """A double integrator whose parameters all add to its force; ``size`` is that of the input."""

    def f(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return ca.vertcat(
            x[1], u[0] / size - ca.sin(x[0]) + sum((0.01 * p[name] for name in parameters), start=ca.SX(0))
        )

    model = Model(f, 2, 1, 0.1, {name: Parameter(1.0, unit=unit) for name, unit in parameters.items()})
    cost = QuadraticCost(np.eye(2), [[0.1 / size**2]])
    mpc = MPC(model, cost, QuadraticCost(np.eye(2)), 5, 0.95, [-size], [size])
    return mpc.replace(**changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A controller of such names, with a network as the default preset gives it one: a function in pieces."""
    path = tmp_path_factory.mktemp("names")
    network = NetworkCost.random(2, seed=0, W=np.eye(2))
    export_c(MPCPolicy(named(PARAMETERS, terminal_cost=network)), path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("language", COMPILERS)
def test_it_compiles_and_runs_as(language: str, folder: Path, tmp_path: Path) -> None:
    compiler, standard = COMPILERS[language]
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler}")
    program = str(tmp_path / "program")
    sources = [str(folder / name) for name in ("mpc_controller.c", "mpc_test.c")]
    language_of = ["-x", "c++"] if "++" in language else []
    command = [compiler, standard, *STRICT, *language_of, *sources, "-o", program, "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:2000]
    tested = subprocess.run([program, folder / "test_vectors.txt"], capture_output=True, text=True, check=False)
    assert tested.returncode == 0, tested.stdout


def test_each_parameter_has_its_own_field(folder: Path) -> None:
    header = (folder / "mpc_controller.h").read_text(encoding="utf-8")
    body = re.search(r"typedef struct \{\n(.*?)\n\} mpc_parameters;", header, flags=re.DOTALL)
    assert body
    pattern = r"^    double (\w+)(?:\[\d+\])?; /\*((?:[^*]|\*(?!/))*)\*/$"
    fields = re.findall(pattern, body[1], flags=re.MULTILINE | re.ASCII)
    assert len(fields) == len(body[1].splitlines()) == len({name for name, _ in fields})
    comments = dict(fields)
    assert comments["model_k_1"] == " model.k_1: number, in * / int x / * "
    assert comments["model_m2"] == " model.m²: number, in kg·m² "
    assert comments["model_int"] == " model.int: number, in % "


@pytest.mark.parametrize("size", [1.0, 1e-9])
def test_the_test_tells_a_controller_that_answers_zero(size: float, tmp_path: Path) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc")
    export_c(MPCPolicy(named({"m": "kg"}, size=size)), tmp_path)
    idle = "int mpc_step(const mpc_parameters *p, mpc_state *s, const double *y, double *u) {\n"
    idle += "    (void)p, (void)s, (void)y;\n    u[0] = 0.0;\n    return 0;\n}\n"
    idle += "void mpc_reset(mpc_state *s) { (void)s; }\nconst mpc_parameters mpc_learned_parameters;\n"
    (tmp_path / "idle.c").write_text('#include "mpc_controller.h"\n' + idle)
    codes = []
    for controller in ("mpc_controller.c", "idle.c"):
        sources = [str(tmp_path / name) for name in (controller, "mpc_test.c")]
        subprocess.run(["gcc", "-std=c99", "-O0", *sources, "-o", str(tmp_path / "t"), "-lm"], check=True)
        done = subprocess.run(
            [tmp_path / "t", tmp_path / "test_vectors.txt"], capture_output=True, text=True, check=False
        )
        codes.append(done.returncode)
    assert codes == [0, 1]


@pytest.mark.parametrize("high", [np.inf, 1e9])
def test_bounds_that_are_none_hide_no_error(high: float, tmp_path: Path) -> None:
    export_c(MPCPolicy(named({"m": "kg"}, action_low=[-high], action_high=[high]), "ddp"), tmp_path)
    rows = np.loadtxt(tmp_path / "test_vectors.txt")
    found = re.search(r"range\[MPC_NU\] = \{(.*?)\}", (tmp_path / "mpc_test.c").read_text())
    assert found
    assert 0.0 < float(found[1]) <= 1000.0 * np.abs(rows[:, -1]).max()
