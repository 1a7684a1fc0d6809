"""CasADi functions as lists of instructions: bit for bit, and harmless whatever a file says."""

from __future__ import annotations

import copy
import json
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.envs import ENV_IDS
from mpcoffline.mpc.expressions import _BINARY, _UNARY, function_from_json, function_to_json, is_affine, traced
from mpcoffline.plants.nominal import nominal_mpc


def roundtrip(function: ca.Function) -> ca.Function:
    data = json.loads(json.dumps(function_to_json(function)))
    sizes = tuple(function.numel_in(i) for i in range(function.n_in()))
    return function_from_json(data, function.name(), inputs=sizes, output=function.numel_out(0))


def equal_bit_for_bit(left: ca.Function, right: ca.Function, n: int = 200) -> None:
    rng = np.random.default_rng(0)
    inputs = [rng.normal(size=(left.numel_in(i), n)) for i in range(left.n_in())]
    np.testing.assert_array_equal(left(*inputs).full(), right(*inputs).full())


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_tasks_roundtrip_bit_for_bit(env_id: str) -> None:
    mpc = nominal_mpc(env_id, seed=0)
    for function in (mpc.dynamics_function, mpc.stage_function, mpc.terminal_function):
        equal_bit_for_bit(function, roundtrip(function))


@pytest.mark.parametrize("name", [*_UNARY, *_BINARY])
def test_every_operation_roundtrips(name: str) -> None:
    x = ca.SX.sym("x", 2)
    op = getattr(ca, f"OP_{name.upper()}")
    y = ca.SX.unary(op, x[0]) if name in _UNARY else ca.SX.binary(op, x[0], x[1])
    equal_bit_for_bit(ca.Function("f", [x], [y]), roundtrip(ca.Function("f", [x], [y])))


def test_constants_that_json_has_no_numbers_for() -> None:
    x = ca.SX.sym("x", 1)
    function = ca.Function("f", [x], [ca.vertcat(ca.fmin(x, ca.inf), -ca.inf, 0.1, -0.0, 1e-320)])
    np.testing.assert_array_equal(roundtrip(function)(2.0).full(), function(2.0).full())
    json.dumps(function_to_json(function), allow_nan=False)


def test_sparse_and_constant_outputs() -> None:
    x = ca.SX.sym("x", 2)
    sparse = ca.Function("f", [x], [ca.SX(ca.Sparsity(3, 1))])
    equal_bit_for_bit(sparse, roundtrip(sparse))


def test_matrix_expressions_of_mx_are_expanded() -> None:
    x, u = ca.MX.sym("x", 3), ca.MX.sym("u", 2)
    function = ca.Function("f", [x, u], [ca.mtimes(ca.DM.rand(3, 3), ca.sin(x)) + ca.norm_2(u)])
    expanded = roundtrip(function)
    point = np.array([0.3, 0.1, -2.0]), np.array([1.0, 2.0])
    np.testing.assert_allclose(expanded(*point).full(), function(*point).full(), rtol=1e-14)


def test_functions_that_are_no_arithmetic_are_refused() -> None:
    x = ca.MX.sym("x")
    table = ca.interpolant("table", "linear", [[0.0, 1.0]], [0.0, 2.0])
    with pytest.raises(InvalidArgumentError, match="lookup: expected a function"):
        function_to_json(ca.Function("lookup", [x], [table(x)]))


def good() -> dict[str, Any]:
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 1)
    return function_to_json(ca.Function("f", [x, p], [ca.vertcat(ca.sin(x[0]) + 2.5 * p, x[1] * p)]))


def test_foreign_text_is_refused() -> None:
    """CasADi's serialisation of an external function would load a compiled library: it is never read."""
    x = ca.SX.sym("x", 2)
    for text in (ca.Function("f", [x], [x]).serialize(), "jhpn" * 10, "", None, 7, [], {}, [["external", "evil.so"]]):
        with pytest.raises(FileFormatError, match="model: expected a list of instructions"):
            function_from_json(text, "model", inputs=(2,))


@pytest.mark.parametrize(
    "instruction",
    [
        ["external", 0, 0],
        ["call", 0, 0],
        ["printme", 0, 0, 0],
        ["__import__", 0, 0],
        [12, 0, 0],
        [["add"], 0, 0],
        ["sin", 0],
        ["sin", 0, 0, 0],
        ["add", 0, 0],
        ["add", 0, 0, 99],
        ["add", 0, 0, -1],
        ["input", 0, 0, 7],
        ["input", 0, 0, -1],
        ["input", 0, 9, 0],
        ["const", 0, "one"],
        ["const", 0, None],
        ["const", 0],
        ["output", 0, 99],
        [],
        None,
        "sin",
    ],
)
def test_damaged_instructions_are_refused(instruction: Any) -> None:
    data = good()
    data["instructions"].insert(3, instruction)
    with pytest.raises(FileFormatError, match="f: expected a list of instructions"):
        function_from_json(data, "f", inputs=(2, 1))


@pytest.mark.parametrize(
    "change",
    [{"inputs": [2]}, {"inputs": [3, 1]}, {"output": 3}, {"output": "two"}, {"inputs": None}, {"instructions": None}],
)
def test_other_sizes_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(FileFormatError):
        function_from_json(good() | change, "f", inputs=(2, 1), output=2)


def test_every_truncation_is_refused() -> None:
    data = good()
    for length in range(len(data["instructions"])):
        cut = copy.deepcopy(data)
        cut["instructions"] = cut["instructions"][:length]
        with pytest.raises(FileFormatError):
            function_from_json(cut, "f", inputs=(2, 1), output=2)


def test_lost_expressions_are_refused() -> None:
    x = ca.SX.sym("x")
    with pytest.raises(InvalidArgumentError, match=r"dynamics.*constant NaN.*math\.sin"):
        traced("dynamics", ca.Function("f", [x], [x + ca.SX(float("nan"))]))


@pytest.mark.parametrize(
    ("expression", "affine"),
    [
        (lambda x, u, p: p[0] ** 2 * x[0] - u[0] * ca.sin(p[1]) + ca.sign(p[0]), True),
        (lambda x, u, p: x[0] * u[0], False),
        (lambda x, u, p: x[0] + ca.sign(x[1]), False),
        (lambda x, u, p: x[0] + ca.floor(u[0]), False),
        (lambda x, u, p: ca.if_else(x[0] > 1.0, x[0], x[0] + 1.0), False),
        (lambda x, u, p: ca.if_else(p[0] > 1.0, x[0], u[0]), True),
    ],
)
def test_steps_are_not_affine(expression: Any, affine: bool) -> None:
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)
    assert is_affine(ca.Function("f", [x, u, p], [expression(x, u, p)])) is affine
