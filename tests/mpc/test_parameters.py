"""theta: packing, bounds, and positive semidefinite blocks by their factor."""

from __future__ import annotations

import json

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, UnknownIdError
from mpcoffline.mpc.parameters import Block, Parameter, ParameterSpace
from mpcoffline.mpc.psd import psd_factor

Array = NDArray[np.float64]
numbers = st.floats(-1e3, 1e3)


@st.composite
def factors(draw: st.DrawFn) -> Array:
    """Matrices (n, k), k <= n: G G' is a PSD matrix of rank at most k, singular for k < n."""
    n = draw(st.integers(1, 5))
    k = draw(st.integers(0, n))
    return draw(arrays(np.float64, (n, k), elements=st.floats(-10.0, 10.0)))


@given(factors())
def test_psd_factor_reproduces_the_matrix(G: Array) -> None:
    matrix = G @ G.T
    C = psd_factor(matrix)
    assert (np.triu(C, 1) == 0).all()
    assert (np.diag(C) >= 0).all()
    # Eigenvalues and QR are backward stable: an error of order n eps |matrix|.
    np.testing.assert_allclose(C @ C.T, matrix, rtol=0, atol=1e-13 * max(1.0, np.abs(matrix).max()))


@given(factors())
def test_psd_block_roundtrip(G: Array) -> None:
    matrix = G @ G.T
    block = Block.psd("W", matrix, "cost")
    scale = max(1.0, np.abs(matrix).max())
    np.testing.assert_allclose(block.value, matrix, rtol=0, atol=1e-13 * scale)
    again = block.natural(block.coordinates(block.value))
    np.testing.assert_allclose(again, block.value, rtol=0, atol=1e-12 * scale)
    assert ((block.theta >= block.low) & (block.theta <= block.high)).all()


@given(st.integers(1, 4), st.data())
def test_every_theta_of_a_psd_block_is_psd(n: int, data: st.DataObject) -> None:
    theta = data.draw(arrays(np.float64, n * (n + 1) // 2, elements=st.floats(-10, 10)))
    matrix = Block.psd("W", np.eye(n), "cost").natural(theta)
    assert (matrix == matrix.T).all()
    assert np.linalg.eigvalsh(matrix)[0] >= -1e-12 * max(1.0, np.abs(matrix).max())


@pytest.mark.parametrize("name", ["zero", "ones", "tiny"])
def test_singular_matrices(name: str) -> None:
    matrix = {"zero": np.zeros((3, 3)), "ones": np.ones((3, 3)), "tiny": np.diag([1.0, 1e-300, 0.0])}[name]
    C = psd_factor(matrix)
    np.testing.assert_allclose(C @ C.T, matrix, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[1.0, 0.5], [0.0, 1.0]], "a symmetric matrix, got entries that differ from their mirror by 0.5"),
        ([[1.0, 2.0], [2.0, 1.0]], "a positive semidefinite matrix, got smallest eigenvalue -1"),
        ([[1.0, 0.0]], r"a square matrix, got shape \(1, 2\)"),
        ([[np.nan]], "finite entries"),
        ([[np.inf]], "finite entries"),
    ],
)
def test_psd_factor_refuses(matrix: list[list[float]], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=f"W: expected {message}"):
        psd_factor(np.array(matrix), "W")


@st.composite
def spaces(draw: st.DrawFn) -> tuple[ParameterSpace, dict[str, Array]]:
    """A space of a few blocks, and other values for some of them."""
    blocks, values = [], {}
    for i in range(draw(st.integers(1, 4))):
        name, kind = f"b{i}", draw(st.sampled_from(["scalar", "vector", "matrix", "psd"]))
        n, m = draw(st.integers(1, 3)), draw(st.integers(1, 3))
        shape = {"scalar": (), "vector": (n,), "matrix": (n, m), "psd": (n, n)}[kind]
        if kind == "psd":
            factor = draw(arrays(np.float64, shape, elements=st.floats(-3, 3)))
            blocks.append(Block.psd(name, np.eye(n), "cost"))
            value = factor @ factor.T
        else:
            blocks.append(Block.free(name, draw(arrays(np.float64, shape, elements=numbers)), "model"))
            value = draw(arrays(np.float64, shape, elements=numbers))
        if draw(st.booleans()):
            values[name] = value
    return ParameterSpace(blocks), values


@given(spaces())
def test_pack_unpack_roundtrip(case: tuple[ParameterSpace, dict[str, Array]]) -> None:
    space, values = case
    theta = space.pack(values)
    assert theta.shape == (space.size,) == (len(space.names),)
    unpacked = space.unpack(theta)
    for block in space:
        expected = values.get(block.name, block.value)
        assert unpacked[block.name].shape == block.shape
        np.testing.assert_allclose(unpacked[block.name], expected, rtol=1e-12, atol=1e-11)
    np.testing.assert_array_equal(space.with_theta(theta).theta, theta)


@given(spaces())
def test_free_blocks_roundtrip_bit_for_bit(case: tuple[ParameterSpace, dict[str, Array]]) -> None:
    space, values = case
    unpacked = space.unpack(space.pack(values))
    for block in space:
        if block.kind == "free":
            np.testing.assert_array_equal(unpacked[block.name], values.get(block.name, block.value))


@given(spaces())
def test_json_roundtrip_bit_for_bit(case: tuple[ParameterSpace, dict[str, Array]]) -> None:
    for block in case[0]:
        again = Block.from_json(json.loads(json.dumps(block.to_json())))
        assert (again.name, again.shape, again.kind, again.group) == (block.name, block.shape, block.kind, block.group)
        for name in ("theta", "low", "high"):
            np.testing.assert_array_equal(getattr(again, name), getattr(block, name))


@given(spaces(), st.integers(0, 2**31))
def test_symbols_equal_numbers(case: tuple[ParameterSpace, dict[str, Array]], seed: int) -> None:
    """CasADi is column-major, numpy row-major; a PSD block enters CasADi as its factor."""
    space, values = case
    theta = space.pack(values)
    symbol = ca.SX.sym("theta", space.size)
    for name, expression in space.symbols(symbol).items():
        block = next(b for b in space if b.name == name)
        matrix = ca.Function("f", [symbol], [ca.densify(expression)])(theta).full()
        if block.kind == "psd":
            matrix = matrix @ matrix.T
        np.testing.assert_array_equal(matrix.reshape(block.shape), block.natural(theta[space.slices[name]]))


def test_row_major_order_and_names() -> None:
    space = ParameterSpace(
        [
            Block.free("A", [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], "model"),
            Block.free("m", 7.0, "model"),
            Block.psd("W", [[4.0, 2.0], [2.0, 10.0]], "cost"),
            Block.free("v", [8.0, 9.0], "reference"),
        ]
    )
    # [[4, 2], [2, 10]] = C C' with C = [[2, 0], [1, 3]].
    np.testing.assert_allclose(space.theta, [1, 2, 3, 4, 5, 6, 7, 2, 1, 3, 8, 9], rtol=1e-15)
    assert space.names == [
        *("A[0,0]", "A[0,1]", "A[0,2]", "A[1,0]", "A[1,1]", "A[1,2]"),
        *("m", "W[0,0]", "W[1,0]", "W[1,1]", "v[0]", "v[1]"),
    ]
    assert space.mask(["cost"]).tolist() == [False] * 7 + [True] * 3 + [False] * 2
    assert space.mask([]).sum() == 0
    np.testing.assert_array_equal(space.low, [-np.inf] * 7 + [0.0, -np.inf, 0.0] + [-np.inf] * 2)


def test_the_empty_space() -> None:
    space = ParameterSpace([])
    assert space.size == 0
    assert space.theta.shape == space.low.shape == space.high.shape == space.mask(["cost"]).shape == (0,)
    assert space.pack({}).shape == (0,)


def test_bounds_are_kept_and_checked() -> None:
    space = ParameterSpace([Block.free("m", Parameter([1.0, 2.0], low=[0.5, 1.0], high=4.0, unit="kg"), "model")])
    np.testing.assert_array_equal(space.low, [0.5, 1.0])
    np.testing.assert_array_equal(space.high, [4.0, 4.0])
    np.testing.assert_array_equal(space.checked([0.5, 4.0]), [0.5, 4.0])
    with pytest.raises(InvalidArgumentError, match=r"theta\[1\] \(m\[1\]\): expected a finite number from 1.0 to 4.0"):
        space.checked([1.0, 0.9])
    with pytest.raises(InvalidArgumentError, match=r"theta\[0\]"):
        space.checked([np.nan, 2.0])
    with pytest.raises(InvalidArgumentError, match=r"expected shape \(2,\), got shape \(3,\)"):
        space.checked([1.0, 2.0, 3.0])
    with pytest.raises(InvalidArgumentError, match=r"m\[0\]"):
        space.pack({"m": [5.0, 2.0]})


def test_pack_refuses() -> None:
    space = ParameterSpace([Block.free("mass", 1.0, "model"), Block.psd("W", np.eye(2), "cost")])
    with pytest.raises(UnknownIdError, match="Did you mean 'mass'"):
        space.pack({"mas": 2.0})
    with pytest.raises(InvalidArgumentError, match=r"W: expected shape \(2, 2\), got shape \(3, 3\)"):
        space.pack({"W": np.eye(3)})
    with pytest.raises(InvalidArgumentError, match="positive semidefinite"):
        space.pack({"W": -np.eye(2)})


def test_names_must_be_unique() -> None:
    with pytest.raises(InvalidArgumentError, match="m twice"):
        ParameterSpace([Block.free("m", 1.0, "model"), Block.free("m", 2.0, "model")])


@pytest.mark.parametrize(
    "arguments",
    [{"value": np.nan}, {"value": 0.0, "low": 1.0}, {"value": 2.0, "high": 1.0}, {"value": np.zeros((1, 1, 1))}],
)
def test_parameter_refuses(arguments: dict[str, float]) -> None:
    with pytest.raises(InvalidArgumentError, match="Parameter value"):
        Parameter(**arguments)


@pytest.mark.parametrize(
    "damage",
    [
        {"theta": [1.0]},
        {"low": [None]},
        {"kind": "round"},
        {"shape": [3, 3]},
        {"shape": [2, 3]},
        {"theta": [1.0, 0.0, float("nan")]},
        {"theta": [-1.0, 0.0, 1.0]},
    ],
)
def test_damaged_json_is_refused(damage: dict[str, object]) -> None:
    data = Block.psd("W", np.eye(2), "cost").to_json() | damage
    with pytest.raises(FileFormatError, match="parameter W"):
        Block.from_json(data)


def test_values_handed_out_are_copies() -> None:
    space = ParameterSpace([Block.free("v", [1.0, 2.0], "model")])
    space.theta[:] = 9.0
    space[0].value[:] = 9.0
    space.unpack(space.theta)["v"][:] = 9.0
    np.testing.assert_array_equal(space.theta, [1.0, 2.0])


def test_the_space_names_its_blocks() -> None:
    space = ParameterSpace([Block.free("A", np.eye(2), "model"), Block.free("b", 1.0, "model")])
    assert repr(space) == "ParameterSpace(A, b; size 5)"
