"""(COST) and (TERM) of arXiv:2301.01667 against plain numpy."""

from __future__ import annotations

import json
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.mpc import NormCost, Parameter, QuadraticCost
from mpcoffline.mpc.component import cost_from_json

Array = NDArray[np.float64]


def random_psd(n: int, rank: int, rng: np.random.Generator) -> Array:
    G = rng.normal(size=(n, rank))
    return G @ G.T


def evaluate(cost: Any, x: Array, u: Array | None = None) -> float:
    """The cost at a point, through CasADi, with the current parameters."""
    sx, theta = ca.SX.sym("x", len(x)), ca.SX.sym("theta", cost.space.size)
    p = cost.space.symbols(theta)
    if u is None:
        return float(ca.Function("T", [sx, theta], [cost.terminal_expression(sx, p)])(x, cost.space.theta))
    su = ca.SX.sym("u", len(u))
    return float(ca.Function("L", [sx, su, theta], [cost.expression(sx, su, p)])(x, u, cost.space.theta))


@given(st.integers(1, 4), st.integers(1, 3), st.booleans(), st.booleans(), st.integers(0, 2**31))
def test_quadratic_form(nx: int, nu: int, cross: bool, singular: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = nx + nu
    H = random_psd(n, n - 1 if singular else n + 1, rng)
    W, R, S = H[:nx, :nx], H[nx:, nx:], H[:nx, nx:]
    x_ref, u_ref, constant = rng.normal(size=nx), rng.normal(size=nu), float(rng.normal())
    cost = QuadraticCost(W, R, S if cross else None, x_ref, u_ref, constant)
    for expected, given_matrix in ((W, cost.W), (R, cost.R), (S if cross else np.zeros_like(S), cost.S)):
        np.testing.assert_allclose(given_matrix, expected, rtol=0, atol=1e-12 * np.abs(H).max())
    x, u = rng.normal(size=nx), rng.normal(size=nu)
    e, v = x - x_ref, u - u_ref
    stage = e @ W @ e + v @ R @ v + constant + (2 * e @ S @ v if cross else 0.0)
    size = 1.0 + np.abs(H).sum() * (e @ e + v @ v)  # size of the terms that cancel
    assert evaluate(cost, x, u) == pytest.approx(stage, abs=1e-13 * size)
    assert evaluate(cost, x) == pytest.approx(e @ W @ e + constant, abs=1e-13 * size)


def test_without_input_weight() -> None:
    cost = QuadraticCost(np.diag([1.0, 2.0]))
    assert [block.name for block in cost.space] == ["W", "x_ref", "constant"]
    assert evaluate(cost, np.array([1.0, 3.0])) == pytest.approx(19.0)
    assert cost.R.shape == (0, 0)


def test_parameters_and_their_groups() -> None:
    apart = QuadraticCost(np.eye(2), np.eye(1))
    assert {block.name: block.group for block in apart.space} == {
        "W": "cost",
        "R": "cost",
        "constant": "cost",
        "x_ref": "reference",
        "u_ref": "reference",
    }
    together = QuadraticCost(np.eye(2), np.eye(1), np.zeros((2, 1)))
    assert "H" in together.values
    assert together.values["H"].shape == (3, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"W": [[1.0, 1.0], [0.0, 1.0]], "R": [[1.0]]}, "W: expected a symmetric matrix"),
        ({"W": -np.eye(2), "R": [[1.0]]}, "W: expected a positive semidefinite matrix"),
        ({"W": np.eye(2), "R": [[-1.0]]}, "R: expected a positive semidefinite matrix"),
        ({"W": np.eye(2), "R": [1.0, 2.0]}, "R: expected a square matrix"),
        ({"W": np.ones((2, 3)), "R": [[1.0]]}, "W: expected a square matrix"),
        ({"W": np.eye(2), "R": [[1.0]], "S": [[2.0], [0.0]]}, "H: expected a positive semidefinite matrix"),
        ({"W": np.eye(2), "R": [[1.0]], "S": [[0.0, 0.0]]}, r"S: expected shape \(2, 1\), got shape \(1, 2\)"),
        ({"W": np.ones((2, 3)), "R": [[1.0]], "S": [[0.0], [0.0]]}, "W: expected a square matrix"),
        ({"W": np.eye(2), "S": [[0.0], [0.0]]}, "R: expected a matrix, as S, D or u_ref is given"),
        ({"W": np.eye(2), "u_ref": [0.0]}, "R: expected a matrix"),
        ({"W": np.eye(2), "x_ref": [0.0]}, r"x_ref: expected shape \(2,\), got shape \(1,\)"),
        ({"W": np.eye(2), "R": [[1.0]], "u_ref": [0.0, 0.0]}, r"u_ref: expected shape \(1,\)"),
        ({"W": [[np.nan]]}, "W: expected finite entries"),
        ({"W": np.eye(2), "x_ref": [0.0, np.nan]}, "finite numbers"),
        ({"W": np.eye(2), "constant": np.inf}, "finite numbers"),
        ({"W": np.eye(2), "constant": Parameter(1.0)}, "constant: expected a number or numbers, got Parameter.*Model"),
        ({"W": np.eye(2), "constant": [1.0, 2.0]}, "constant: expected one number, got shape"),
        ({"W": Parameter(np.eye(2))}, "W: expected a number or numbers, got Parameter"),
        ({"W": np.eye(2), "R": "heavy"}, "R: expected a number or numbers, got 'heavy'"),
        ({"W": np.eye(2), "x_ref": {}}, "x_ref: expected a number or numbers"),
    ],
)
def test_quadratic_cost_refuses(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        QuadraticCost(**arguments)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=5), st.sampled_from([1e-3, 1e-2, 0.1, 1.0]))
def test_norm_cost_is_the_smoothed_norm(x: list[float], eps: float) -> None:
    """|e| - eps <= T <= |e|, and T = sqrt(|e|^2 + eps^2) - eps."""
    reference = np.ones(len(x))
    e = np.array(x) - reference
    norm = float(np.linalg.norm(e))
    value = evaluate(NormCost(reference, eps), np.array(x))
    slack = 1e-14 * (1 + norm)
    assert norm - eps - slack <= value <= norm + slack
    assert value == pytest.approx(np.hypot(norm, eps) - eps, abs=slack)


def test_norm_cost_limits() -> None:
    cost = NormCost([1.0, 2.0], eps=1e-9)
    assert evaluate(cost, np.array([1.0, 2.0])) == 0.0
    assert evaluate(cost, np.array([4.0, 6.0])) == pytest.approx(5.0, abs=2e-9)


@pytest.mark.parametrize("eps", [0.0, -1.0, np.nan, np.inf])
def test_norm_cost_refuses_eps(eps: float) -> None:
    with pytest.raises(InvalidArgumentError, match="eps: expected a positive number"):
        NormCost([0.0], eps)


@pytest.mark.parametrize(
    "cost",
    [
        QuadraticCost(np.eye(2)),
        QuadraticCost(np.diag([1.0, 0.1]), [[0.3]], x_ref=[1.0, 0.0], constant=0.1),
        QuadraticCost(np.eye(2), [[1.0]], [[0.1], [0.2]]),
        NormCost([1.0, 0.3], eps=0.07),
    ],
    ids=["W", "WR", "H", "norm"],
)
def test_json_roundtrip_bit_for_bit(cost: Any) -> None:
    again = cost_from_json(json.loads(json.dumps(cost.to_json())))
    assert type(again) is type(cost)
    assert again.to_json() == cost.to_json()
    x = np.array([0.4, -0.7])
    assert evaluate(again, x) == evaluate(cost, x)
    assert again.nx == cost.nx


@pytest.mark.parametrize("data", [{}, {"kind": "CubicCost"}, {"kind": ["x"]}])
def test_unknown_kind_is_refused(data: dict[str, Any]) -> None:
    with pytest.raises(FileFormatError, match=r"cost: expected a cost that is known here \(Quadratic"):
        cost_from_json(data)


def test_with_theta_makes_another_cost() -> None:
    cost = QuadraticCost(np.eye(2), [[1.0]])
    other = cost.with_theta(cost.space.pack({"W": 4 * np.eye(2)}))
    np.testing.assert_allclose(other.W, 4 * np.eye(2))
    np.testing.assert_allclose(cost.W, np.eye(2))
