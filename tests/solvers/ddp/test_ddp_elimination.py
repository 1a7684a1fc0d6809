"""Jacobians by elimination against CasADi's own, and against fewer operations than CasADi's."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mpcoffline.envs import ENV_IDS
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers.ddp.elimination import value_and_jacobian

UNARY = [ca.sin, ca.tanh, ca.exp, ca.fabs, lambda a: ca.sqrt(2.0 + a * a), lambda a: 1.0 / (1.5 + ca.cos(a)), ca.sumsqr]
BINARY = [
    lambda a, b: a + b,
    lambda a, b: a - b,
    lambda a, b: a * b,
    lambda a, b: a / (2.0 + b * b),
    ca.fmax,
    ca.atan2,
    lambda a, b: ca.if_else(a > b, a * b, 3.0 * b),
]


def both(expression: ca.SX, z: ca.SX, theta: ca.SX) -> tuple[ca.Function, ca.Function]:
    """Value and Jacobian by elimination, and by CasADi."""
    theirs = [expression, ca.densify(ca.jacobian(expression, z))]
    ours = [ca.densify(part) for part in value_and_jacobian(expression, z, theta)]
    return ca.Function("ours", [z, theta], ours), ca.Function("theirs", [z, theta], theirs)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 13), st.integers(0, 99), st.integers(0, 99)), min_size=1, max_size=25))
def test_random_expressions(recipe: list[tuple[int, int, int]]) -> None:
    """Results of z, of theta alone, of constants, z itself, and the same one twice."""
    z, theta = ca.SX.sym("z", 3), ca.SX.sym("theta", 2)
    pool = [*ca.vertsplit(z), *ca.vertsplit(theta), ca.SX(0.7)]
    for kind, i, j in recipe:
        a, b = pool[i % len(pool)], pool[j % len(pool)]
        pool.append(UNARY[kind](a) if kind < len(UNARY) else BINARY[kind - len(UNARY)](a, b))
    expression = ca.vertcat(*pool[-4:], pool[-1], z[0], theta[1], 2.0)
    ours, theirs = both(expression, z, theta)
    rng = np.random.default_rng(0)
    for _ in range(3):
        point = rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 2)
        for mine, other in zip(ours(*point), theirs(*point), strict=True):
            expected = other.full()
            if np.isfinite(expected).all() and np.abs(expected).max() < 1e100:
                np.testing.assert_allclose(mine.full(), expected, rtol=1e-9, atol=1e-9 * (1 + np.abs(expected).max()))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_models_of_the_tasks(env_id: str) -> None:
    mpc = nominal_mpc(env_id)
    z, theta = ca.SX.sym("z", mpc.nx + mpc.nu), ca.SX.sym("theta", mpc.space.size)
    ours, theirs = both(mpc.dynamics_function(z[: mpc.nx], z[mpc.nx :], theta), z, theta)
    for point in np.random.default_rng(0).normal(size=(5, mpc.nx + mpc.nu)):
        for mine, other in zip(ours(point, mpc.theta), theirs(point, mpc.theta), strict=True):
            np.testing.assert_allclose(mine.full(), other.full(), rtol=1e-12, atol=1e-13)
    assert ours.n_instructions() <= theirs.n_instructions()
    if "CartPole" in env_id:
        assert ours.n_instructions() < 0.9 * theirs.n_instructions()
