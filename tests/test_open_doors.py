"""Everything that can be added is added from outside: by a module that is no part of the package, in a few lines."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from mpcoffline import MPC, Model, MPCPolicy, OfflineMPCLearner, QuadraticCost, TransitionTable, make_solver
from mpcoffline.core import parallel
from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.parallel import EXECUTORS
from mpcoffline.core.registry import Registry
from mpcoffline.learning import VALUE_METHODS
from mpcoffline.mpc import CONSTRAINTS, COSTS
from mpcoffline.solvers import SOLVERS

Add = Callable[[str, str, int], ModuleType]

COST = """
import casadi as ca
from mpcoffline.mpc import COSTS, Block, ParameterSpace
from mpcoffline.mpc.component import Component, blocks_from_json

@COSTS.register("outside.Huber")
class Huber(Component):
    convex = True

    def __init__(self, w):
        self.space = ParameterSpace([Block.free("w", w, "cost")])

    def expression(self, x, u, p):
        return p["w"] * (ca.sqrt(1 + ca.sumsqr(x)) - 1) + ca.sumsqr(u)

    @classmethod
    def from_json(cls, data):
        cost = cls(1.0)
        cost.space = blocks_from_json(data)
        return cost
"""

CONSTRAINT = """
import casadi as ca
from mpcoffline.mpc import AnyConstraint, Constraint

class Disc(AnyConstraint):
    def __init__(self, radius):
        self.radius = radius

    def fitted(self, sizes):
        return Constraint(lambda x, p: ca.sumsqr(x) - self.radius**2, "disc", terminal=True).fitted(sizes)
"""

SOLVER = """
import numpy as np
from mpcoffline.solvers import SOLVERS, Solution, Solver, Status

@SOLVERS.register("outside.grid")
class Grid(Solver):
    relative_speed = 1e4

    @classmethod
    def refuses(cls, mpc):
        return "" if (mpc.horizon, mpc.nu) == (1, 1) and mpc.constraints is None else "more than one input"

    def _solve(self, x, theta, u0, warm_start):
        mpc, n = self.mpc, len(x)
        u, states, value = np.empty((n, 1, 1)), np.empty((n, 2, mpc.nx)), np.empty(n)
        for i in range(n):
            tried = np.linspace(mpc.action_low, mpc.action_high, 4001).T if u0 is None else u0[i : i + 1].T
            ends = mpc.dynamics_function(x[i], tried, theta).full()
            costs = mpc.stage_function(x[i], tried, theta) + mpc.discount * mpc.terminal_function(ends, theta)
            best = int(np.argmin(costs.full()))
            u[i, 0], states[i], value[i] = tried[:, best], [x[i], ends[:, best]], costs[best]
        status = [Status.CONVERGED] * n
        stats = {"iterations": np.ones(n, dtype=int), "time": 0.0}
        return Solution(u[:, 0].copy(), states, u, value, np.ones(n, dtype=bool), status, stats)
"""

VALUE_METHOD = """
from dataclasses import dataclass
from mpcoffline.learning import VALUE_METHODS, ValueMethod
from mpcoffline.learning.value.methods import sampled_target

@VALUE_METHODS.register("outside.huber")
@dataclass(frozen=True)
class Huber(ValueMethod):
    width: float = 1.0

    def loss(self, V, V_target, batch, discount):
        delta = sampled_target(V_target, batch, discount) - V(batch.observations)
        return ((1.0 + (delta / self.width).square()).sqrt() - 1.0).mean()
"""

EXECUTOR = """
from concurrent.futures import ThreadPoolExecutor
from mpcoffline.core.parallel import EXECUTORS, Executor

@EXECUTORS.register("outside.threads")
class Threads(Executor):
    def __init__(self, fn, n):
        self.fn, self.n = fn, n

    def run(self, jobs):
        with ThreadPoolExecutor(self.n) as pool:
            yield from zip(jobs, pool.map(self.fn, jobs.values()))
"""


@pytest.fixture
def add(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Add:
    """Imports a module from outside, which takes no more lines than said; what it registers goes after the test."""
    registries: tuple[Registry[Any], ...] = (COSTS, CONSTRAINTS, SOLVERS, VALUE_METHODS, EXECUTORS)
    for registry in registries:
        monkeypatch.setattr(registry, "_things", dict(registry.items()))
    folder = tmp_path / "outside"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)

    def imported(name: str, source: str, most: int) -> ModuleType:
        assert len([line for line in source.splitlines() if line.strip()]) <= most
        (folder / f"{name}.py").write_text(source, encoding="utf-8")
        monkeypatch.delitem(sys.modules, name, raising=False)
        return importlib.import_module(name)

    return imported


def problem(**changes: Any) -> MPC:
    model = Model(lambda x, u, p: 0.9 * x + p["b"] * u, 1, 1, 0.1, {"b": 1.0}, discrete=True)
    cost = QuadraticCost([[1.0]], [[1.0]])
    arguments: dict[str, Any] = {"model": model, "stage_cost": cost, "terminal_cost": cost, "horizon": 3}
    return MPC(**(arguments | {"discount": 0.9, "action_low": [-1.0], "action_high": [1.0]} | changes))


def table() -> TransitionTable:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(400, 1)), rng.uniform(-1, 1, size=(400, 1))
    return TransitionTable.from_arrays(x, u, (x**2 + u**2)[:, 0], 0.9 * x + 0.8 * u, np.zeros(400))


BRIEF: dict[str, Any] = {"value_n_steps": 20, "hidden": (8,), "fit_n_steps": 5, "refit_rows": 300}


def test_a_cost(add: Add, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = add("outside_cost", COST, 15)
    learner = OfflineMPCLearner(problem(stage_cost=mine.Huber(2.0)), **BRIEF)
    learner.fit(table(), show_progress=False)
    learner.policy.save(tmp_path / "policy.zip")
    loaded = MPCPolicy.load(tmp_path / "policy.zip")
    assert isinstance(loaded.mpc.stage_cost, mine.Huber)
    np.testing.assert_array_equal(loaded.predict([0.5])[0], learner.policy.predict([0.5])[0])
    monkeypatch.undo()  # as in a program that has not imported it
    with pytest.raises(FileFormatError, match=r"got 'outside\.Huber'\. .* import what registers that cost first"):
        MPCPolicy.load(tmp_path / "policy.zip")


def test_a_constraint(add: Add) -> None:
    mine = add("outside_constraint", CONSTRAINT, 7)
    mpc = problem(constraints=[mine.Disc(0.1)])
    for each in (mpc, MPC.from_json(mpc.to_json())):
        solution = make_solver(each).solve([1.5])
        assert solution.success
        assert abs(solution.x[-1, 0]) <= 0.1 + 1e-6
        assert abs(make_solver(problem()).solve([1.5]).x[-1, 0]) > 0.11


def test_a_solver(add: Add, tmp_path: Path) -> None:
    add("outside_solver", SOLVER, 22)
    mpc, x = problem(horizon=1), np.array([[0.5], [-0.3], [3.0]])
    solver = make_solver(mpc)
    assert solver.name == "outside.grid"
    expected = make_solver(mpc, "ipopt")
    np.testing.assert_allclose(solver.solve(x).u0, expected.solve(x).u0, atol=1e-3)
    np.testing.assert_allclose(solver.q_value(x, [[0.1]] * 3), expected.q_value(x, [[0.1]] * 3), rtol=1e-8)
    assert make_solver(problem()).name == "lqr"
    MPCPolicy(mpc, solver).save(tmp_path / "policy.zip")
    assert MPCPolicy.load(tmp_path / "policy.zip").solver.name == "outside.grid"


def test_a_value_method(add: Add, tmp_path: Path) -> None:
    mine = add("outside_value", VALUE_METHOD, 10)
    for value in ("outside.huber", mine.Huber(0.5)):
        learner = OfflineMPCLearner(problem(), value=value, candidate="full", **BRIEF)
        learner.fit(table(), show_progress=False)
        learner.save(tmp_path / "learner.zip")
        assert OfflineMPCLearner.load(tmp_path / "learner.zip").method == learner.method


def test_an_executor(add: Add) -> None:
    add("outside_executor", EXECUTOR, 9)
    seen: list[str] = []
    jobs = {"a": -1, "b": 2, "c": -3}
    assert parallel.map(abs, jobs, 2, on_done=seen.append, executor="outside.threads") == [1, 2, 3]
    assert seen == ["a", "b", "c"]
