"""Solvers that are compiled beside other work."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from mpcoffline import MPC, Model, Parameter, QuadraticCost
from mpcoffline.solvers import CompilerError, DDPSolver
from mpcoffline.solvers.ddp import Ahead, build
from mpcoffline.solvers.ddp.codegen import source


def mpc_of(power: int) -> MPC:
    """A plant that no other test has, by its power."""
    model = Model(lambda x, u, p: u - p["a"] * x**power, nx=1, nu=1, dt=0.1, parameters={"a": Parameter(0.9)})
    cost = QuadraticCost(W=1.0, R=0.1)
    return MPC(model, cost, QuadraticCost(W=1.0), horizon=5, discount=0.9, action_low=[-1.0], action_high=[1.0])


@pytest.fixture
def compiled_by(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which threads compile, in an empty cache."""
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(tmp_path))
    threads: list[str] = []
    output = build._output

    def noted(*arguments: object) -> Path:
        threads.append(threading.current_thread().name)
        return output(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(build, "_output", noted)
    return threads


def test_who_asks_meanwhile_gets_what_is_compiled_in_the_background(compiled_by: list[str]) -> None:
    with Ahead(1) as ahead:
        ahead.start([mpc_of(3)])
        solver = DDPSolver(mpc_of(3))
    assert len(compiled_by) == 1
    assert compiled_by != ["MainThread"]
    assert not build.underway
    assert solver.solve(np.array([[0.5]])).success.all()
    assert np.array_equal(solver.solve(np.array([[0.5]])).u, DDPSolver(mpc_of(3)).solve(np.array([[0.5]])).u)


def test_what_waits_for_its_turn_is_compiled_by_who_asks(
    compiled_by: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, here = threading.Event(), build.compiled_here

    def held(text: str) -> object:
        if threading.current_thread() is not threading.main_thread():
            go_on.wait(60.0)
        return here(text)

    monkeypatch.setattr(build, "compiled_here", held)
    try:
        with Ahead(1) as ahead:
            ahead.start([mpc_of(3), mpc_of(5)])
            first = build.underway[source(mpc_of(3))]
            DDPSolver(mpc_of(5))
            assert compiled_by == ["MainThread"]
    finally:
        go_on.set()
    first.result()  # else the next test would see it compile


def test_nothing_is_compiled_ahead_without_workers(compiled_by: list[str]) -> None:
    with Ahead(0) as ahead:
        ahead.start([mpc_of(3)])
        assert not build.underway
    assert not compiled_by


def test_a_failure_is_told_to_who_asks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPCOFFLINE_CACHE", str(tmp_path))
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(0o700)
    monkeypatch.setattr(build, "compilers", lambda: [str(broken)])
    with Ahead(1) as ahead:
        ahead.start([mpc_of(7)])
        text = source(mpc_of(7))
        assert text in build.underway
        with pytest.raises(CompilerError):
            DDPSolver(mpc_of(7))
