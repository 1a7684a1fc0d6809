"""Regressions with norms against costs that are some."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import scipy.optimize

from mpcoffline.estimation.norms import _Projected, fit_norms
from mpcoffline.simulation.cost_regression import cost_regressions

RNG = np.random.default_rng(0)
X = RNG.uniform(-1.0, 1.0, (2_000, 5))
FOLDS = np.arange(2_000) // 50 % 5


def distance(x: np.ndarray) -> np.ndarray:
    return np.hypot(x[:, 0] - 0.2, x[:, 1] + x[:, 2]) + 0.1 * x[:, 4] ** 2


def absolute(x: np.ndarray) -> np.ndarray:
    return np.abs(x[:, 0]) + 2.0 * np.abs(x[:, 1] - 0.3 * x[:, 3]) + 0.5 * x[:, 4] ** 2


@pytest.mark.parametrize("cost", [distance, absolute])
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-6, 3.0), (1e4, -50.0)])
def test_a_distance_and_absolute_errors_are_found(cost: object, scale: float, offset: float) -> None:
    """To a hundredth of the cost's spread at the kink, in any unit of cost and of what is measured."""
    y = offset + scale * cost(X)  # type: ignore[operator]
    units = np.array([1e3, 1.0, 1.0, 1e-3, 1.0])
    found = cost_regressions(X * units, y, FOLDS, 0)
    assert [r.name for r in found[:2]] == ["a quadratic with norms"] * 2
    assert found[0].error < 1e-4
    goal = np.array([[0.2, 0.5, -0.5, 0.3, 0.0]]) if cost is distance else np.zeros((1, 5))
    assert abs(found[0](goal * units)[0] - offset) < 0.02 * scale
    assert abs(found[-1](goal * units)[0] - offset) > 0.1 * scale  # what a quadratic makes of it


def test_noise_on_a_quadratic_is_no_norm() -> None:
    y = (X**2).sum(axis=1) + 0.3 * RNG.normal(size=len(X))
    assert cost_regressions(X, y, FOLDS, 0)[0].name == "a quadratic"


def test_the_error_has_the_gradient_it_says() -> None:
    problem = _Projected(np.hstack([np.ones((60, 1)), X[:60]]), X[:60], distance(X[:60]))
    problem.begun(np.random.default_rng(1).normal(size=(2, 3, 5)), np.random.default_rng(1))
    p = np.random.default_rng(2).normal(size=2 * 3 * 5 + 2 * 3 + 2)
    assert scipy.optimize.check_grad(lambda q: problem._error(q)[0], lambda q: problem._error(q)[1], p) < 1e-6


def test_the_same_seed_gives_the_same_numbers() -> None:
    data = X[:500], distance(X[:500])
    first, again = (fit_norms(data, data, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first(X), again(X))


def test_absolute_errors_of_each_coordinate_are_found() -> None:
    """More of them than norms are looked for at random."""
    weights = np.array([1.0, 3.0, 0.5, 2.0, 0.1])
    y = np.abs(X) @ weights
    y = (y - y.mean()) / y.std()
    norms = fit_norms((X[:1_000], y[:1_000]), (X[1_000:1_500], y[1_000:1_500]), np.random.default_rng(0))
    assert np.mean((norms(X[1_500:]) - y[1_500:]) ** 2) < 1e-7


def test_the_expression_is_the_function() -> None:
    y = np.hypot(X[:, 0], X[:, 1]) - 0.1 * X[:, 4] ** 2
    y = (y - y.mean()) / y.std()
    norms = fit_norms((X[:1_000], y[:1_000]), (X[1_000:], y[1_000:]), np.random.default_rng(0))
    x = ca.SX.sym("x", 5)
    same = ca.Function("L", [x], [norms.expression(x, 0.0 * norms.sizes(X))])
    np.testing.assert_allclose(same(X.T).full().ravel(), norms(X), atol=1e-9)
    blunt = ca.Function("L", [x], [norms.expression(x, 0.1 * norms.sizes(X))])(X.T).full().ravel()
    assert 1e-3 < np.abs(blunt - norms(X)).max() < 0.3  # at the kink alone
