"""Compiling the ddp solver: the cache, broken compilers, interrupted and concurrent builds, sanitizers."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from compiling import QUICK_FLAGS, STATE, compiled_with, compiler_script, libraries, tiny
from mpc_problems import random_linear

from mpcoffline.mpc import Constraint, Model, NetworkCost, NormCost, Penalty
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import CompilerError, DDPSolver, make_solver
from mpcoffline.solvers.ddp import build, codegen
from mpcoffline.solvers.ddp.codegen import source


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of compiled solvers in an empty cache; as none is used for long, they are not optimised."""
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(tmp_path / "cache"))
    with compiled_with(QUICK_FLAGS):
        yield tmp_path / "cache" / "solvers"


def test_a_solver_is_compiled_once(cache: Path) -> None:
    value = DDPSolver(tiny()).value(STATE)
    (library,) = libraries(cache)
    made = library.stat().st_mtime_ns
    # The horizon, the discount, the bounds and theta are data.
    others = [tiny(3.0), tiny().replace(horizon=9), tiny().replace(discount=0.5, action_low=[-0.1])]
    for mpc in (tiny(), *others):
        DDPSolver(mpc)
    assert DDPSolver(tiny()).value(STATE) == value
    assert libraries(cache) == [library]
    assert library.stat().st_mtime_ns == made
    assert sorted(cache.iterdir()) == [library]  # no scratch is left


def test_flags_and_processor_are_in_the_key(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    DDPSolver(tiny())
    flags, target = build._target(build.find_compiler())
    monkeypatch.setattr(build, "_target", lambda compiler: (flags, target + "\n#define __OTHER__ 1"))
    DDPSolver(tiny())
    assert len(libraries(cache)) == 2
    monkeypatch.setattr(build, "_target", lambda compiler: ((*flags, "-g0"), target))
    DDPSolver(tiny())
    assert len(libraries(cache)) == 3


@pytest.mark.parametrize("damage", ["garbage", "empty", "truncated", "one bit"])
def test_a_damaged_library_is_built_again(cache: Path, damage: str, caplog: pytest.LogCaptureFixture) -> None:
    """Also one whose head is whole: the loader maps such a file, and the process dies of a bus error."""
    value = DDPSolver(tiny()).value(STATE)
    (library,) = libraries(cache)
    content = library.read_bytes()
    middle = len(content) // 2
    damaged = {
        "garbage": b"no library",
        "empty": b"",
        "truncated": content[:middle],
        "one bit": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
    }
    other = library.with_suffix(".new")  # the old file is mapped in this process: not to be written into
    other.write_bytes(damaged[damage])
    other.replace(library)
    assert DDPSolver(tiny()).value(STATE) == value
    assert "damaged" in caplog.text
    assert library.read_bytes() == content


BROKEN = {
    "fails": ("#!/bin/sh\necho broken as can be >&2\nexit 1\n", "broken as can be"),
    "writes nothing": ("#!/bin/sh\nexit 0\n", "no output"),
    "no program": ("this is no program\n", "(?i)format|cannot compile"),
    "writes rubbish": (
        '#!/bin/sh\nwhile [ "$1" != -o ] && [ $# -gt 0 ]; do shift; done\n[ $# -gt 0 ] && echo no > "$2"\nexit 0\n',
        "cannot compile",
    ),
}


@pytest.mark.parametrize("kind", [None, *BROKEN])
def test_no_compiler_that_works(kind: str | None, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ddp says so; "auto" says so once, what it costs and what to do, and goes on with another solver."""
    script, message = BROKEN[kind] if kind else (None, "got none")
    monkeypatch.setenv("CC", compiler_script(tmp_path, script) if script else "no-such-compiler")
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    with pytest.raises(CompilerError, match=message) as error:
        DDPSolver(tiny())
    assert "Install gcc or clang" in str(error.value)
    assert not libraries(cache)
    plant = tiny().replace(model=Model(lambda x, u, p: x + u + 0.1 * x**2, 1, 1, 1.0, discrete=True))
    with pytest.warns(UserWarning, match="about 500 times slower.*C compiler.*Install gcc or clang"):
        solver = make_solver(plant, "auto")
    assert solver.name == "ipopt"
    assert solver.solve(STATE).success.all()


@pytest.mark.parametrize("kind", [None, *BROKEN])
def test_the_next_compiler_takes_the_place_of_one_that_does_not_work(
    kind: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    given = compiler_script(tmp_path, BROKEN[kind][0]) if kind else f"{tmp_path}/no-such-compiler"
    monkeypatch.setenv("CC", given)
    assert DDPSolver(tiny()).solve(STATE).success.all()
    assert given in caplog.text


def test_a_working_compiler_that_fails_is_not_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What one compiler says against a model, the next would say again, minutes later."""
    compiler = build.find_compiler()
    monkeypatch.setenv("CC", compiler_script(tmp_path, f'#!/bin/sh\necho >> {tmp_path}/calls\nexec {compiler} "$@"\n'))
    with pytest.raises(CompilerError, match="such nonsense"):
        build.compiled("#error such nonsense\n")
    assert len((tmp_path / "calls").read_text().splitlines()) == 3  # what it targets, the source, a trial
    with pytest.raises(CompilerError, match="such nonsense"):
        build.compiled("#error such nonsense\n")
    assert len((tmp_path / "calls").read_text().splitlines()) == 4


def test_a_compiler_without_march_native(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = build.find_compiler()
    script = f'#!/bin/sh\ncase " $* " in *" -march=native "*) echo unknown >&2; exit 1;; esac\nexec {compiler} "$@"\n'
    monkeypatch.setenv("CC", compiler_script(tmp_path, script))
    assert DDPSolver(tiny()).solve(STATE).success.all()


def test_a_cache_that_cannot_be_written(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A file where the folder should be (a read-only folder would not stop root): solved without a cache, and said."""
    cache.parent.write_text("in the way")
    assert DDPSolver(tiny()).solve(STATE).success.all()
    assert "cannot be used" in caplog.text


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_cache(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    cache.mkdir(mode=0o500, parents=True)
    assert DDPSolver(tiny()).solve(STATE).success.all()
    assert "cannot be used" in caplog.text


SCRIPT = """
from compiling import QUICK_FLAGS, STATE, compiled_with, tiny
from mpcoffline.solvers import DDPSolver
with compiled_with(QUICK_FLAGS):
    print(repr(float(DDPSolver(tiny()).value(STATE)[0])))
"""


def child(tmp_path: Path, **environment: str) -> subprocess.Popen[str]:
    """A process that builds and uses the solver."""
    script = tmp_path / "child.py"
    script.write_text(SCRIPT)
    helpers = Path(__file__).parents[2] / "helpers"
    env = os.environ | {"PYTHONPATH": str(helpers)} | environment
    return subprocess.Popen([sys.executable, str(script)], env=env, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_processes_that_build_at_once(cache: Path, tmp_path: Path) -> None:
    children = [child(tmp_path) for _ in range(3)]
    values = {process.communicate()[0] for process in children}
    assert [process.returncode for process in children] == [0, 0, 0]
    assert values == {f"{float(DDPSolver(tiny()).value(STATE)[0])!r}\n"}
    assert len(list(cache.iterdir())) == 1


def test_a_build_that_is_killed_leaves_no_library(cache: Path, tmp_path: Path) -> None:
    """The compiler has written half of its output when everything is killed."""
    compiler = build.find_compiler()
    script = (
        f'#!/bin/sh\ncase " $* " in *" -E "*) exec {compiler} "$@";; esac\n'
        'while [ "$1" != -o ]; do shift; done\necho half > "$2"\nkill -9 $PPID\n'
    )
    process = child(tmp_path, CC=compiler_script(tmp_path, script))
    process.communicate()
    assert process.returncode == -9
    assert not libraries(cache)
    assert len(list(cache.iterdir())) == 1  # what was being built
    assert DDPSolver(tiny()).solve(STATE).success.all()
    assert [path.suffix for path in cache.iterdir()] == [".so"]


DRIVER = r"""
#include <stdio.h>
static double uniform(void) {
    static unsigned long long state = 1;
    state = state * 6364136223846793005ULL + 1442695040888963407ULL;
    return (double)(state >> 11) / 9007199254740992.0 * 2.0 - 1.0;
}
int main(void) {
    enum { n = 21, N = 15, M = 64 };
    static double x0[n * NX], theta[n * NP + 1], u0[n * NU], x[n * (N + 1) * NX], u[n * N * NU], J[n], predicted[n];
    static double low[NU], high[NU], unit[NU], candidates[M * N * NU];
    static int64_t iterations[n], status[n];
    static const double given[] = {THETA};
    for (int a = 0; a < NU; ++a) { low[a] = -0.5 - 0.1 * a; high[a] = 0.7; unit[a] = 1.0 + a; }
    for (int k = 0; k < M * N * NU; ++k) candidates[k] = 0.5 * uniform();
    mpc_problem problem = {N, 0.95, low, high, unit, low, 50, 1e-10};
    int solved = 0;
    for (int round = 0; round < 4; ++round) {
        double size = round < 3 ? 2.0 : 1e200;
        for (int k = 0; k < n * NX; ++k) x0[k] = size * uniform();
        for (int k = 0; k < n * NU; ++k) u0[k] = 0.3 * uniform();
        for (int i = 0; i < n; ++i)
            for (int k = 0; k < NP; ++k) theta[i * NP + k] = given[k];
        int64_t stride = round % 3 ? NP : 0;
        mpc_batch batch = {n, x0, theta, round % 2 ? u0 : NULL, stride, x, u, J, predicted, NULL, iterations, status,
                           0, x, u};
        for (int64_t part = 0; part < 2; ++part)
            if (mpc_solve_cold(&problem, &batch, candidates, M, 8, part, 2)) return 1;
        for (int k = 0; k < n * NX; ++k) x0[k] += 0.1 * uniform();
        for (int64_t part = 0; part < 3; ++part)
            if (mpc_solve(&problem, &batch, part, 3)) return 1;
        batch.n = 1;
        if (mpc_solve(&problem, &batch, 0, 1)) return 1;
        for (int i = 0; i < n; ++i) solved += round < 3 && status[i] == 0;
    }
    printf("%d\n", solved);
    return 0;
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("case", ["pendulum", "three inputs", "network"])
def test_sanitizers_find_nothing(case: str, tmp_path: Path) -> None:
    """Address and undefined-behaviour sanitizers on cold and warm batches, imposed inputs, overflowing states."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("no gcc")
    mpc = nominal_mpc("mpcoffline/PendulumSwingUp-v0") if case == "pendulum" else random_linear(0, nu=3)
    if case == "network":
        mpc = mpc.replace(terminal_cost=NetworkCost.random(4, (5, 5), seed=0), horizon=15)
    code, program = tmp_path / "driver.c", tmp_path / "driver"
    theta = ", ".join(repr(float(v)) for v in mpc.theta)
    code.write_text(source(mpc) + DRIVER.replace("THETA", theta))
    flags = ["-std=gnu11", "-O0", "-g", "-march=native", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    built = subprocess.run(
        [compiler, *flags, str(code), "-o", str(program), "-lm"], capture_output=True, text=True, check=False
    )
    if "cannot find" in built.stderr and "san" in built.stderr:
        pytest.skip("the compiler's sanitizer libraries are not installed")
    assert built.returncode == 0, built.stderr
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 50


def test_what_is_generated_again_is_what_was_generated(monkeypatch: pytest.MonkeyPatch) -> None:
    """MPCs that differ in theta, bounds or horizon share their C; any other difference is one of the C, too."""
    monkeypatch.setattr(codegen, "_KNOWN", {})
    mpc, price = tiny(), Penalty(2.0, 3.0)
    limited = mpc.replace(constraints=Constraint(lambda x, u, p: x + u - 1.0, "limit", price))
    others = [
        tiny(factor=0.5),
        mpc.replace(terminal_cost=NormCost([0.0])),
        limited,
        limited.replace(constraints=Constraint(lambda x, u, p: x + u - 1.0, "limit", Penalty(2.0, 4.0))),
        limited.replace(constraints=Constraint(lambda x, u, p: x - u - 1.0, "limit", price)),
    ]
    first = [source(each) for each in (mpc, *others)]
    assert len(set(first)) == len(first)
    same = mpc.replace(horizon=9, action_low=[-3.0]).with_theta(1.5 * mpc.theta)
    assert source(same) == first[0]
    monkeypatch.setattr(codegen, "_generated", None)  # nothing more is generated
    assert [source(each) for each in (same, *others)] == first
    monkeypatch.undo()
    monkeypatch.setattr(codegen, "_KNOWN", {})
    assert [source(each) for each in (same, *others)] == first


def test_warnings_of_the_compiler(tmp_path: Path) -> None:
    """The kernel compiles without a warning."""
    code = tmp_path / "solver.c"
    code.write_text(source(tiny()))
    flags = [flag for flag in build.FLAGS if flag != "-O3"] + ["-O1", "-Wall", "-Wextra", "-Wno-unused-parameter"]
    command = [build.find_compiler(), *flags, "-Wno-unused-function", "-Wno-psabi", str(code), "-o", os.devnull]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert np.isfinite(DDPSolver(tiny()).value(STATE)).all()
