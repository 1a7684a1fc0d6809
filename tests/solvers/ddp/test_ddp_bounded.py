"""What is compiled may come from a file: a compiler has bounds, and what is too large for one is told before."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from mpcoffline import MPC, Model, QuadraticCost
from mpcoffline.core import limits
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.solvers import CompilerError, DDPSolver, make_solver
from mpcoffline.solvers.ddp import bounded, build
from mpcoffline.solvers.ddp.bounded import ran_out, run_bounded


def of_length(n: int, nx: int = 1) -> MPC:
    """A model of n operations a state."""

    def f(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        value = x + u
        for _ in range(n):
            value = ca.sin(value)
        return value

    model = Model(f, nx, 1, 0.1, discrete=True)
    return MPC(model, QuadraticCost(np.eye(nx), [[1.0]]), QuadraticCost(np.eye(nx)), 2, 0.9, [-1.0], [1.0])


def test_a_program_that_ends_is_as_without_bounds() -> None:
    done = run_bounded([sys.executable, "-c", "print(input()[::-1])"], timeout=60.0, source="abc\n")
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "cba", "")
    assert not ran_out(done)


def test_what_it_started_ends_with_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "held")
    descriptor = os.open(tmp_path / "held", os.O_RDONLY | os.O_NONBLOCK)
    script = f"exec 3>{tmp_path / 'held'}; sleep 600 & wait"
    with pytest.raises(subprocess.TimeoutExpired):
        run_bounded(["/bin/sh", "-c", script], timeout=1.0)
    os.set_blocking(descriptor, True)
    assert os.read(descriptor, 1) == b""  # comes once neither of them holds it
    os.close(descriptor)


@pytest.mark.skipif(sys.platform != "linux", reason="no limit of memory")
def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded, "MEMORY", 1 << 30)
    done = run_bounded([sys.executable, "-c", "bytearray(1 << 31)"], timeout=60.0)
    assert done.returncode
    assert "MemoryError" in done.stderr


def test_a_compiler_that_runs_out_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = build.find_compiler()
    script = tmp_path / "compiler"
    message = "cc1: out of memory allocating 65536 bytes"
    script.write_text(  # it works for what is small
        f'#!/bin/sh\ncase "$*" in *-E*) exec {real} "$@";; esac\nsource={tmp_path}/source; cat >"$source"\n'
        f'if grep -q "int trial(double a)" "$source"; then exec {real} "$@" <"$source"; fi\n'
        f'echo "{message}" >&2; exit 1\n'
    )
    script.chmod(0o700)
    monkeypatch.setenv("CC", str(script))
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(tmp_path / "cache"))
    with pytest.raises(CompilerError, match=r"no result within 300 s and 4 GiB.*too large.*ipopt"):
        DDPSolver(of_length(3))


def test_too_large_a_model_goes_to_ipopt_by_name() -> None:
    mpc = of_length(limits.COMPILED_NODES)
    with pytest.raises(InvalidArgumentError, match=f"at most {limits.COMPILED_NODES} operations for the ddp solver"):
        DDPSolver(mpc)


def dense(nx: int) -> MPC:
    """A model all of whose states act on each other."""
    model = Model(lambda x, u, p: ca.sin(ca.sum1(x) + u) + x, nx, 1, 0.1, discrete=True)
    return MPC(model, QuadraticCost(np.eye(nx), [[1.0]]), QuadraticCost(np.eye(nx)), 2, 0.9, [-1.0], [1.0])


def test_auto_takes_ipopt_then_and_says_what_ddp_said() -> None:
    solver = make_solver(dense(90))
    assert solver.name == "ipopt"
    assert "products of derivatives" in solver.reason
