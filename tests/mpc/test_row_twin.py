"""Rows of arrays through numpy or torch, against CasADi point by point."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc.numpy_twin import NumpyTwin
from mpcoffline.mpc.row_twin import RowTwin, row_function
from mpcoffline.mpc.torch_twin import TorchTwin

Array = NDArray[np.float64]
RNG = np.random.default_rng(0)


def plain() -> ca.Function:
    """With a branch, a root of what may be negative, and a constant."""
    x, u, p = ca.SX.sym("x", 3), ca.SX.sym("u"), ca.SX.sym("p", 2)
    chosen = ca.if_else(x[0] > 0.0, ca.sqrt(x[0]) * p[0], x[1] ** 3)
    return ca.Function("plain", [x, u, p], [ca.vertcat(chosen, ca.sin(x[2] * u) / p[1], 2.0 * x[2], 5.0)])


def network() -> ca.Function:
    """Two hidden layers of 48, which are products of matrices."""
    x, u, p = ca.SX.sym("x", 3), ca.SX.sym("u"), ca.SX.sym("p", 2)
    z = ca.vertcat(x, u)
    for rows in (48, 48, 4):
        z = ca.tanh(ca.mtimes(ca.DM(RNG.normal(size=(rows, z.numel())) / 4.0), z) + ca.DM(RNG.normal(size=rows)))
    return ca.Function("network", [x, u, p], [z + p[0]])


def by_casadi(function: ca.Function, x: Array, u: Array, p: Array) -> Array:
    return np.array([np.asarray(function(*each)).ravel() for each in zip(x, u, p, strict=True)])


@pytest.mark.parametrize("make", [plain, network])
@pytest.mark.parametrize("count", [1, 7, 5_000])
def test_rows_are_what_casadi_gives_for_each(make: object, count: int) -> None:
    function = plain() if make is plain else network()
    twin, x, u = RowTwin(function), RNG.normal(size=(count, 3)), RNG.normal(size=(count, 1))
    p, one = RNG.uniform(1.0, 2.0, (count, 2)), np.array([1.5, 0.7])
    np.testing.assert_allclose(twin(x, u, p), by_casadi(function, x, u, p), rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(twin(x, u, one), twin(x, u, np.tile(one, (count, 1))))
    assert isinstance(twin._twin, TorchTwin if make is network else NumpyTwin)


def test_leading_dimensions_broadcast() -> None:
    """As members of an ensemble have it: parameters a member, states a member and start, inputs of all."""
    function, x, p = plain(), RNG.normal(size=(4, 9, 3)), RNG.uniform(1.0, 2.0, (4, 1, 2))
    u = RNG.normal(size=(9, 1))
    found = RowTwin(function)(x, u, p)
    assert found.shape == (4, 9, 4)
    for i in range(4):
        expected = by_casadi(function, x[i], u, np.tile(p[i], (9, 1)))
        np.testing.assert_allclose(found[i], expected, rtol=1e-12)


def test_no_rows_give_none() -> None:
    assert RowTwin(plain())(np.empty((0, 3)), np.empty((0, 1)), np.ones(2)).shape == (0, 4)


def test_an_unknown_operation_is_refused() -> None:
    x = ca.SX.sym("x")
    with pytest.raises(InvalidArgumentError, match="operation"):
        RowTwin(ca.Function("f", [x], [ca.erfinv(x)]))


def test_a_function_that_has_no_twin_is_evaluated_all_the_same() -> None:
    x = ca.MX.sym("x", 2)
    knots = [np.linspace(-1.0, 1.0, 5).tolist()]
    spline = ca.interpolant("spline", "bspline", knots, (np.linspace(-1.0, 1.0, 5) ** 3).tolist())
    function = ca.Function("own", [x], [ca.vertcat(spline(x[0]), x[1])])
    rows = RNG.uniform(-1.0, 1.0, (20, 2))
    evaluate = row_function(function)
    assert not isinstance(evaluate, RowTwin)
    np.testing.assert_allclose(evaluate(rows)[:, 0], rows[:, 0] ** 3, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(evaluate(rows)[:, 1], rows[:, 1])
    assert isinstance(row_function(plain()), RowTwin)
