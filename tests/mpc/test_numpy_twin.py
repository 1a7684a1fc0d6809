"""CasADi functions by numpy, against CasADi itself."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc.numpy_twin import _BINARY, _UNARY, NumpyTwin

TWO = [code for code in _BINARY if code != ca.OP_IF_ELSE_ZERO]


def compared(of: Any, x: Any, u: Any) -> None:
    symbols = ca.SX.sym("x", len(x)), ca.SX.sym("u", len(u))
    f = ca.Function("f", symbols, [of(*symbols)])
    np.testing.assert_allclose(NumpyTwin(f)(x, u), f(x, u).full(), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("code", [*_UNARY, ca.OP_TWICE])
def test_every_operation_of_one_number_is_casadis(code: int) -> None:
    x = np.random.default_rng(code).uniform(-2.0, 2.0, (1, 60))
    x[0, :3] = 0.0, np.inf, np.nan
    compared(lambda x, u: ca.SX.unary(code, x), x, x)


@pytest.mark.parametrize("code", TWO)
def test_every_operation_of_two_numbers_is_casadis(code: int) -> None:
    x, u = np.round(np.random.default_rng(code).uniform(-2.0, 2.0, (2, 1, 60)), 1)
    x[0, :3], u[0, 1:4] = (0.0, np.inf, np.nan), (0.0, 1.0, np.nan)
    compared(lambda x, u: ca.SX.binary(code, x, u), x, u)


@given(st.integers(0, 2**32 - 1))
def test_programs_are_casadis(seed: int) -> None:
    """Random ones, constants and branches among them, in which results are used again and again."""
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(2, 7)), rng.normal(size=(1, 7))

    def program(x: ca.SX, u: ca.SX) -> ca.SX:
        parts = [*ca.vertsplit(x), u, ca.SX(0.7)]
        for _ in range(12):
            a, b, c = (parts[int(k)] for k in rng.integers(len(parts), size=3))
            made = [
                a + b,
                a * b - c,
                ca.sin(a),
                ca.if_else(a > b, c, 1.0 / (b * b)),
                ca.fmax(a, 0.5),
                2.0 * a,
                ca.tanh(c),
            ]
            parts.append(made[int(rng.integers(len(made)))])
        return ca.vertcat(*parts[-4:], x[0], 3.0)

    compared(program, x, u)


def test_what_numpy_has_not_is_refused() -> None:
    x = ca.SX.sym("x")
    with pytest.raises(InvalidArgumentError, match="f: expected operations that numpy has"):
        NumpyTwin(ca.Function("f", [x], [ca.erfinv(x)]))
