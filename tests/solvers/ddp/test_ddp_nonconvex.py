"""Costs that are not convex in the ddp solver: networks and lifted quadratics, against ipopt and numpy."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest
from mpc_problems import projected_gradient, random_linear, random_states, simulated
from task_ids import CARTPOLE, PENDULUM

from mpcoffline.mpc import MPC, Block, NetworkCost, ParameterSpace
from mpcoffline.mpc.component import Component
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import DDPSolver, IpoptSolver
from mpcoffline.solvers.ddp.build import compiled
from mpcoffline.solvers.ddp.codegen import source


class LiftedCost(Component):
    """|C'phi - d|^2 of phi = (x, x^2, cos x, x u), as a terminal cost without x u; neither is convex."""

    def __init__(self, nx: int, nu: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        n = 3 * nx + nx * nu
        factor, target = rng.normal(size=(n, 3)), rng.normal(size=3)
        self.space = ParameterSpace([Block.free("C", factor, "cost"), Block.free("d", target, "cost")])

    def expression(self, x: ca.SX, u: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        features = ca.vertcat(x, 0.3 * x**2, 0.3 * ca.cos(x), 0.3 * ca.vec(x @ u.T))
        return ca.sumsqr(p["C"].T @ features - p["d"]) + 0.1 * ca.sumsqr(u)

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        features = ca.vertcat(x, 0.3 * x**2, 0.3 * ca.cos(x))
        return ca.sumsqr(p["C"][: features.numel(), :].T @ features - p["d"])


class Saddle(Component):
    """x'Mx with an indefinite M."""

    convex: ClassVar[bool] = False

    def __init__(self, matrix: np.ndarray) -> None:
        self.space = ParameterSpace([Block.free("M", matrix, "cost")])

    def terminal_expression(self, x: ca.SX, p: Mapping[str, ca.SX]) -> ca.SX:
        return x.T @ p["M"] @ x


def with_network(env_id: str, horizon: int, seed: int = 0) -> MPC:
    mpc = nominal_mpc(env_id)
    W, x_ref = 0.1 * np.eye(mpc.nx), mpc.values["terminal_cost.x_ref"]
    cost = NetworkCost.random(mpc.nx, (12, 12), seed=seed, std=np.full(mpc.nx, 0.5), scale=10.0, W=W, x_ref=x_ref)
    return mpc.replace(horizon=horizon, discount=0.95, terminal_cost=cost)


def agree(mpc: MPC, x: np.ndarray) -> None:
    """Solved, as good as ipopt's best of three starts, and from ipopt's minimum it finds the same."""
    ours, theirs = DDPSolver(mpc).solve(x), IpoptSolver(mpc, n_starts=3).solve(x)
    np.testing.assert_allclose(ours.value, simulated(mpc, x, ours.u)[1], rtol=1e-8, atol=1e-8)
    gradient = projected_gradient(mpc, ours) / np.sqrt(1.0 + np.abs(ours.value))
    assert ours.success.mean() >= 0.95
    assert (gradient[ours.success] < 2e-3).all()
    scale = 1.0 + np.abs(theirs.value)
    assert (ours.value <= theirs.value + 1e-5 * scale)[theirs.success].mean() >= 0.9
    # From ipopt's minimum it does not move: to it, too, that is one.
    stays = DDPSolver(mpc).solve(x, warm_start=theirs)
    same = np.abs(stays.value - theirs.value) <= 1e-6 * scale
    assert same[theirs.success].all()
    np.testing.assert_allclose(stays.u0[same], theirs.u0[same], rtol=0, atol=1e-3)


@pytest.mark.parametrize(("env_id", "horizon"), [(PENDULUM, 10), (CARTPOLE, 10), (CARTPOLE, 1)])
def test_a_network_as_terminal_cost(env_id: str, horizon: int) -> None:
    agree(with_network(env_id, horizon), random_states(env_id, 12))


@pytest.mark.parametrize("nu", [1, 2])
def test_a_lifted_quadratic_as_stage_cost(nu: int) -> None:
    for seed in range(3):
        mpc = random_linear(seed, nx=3, nu=nu, horizon=8, stage_cost=LiftedCost(3, nu, seed))
        agree(mpc, np.random.default_rng(seed).normal(size=(10, 3)))


def test_both_at_once() -> None:
    cost = LiftedCost(3, 1, 5)
    mpc = random_linear(5, nx=3, nu=1, horizon=6, stage_cost=cost, terminal_cost=cost)
    agree(mpc, np.random.default_rng(0).normal(size=(10, 3)))


def test_a_saddle_ends_at_the_bounds() -> None:
    """A terminal cost that falls along one state: the minimum has its inputs on their bounds."""
    mpc = random_linear(0, nu=2, horizon=4, terminal_cost=Saddle(np.diag([-30.0, 1.0, 1.0, 1.0])))
    x = np.random.default_rng(0).normal(size=(20, 4))
    solution = DDPSolver(mpc).solve(x)
    assert solution.success.all()
    assert ((solution.u <= mpc.action_low) | (solution.u >= mpc.action_high)).mean() > 0.5
    theirs = IpoptSolver(mpc).solve(x)
    assert (solution.value <= theirs.value + 1e-5 * (1.0 + np.abs(theirs.value))).mean() >= 0.9


def test_one_theta_and_a_theta_each_are_the_same_to_the_bit() -> None:
    """Cold, warm and alone: the neighbours in the lanes do not matter, of which some need the projection, some not."""
    mpc = with_network(PENDULUM, 8)
    solver, x = DDPSolver(mpc), random_states(PENDULUM, 11)
    each = np.tile(mpc.theta, (11, 1))
    cold = solver.solve(x)
    np.testing.assert_array_equal(solver.solve(x, each).u, cold.u)
    warm = solver.solve(x + 0.05, warm_start=cold)
    np.testing.assert_array_equal(solver.solve(x + 0.05, each, warm_start=cold).u, warm.u)
    for i in range(11):
        np.testing.assert_array_equal(solver.solve(x[i]).u, cold.u[i])
    other = mpc.with_theta(mpc.theta * np.random.default_rng(0).uniform(0.9, 1.0, mpc.space.size))
    each[::2] = other.theta
    mixed = solver.solve(x, each)
    np.testing.assert_array_equal(mixed.u[::2], solver.solve(x, other.theta).u[::2])
    np.testing.assert_array_equal(mixed.u[1::2], cold.u[1::2])


PROJECT = """
void project_lanes(double *H) { /* (LANES, NT) */
    vd lanes_of_H[NT];
    for (int j = 0; j < NT; ++j)
        for (int l = 0; l < LANES; ++l) lanes_of_H[j][l] = H[l * NT + j];
    project(NX, lanes_of_H);
    for (int j = 0; j < NT; ++j)
        for (int l = 0; l < LANES; ++l) H[l * NT + j] = lanes_of_H[j][l];
}
int n_lanes(void) { return LANES; }
"""


@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_the_projection_is_the_semidefinite_part(n: int) -> None:
    """Against numpy's eigenvalues: dense, diagonal, singular, repeated, badly scaled and definite matrices."""
    mpc = random_linear(0, nx=n, nu=1, terminal_cost=Saddle(-np.eye(n)))
    library = compiled(source(mpc) + PROJECT)
    lanes, rng = library.n_lanes(), np.random.default_rng(n)
    upper = np.triu_indices(n)
    order = np.lexsort((upper[0], upper[1]))  # column by column
    rows, columns = upper[0][order], upper[1][order]
    for trial in range(40):
        full = rng.normal(size=(lanes, n, n))
        full += full.transpose(0, 2, 1)
        full[0] = np.diag(rng.choice([-1.0, 0.0, 2.0], n))
        full[1] = (full[1] @ full[1] + np.eye(n)) if trial % 2 else np.zeros((n, n))
        full *= 10.0 ** rng.integers(-9, 9, size=(lanes, 1, 1))
        packed = np.ascontiguousarray(full[:, rows, columns])
        library.project_lanes(packed.ctypes.data_as(ctypes.POINTER(ctypes.c_double)))
        values, vectors = np.linalg.eigh(full)
        expected = np.einsum("bij,bj,bkj->bik", vectors, np.maximum(values, 0.0), vectors)
        size = np.abs(full).max(axis=(1, 2)) + 1e-300
        assert (np.abs(packed - expected[:, rows, columns]).max(axis=1) < 1e-12 * size).all()
        np.testing.assert_array_equal(packed[1], full[1, rows, columns])  # semidefinite: left as it is
