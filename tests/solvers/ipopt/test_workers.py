"""Batches of ipopt in worker processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.executors import processes
from mpcoffline.mpc import MPC, Model, QuadraticCost, StateBounds
from mpcoffline.solvers import IpoptSolver


def problem(**changes: Any) -> MPC:
    arguments: dict[str, Any] = {
        "model": Model(lambda x, u, p: ca.vertcat(x[1], ca.sin(x[0]) + u), 2, 1, 0.1, {"m": 1.0}),
        "stage_cost": QuadraticCost(np.eye(2), [[0.1]]),
        "terminal_cost": QuadraticCost(np.eye(2)),
        "horizon": 8,
        "discount": 0.95,
        "action_low": [-1.0],
        "action_high": [1.0],
        "constraints": StateBounds([-9.0, -0.5], [9.0, 0.5]),
    }
    return MPC(**(arguments | changes))


def test_workers_give_the_same_and_end_with_the_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    mpc = problem()
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-0.4, 0.4, size=(11, 2)), rng.uniform(-1, 1, size=(11, 1))
    thetas = np.repeat(mpc.theta[None], 11, axis=0)
    alone, shared = IpoptSolver(mpc), IpoptSolver(mpc, n_workers=2)
    first = alone.solve(x)
    before = set(multiprocessing.active_children())
    for arguments in ({}, {"u0": u}, {"theta": thetas}, {"warm_start": first.plan.shifted()}):
        left, right = alone.solve(x, **arguments), shared.solve(x, **arguments)
        for name in ("u0", "x", "u", "value", "success", "status"):
            np.testing.assert_array_equal(getattr(left, name), getattr(right, name))
        np.testing.assert_array_equal(left.stats["iterations"], right.stats["iterations"])
    workers = set(multiprocessing.active_children()) - before
    assert len(workers) == 2  # the same for all batches
    np.testing.assert_array_equal(shared.solve(x[0]).u, first.u[0])  # a single problem stays here

    # Another takes the place of a worker that dies.
    next(iter(workers)).kill()
    np.testing.assert_array_equal(shared.solve(x).u, first.u)
    assert len(set(multiprocessing.active_children()) - before) == 2

    # So is Ctrl-C while the batch is waited for.
    def interrupt(*_: object) -> list[Any]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(processes, "wait", interrupt)
        with pytest.raises(KeyboardInterrupt):
            shared.solve(x)
    assert set(multiprocessing.active_children()) == before
    shared.close()
    assert set(multiprocessing.active_children()) == before


def test_a_forgotten_solver_leaves_no_process() -> None:
    before = set(multiprocessing.active_children())
    solver = IpoptSolver(problem(horizon=2), n_workers=2)
    solver.solve(np.zeros((2, 2)))
    assert len(set(multiprocessing.active_children()) - before) == 2
    del solver
    assert set(multiprocessing.active_children()) == before


def test_an_own_cost_travels_by_its_expression() -> None:
    class Own(QuadraticCost):
        def expression(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
            return super().expression(x, u, p) + ca.sumsqr(x) ** 2

    mpc, x = problem(stage_cost=Own(np.eye(2), [[1.0]]), horizon=3), np.array([[0.2, 0.1], [0.3, -0.2]])
    shared = IpoptSolver(mpc, n_workers=2)
    np.testing.assert_allclose(shared.solve(x).u, IpoptSolver(mpc).solve(x).u, atol=1e-9)
    shared.close()


def test_numbers_of_workers_that_are_refused() -> None:
    with pytest.raises(InvalidArgumentError, match="n_workers: expected an integer from 1 to"):
        IpoptSolver(problem(), n_workers=0)
