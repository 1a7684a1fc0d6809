"""Compilers of other makes, with arguments, and without room; libraries that others planted in the cache."""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from compiling import QUICK_FLAGS, SHIPPED_FLAGS, STATE, compiled_with, compiler_script, libraries, tiny

from mpcoffline.core import places
from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.solvers import CompilerError, DDPSolver, make_solver
from mpcoffline.solvers.ddp import build
from mpcoffline.solvers.ddp.codegen import source

needs_clang = pytest.mark.skipif(shutil.which("clang") is None, reason="no clang")
root_only = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of compiled solvers in an empty cache; temporary files in a folder of the test's own.

    Where not the code that compilers make matters, but where it goes, they do not optimise it.
    """
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(tmp_path / "cache"))
    places.warn_once.cache_clear()
    with compiled_with(QUICK_FLAGS):
        yield tmp_path / "cache" / "solvers"


@pytest.fixture
def as_shipped(cache: Path) -> Iterator[None]:
    """Compiled with the flags that users have."""
    with compiled_with(SHIPPED_FLAGS):
        yield


def temporary(tmp_path: Path) -> Path:
    return tmp_path / "temporary" / f"mpcoffline-{os.geteuid()}" / "solvers"


def pendulum() -> MPC:
    """Every function that C has a vector form of enters: fmax, powers, divisions, tanh, a select."""

    def f(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        drag = ca.if_else(x[1] > 0.0, 0.1, 0.2) * ca.fmax(x[1] ** 2, 0.01) / (1.0 + ca.tanh(x[0]) ** 2)
        return ca.vertcat(x[1], u[0] - ca.sin(x[0]) - drag)

    return MPC(
        Model(f, 2, 1, 0.1), QuadraticCost(np.eye(2), [[0.1]]), QuadraticCost(np.eye(2)), 12, 0.95, [-1.0], [1.0]
    )


@needs_clang
@pytest.mark.slow
@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("mpc", [pendulum(), tiny()])
def test_clang_gives_what_gcc_gives(
    mpc: MPC, cache: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    x = np.random.default_rng(0).normal(size=(40, mpc.model.nx))
    theirs = make_solver(mpc, "ddp").solve(x)
    monkeypatch.setenv("CC", "clang")
    found = make_solver(mpc, "ddp").solve(x)
    assert found.success.all()
    np.testing.assert_allclose(found.value, theirs.value, rtol=1e-9)
    np.testing.assert_allclose(found.u, theirs.u, atol=1e-5)
    assert len(libraries(cache)) == 2
    assert not recwarn.list


@needs_clang
@pytest.mark.usefixtures("as_shipped")
def test_clang_compiles_without_an_error_of_its_own(tmp_path: Path) -> None:
    flags = build.flags_of("clang")
    assert "-O3" in flags
    assert "-march=native" in flags
    command = ["clang", *flags, "-w", "-x", "c", "-", "-o", str(tmp_path / "x.so"), "-lm"]
    subprocess.run(command, input=source(tiny()), text=True, check=True)


@pytest.mark.parametrize("arguments", ["-m64", "-O2", "-g0 -DX='a b'"])
def test_arguments_in_cc(arguments: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    if "-m64" in arguments and os.uname().machine != "x86_64":
        pytest.skip("another processor")
    monkeypatch.setenv("CC", f"{build.find_compiler()} {arguments}")
    assert DDPSolver(tiny()).solve(STATE).success.all()
    assert not caplog.text


def test_a_program_before_the_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As ccache; and a path with a blank in it."""
    (tmp_path / "a b").mkdir()
    wrapper = compiler_script(tmp_path / "a b", f'#!/bin/sh\necho >> "{tmp_path}/calls"\nexec "$@"\n')
    monkeypatch.setenv("CC", f"'{wrapper}' {build.find_compiler()}")
    assert DDPSolver(tiny()).solve(STATE).success.all()
    assert (tmp_path / "calls").exists()
    compiler = compiler_script(tmp_path / "a b", f'#!/bin/sh\nexec {build.compilers()[-1]} "$@"\n')
    monkeypatch.setenv("CC", compiler)
    assert build.find_compiler() == f"'{compiler}'"
    assert DDPSolver(tiny()).solve(STATE).success.all()


@pytest.mark.parametrize("given", ["no-such-compiler", "no-such -O2", "'gcc", " "])
def test_a_cc_that_is_not_there(given: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setenv("CC", given)
    assert DDPSolver(tiny()).solve(STATE).success.all()
    assert (given.strip() in caplog.text) if given.strip() else not caplog.text


def test_a_compiler_without_vectors_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As tcc: it takes every flag, and knows no vectors."""
    script = (
        f'#!/bin/sh\ncase " $* " in *" -E "*) exec {build.find_compiler()} "$@";; esac\n'
        "echo '-:4: error: pointer expected' >&2\nexit 1\n"
    )
    monkeypatch.setenv("CC", compiler_script(tmp_path, script))
    assert DDPSolver(tiny()).solve(STATE).success.all()
    assert "fake-cc cannot compile vectors of doubles (-:4: error: pointer expected)" in caplog.text
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    with pytest.warns(UserWarning, match="500 times slower than ddp: C compiler: expected one that works"):
        assert make_solver(pendulum()).name == "ipopt"


def full_disk_compiler(tmp_path: Path, folder: Path, complaint: str) -> str:
    """A compiler for which there is no room in a folder."""
    return compiler_script(
        tmp_path,
        f'#!/bin/sh\ncase "$*" in *"-o {folder}"*) echo half > "$TMPDIR/left"; {complaint}; exit 1;; esac\n'
        f'exec {build.find_compiler()} "$@"\n',
    )


@pytest.mark.parametrize(
    "complaint",
    [
        "echo 'fatal error: error writing to x.s: No space left on device' >&2",
        "echo 'final link failed: Disk quota exceeded' >&2",
        "echo 'File too large' >&2",
    ],
)
def test_a_cache_without_room_for_the_compiler(
    complaint: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It goes to the temporary files, where it is found again; said once; nothing is left in the cache."""
    monkeypatch.setenv("CC", full_disk_compiler(tmp_path, cache, complaint))
    for _ in range(2):
        assert DDPSolver(tiny()).solve(STATE).success.all()
    assert not list(cache.iterdir())
    (library,) = libraries(temporary(tmp_path))
    assert caplog.text.count("No space left on device") == 1
    assert library.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("code", ["ENOSPC", "EROFS"])
def test_a_cache_without_room_for_the_library(
    code: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import errno

    replace = os.replace

    def full(source: Path, target: Path) -> None:
        if Path(target).parent == cache:
            raise OSError(getattr(errno, code), "no room")
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    assert DDPSolver(tiny()).solve(STATE).success.all()
    assert not list(cache.iterdir())
    assert len(libraries(temporary(tmp_path))) == 1


def test_no_room_anywhere_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", full_disk_compiler(tmp_path, tmp_path, "echo 'No space left on device' >&2"))
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    with pytest.raises(CompilerError, match=r"No space left on device.*Free some space"):
        DDPSolver(tiny())


PLANTED = '#include <stdio.h>\n__attribute__((constructor)) static void run(void) {{ fclose(fopen("{}", "w")); }}\n'


def planted(folder: Path, mark: Path) -> Path:
    """A library of the right name and seal that leaves a mark when it is loaded."""
    compiler, text = build.find_compiler(), source(tiny())
    flags, target = build._target(compiler)
    key = hashlib.sha256("\0".join([text, *flags, target]).encode()).hexdigest()[:24]
    library = folder / f"ddp-{key}.so"
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    quickly = [*shlex.split(compiler), "-std=gnu11", "-O0", "-fPIC", "-shared", "-w", "-march=native"]
    command = [*quickly, "-x", "c", "-", "-o", str(library), "-lm"]
    subprocess.run(command, input=text + PLANTED.format(mark), text=True, check=True)
    with library.open("ab") as file:
        file.write(build._seal(library.read_bytes(), library.name))
    library.chmod(0o700)
    return library


@pytest.mark.slow
@pytest.mark.parametrize("how", ["mine", "theirs", "writable", "folder", "root", "link", "name"])
def test_a_library_that_another_user_planted_is_not_loaded(how: str, cache: Path, tmp_path: Path) -> None:
    if how in ("theirs", "link") and os.geteuid() != 0:
        pytest.skip("only root can give files away")
    mark = tmp_path / "mark"
    library = planted(cache, mark)
    if how == "theirs":
        os.chown(library, 12345, 12345)
    elif how == "writable":
        library.chmod(0o722)
    elif how == "folder":
        cache.chmod(0o777)
    elif how == "root":
        cache.parent.chmod(0o777)
    elif how == "link":
        library.rename(tmp_path / "elsewhere.so")
        library.symlink_to(tmp_path / "elsewhere.so")
        os.lchown(library, 12345, 12345)
    elif how == "name":  # one of the user's own libraries, under the name of another
        content = library.read_bytes()[:-32]
        library.write_bytes(content + build._seal(content, f"ddp-{'0' * 24}.so"))
    assert DDPSolver(tiny()).solve(STATE).success.all()
    assert mark.exists() == (how == "mine")


def test_libraries_that_are_loaded_one_after_the_other_are_not_taken_for_each_other() -> None:
    """They are loaded from descriptors, whose numbers are used again."""
    solvers = [DDPSolver(tiny(factor=factor)) for factor in (1.0, 0.5)]
    again = [DDPSolver(solver.mpc) for solver in solvers]
    expected = [make_solver(solver.mpc, "ipopt").value(STATE) for solver in solvers]
    for found in (solvers, again):
        np.testing.assert_allclose([solver.value(STATE) for solver in found], expected, rtol=1e-6)


def test_solvers_that_are_not_used_go(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = DDPSolver(tiny())
    value = first.value(STATE)
    monkeypatch.setenv("MPCOFFLINE_CACHE_SIZE", "1 kB")
    DDPSolver(tiny(factor=0.5))
    assert len(libraries(cache)) == 1
    assert first.value(STATE) == value  # what is loaded stays loaded
