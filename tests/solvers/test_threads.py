"""One solver in many threads, in forks, copied and pickled: always the results of serial calls, bit for bit."""

from __future__ import annotations

import copy
import multiprocessing
import os
import pickle
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest
from mpc_problems import random_linear

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.solvers import Solver, make_solver

THREADS = 8


def pendulum() -> MPC:
    model = Model(lambda x, u, p: ca.vertcat(x[1], p["k"] * u - ca.sin(x[0])), 2, 1, 0.1, parameters={"k": 1.0})
    return MPC(model, QuadraticCost(np.eye(2), [[0.1]]), QuadraticCost(np.eye(2)), 5, 0.95, [-1.0], [1.0])


def solver_of(name: str) -> Solver:
    return make_solver(random_linear(3, nu=2) if name == "lqr" else pendulum(), name)


def states(solver: Solver, n: int) -> Array:
    """Some of them so far out that inputs are at their bounds."""
    return np.random.default_rng(1).normal(scale=4.0, size=(n, solver.mpc.nx))


@pytest.mark.parametrize(("name", "n"), [("ddp", 150), ("lqr", 100), ("ipopt", 5)])
def test_threads_share_a_solver(name: str, n: int) -> None:
    solver = solver_of(name)
    x = states(solver, n)

    def each(start: int) -> list[Array]:
        """The plans from all states, in another order in each thread."""
        order = np.roll(np.arange(n), start * n // THREADS)
        plans = {i: solver.solve(x[i]).u for i in order}
        return [plans[i] for i in range(n)]

    expected = each(0)
    switching = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(THREADS) as pool:
            for found in pool.map(each, range(THREADS)):
                np.testing.assert_array_equal(found, expected)
    finally:
        sys.setswitchinterval(switching)


def test_the_first_solves_of_threads_build_what_they_need_once() -> None:
    """The program of stagewise thetas is built at the first solve that needs it."""
    mpc = pendulum()
    rng, x = np.random.default_rng(0), np.array([[0.5, 0.0]])
    along = mpc.theta * rng.uniform(1.0, 1.1, size=(4, 1, mpc.horizon + 1, mpc.space.size))
    expected = [make_solver(mpc, "ipopt").solve(x, theta).u for theta in along]
    shared = make_solver(mpc, "ipopt")
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda theta: shared.solve(x, theta).u, along))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("name", ["ddp", "lqr", "ipopt"])
def test_copies_and_pickles(name: str) -> None:
    solver = solver_of(name)
    x = states(solver, 3)
    expected = solver.solve(x).u
    for other in (copy.copy(solver), copy.deepcopy(solver), pickle.loads(pickle.dumps(solver))):
        np.testing.assert_array_equal(other.solve(x).u, expected)


def test_a_pickle_keeps_the_options_and_refuses_what_has_no_json() -> None:
    again = pickle.loads(pickle.dumps(make_solver(pendulum(), "ddp", max_iterations=7, n_threads=2)))
    assert (again.max_iterations, again._n_threads) == (7, 2)

    z, y = ca.MX.sym("z"), ca.MX.sym("y")
    root = ca.rootfinder("root", "newton", ca.Function("g", [z, y], [z + 0.1 * ca.sin(z) - y]))
    mpc = pendulum().replace(model=Model(lambda x, u, p: ca.vertcat(x[1], u - root(0.0, x[0])), 2, 1, 0.1))
    with pytest.raises(InvalidArgumentError, match="plain arithmetic"):
        pickle.dumps(make_solver(mpc, "ipopt"))


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("name", ["ddp", "lqr", "ipopt"])
def test_a_fork_while_another_thread_solves(name: str) -> None:
    solver = solver_of(name)
    x = states(solver, 3)
    expected = solver.solve(x).u
    within, done = threading.Event(), threading.Event()

    def solving() -> None:
        """Holds the lock, if there is one, as a solve does."""
        lock = getattr(solver, "_alone", None)
        if lock is None:
            within.set()
            return
        with lock:
            within.set()
            done.wait()

    thread = threading.Thread(target=solving)
    thread.start()
    within.wait()
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=lambda: queue.put(solver.solve(x).u))
    child.start()
    try:
        np.testing.assert_array_equal(queue.get(timeout=60.0), expected)
    finally:
        done.set()
        thread.join()
        child.join()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_fork_that_ends_leaves_its_parents_workers_alone() -> None:
    solver = make_solver(pendulum(), "ipopt", n_workers=2)
    x = states(solver, 4)
    expected = solver.solve(x).u
    child = os.fork()
    if child == 0:
        try:
            good = np.array_equal(solver.solve(x).u, expected)
            solver.close()
        finally:
            os._exit(0 if good else 1)
    assert os.waitpid(child, 0)[1] == 0
    np.testing.assert_array_equal(solver.solve(x).u, expected)
    solver.close()
