"""Functions with rounded corners: near the functions, with slopes everywhere, in any units."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest

from mpcoffline.mpc import MPC, Model, NormCost, QuadraticCost
from mpcoffline.mpc.corners import rounded, rounded_mpc

CORNERS: dict[str, Callable[[ca.SX], ca.SX]] = {
    "fmax": lambda x: ca.fmax(x, 0.2),
    "fmin": lambda x: ca.fmin(1.0, 3 * x),
    "fabs": ca.fabs,
    "if_else": lambda x: ca.if_else(x > 0.3, x - 0.3, ca.if_else(x < -0.3, x + 0.3, 0)),
    "pow": lambda x: ca.fmax(x, 0) ** 0.8,
    "sqrt": lambda x: ca.sqrt(ca.fabs(x)),
    "and": lambda x: ca.if_else(ca.logic_and(x > -1, x <= 1), x, ca.sign(x)),
    "or": lambda x: ca.if_else(ca.logic_or(x < -0.5, x > 0.5), ca.fabs(x) - 0.5, 0),
}


def function(name: str) -> ca.Function:
    x, theta = ca.SX.sym("x"), ca.SX.sym("theta", 0)
    return ca.Function("f", [x, theta], [CORNERS[name](x)])


@pytest.mark.parametrize("name", CORNERS)
def test_they_are_the_functions_but_near_the_corners(name: str) -> None:
    exact, points = function(name), np.linspace(-2, 2, 401)[None]
    errors = []
    for share in (1e-2, 1e-4):
        smooth, corners = rounded(exact, [points, np.zeros(0)], share)
        assert {corner.name for corner in corners}
        errors.append(np.abs(smooth(points, []).full() - exact(points, []).full()).max())
        x = ca.SX.sym("x")
        slope = ca.Function("d", [x], [ca.jacobian(smooth(x, ca.SX(0, 1)), x)])
        assert np.isfinite(slope(points).full()).all()
    assert errors[0] < (0.2 if name == "sqrt" else 0.15)
    assert errors[1] < 0.1 * errors[0] + 1e-12 or errors[1] < 0.02  # sqrt's own error goes with the root of the width


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("name", ["fmax", "fabs", "if_else"])
def test_widths_follow_the_unit(name: str, unit: float) -> None:
    x, theta = ca.SX.sym("x"), ca.SX.sym("theta", 0)
    scaled = ca.Function("f", [x, theta], [unit * CORNERS[name](x / unit)])
    points = np.linspace(-2, 2, 101)[None]
    smooth, _ = rounded(function(name), [points, np.zeros(0)], 1e-2)
    in_unit, _ = rounded(scaled, [unit * points, np.zeros(0)], 1e-2)
    given, expected = in_unit(unit * points, []).full(), unit * smooth(points, []).full()
    np.testing.assert_allclose(given, expected, rtol=1e-9, atol=1e-12 * unit)


@pytest.mark.parametrize(
    "expression",
    [
        lambda x, p: ca.sqrt(1 + x**2),
        lambda x, p: (ca.sumsqr(x) + p[0] ** 2) ** 0.5,
        lambda x, p: ca.fmax(p[0], p[1]) * x + x**3,
        lambda x, p: x**2 + ca.exp(x) ** 0.5,
        lambda x, p: ca.tanh(x) / (1 + x * x),
    ],
)
def test_what_has_no_corner_stays_as_it_is(expression: Callable[[ca.SX, ca.SX], ca.SX]) -> None:
    x, p = ca.SX.sym("x"), ca.SX.sym("p", 2)
    given = ca.Function("f", [x, p], [expression(x, p)])
    smooth, corners = rounded(given, [np.linspace(-2, 2, 101)[None], np.array([0.1, 0.3])], 1e-2)
    assert smooth is given
    assert not corners


class PriceOfUse(QuadraticCost):
    """A quadratic cost, and a price of each unit of input, whichever way."""

    def expression(self, x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:  # type: ignore[override]
        return super().expression(x, u, p) + 0.3 * ca.sum1(ca.fabs(u))


def problem() -> MPC:
    def ode(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return ca.vertcat(x[1], p["k"] * ca.fmax(u[0], 0) ** 0.8 - x[1])

    model, cost = Model(ode, 2, 1, 0.1, {"k": 2.0}), PriceOfUse(np.eye(2), [[0.1]], x_ref=[1.0, 0.0])
    return MPC(model, cost, NormCost([1.0, 0.0]), 10, 0.95, [0.0], [5.0])


def test_a_problem_keeps_its_parameters() -> None:
    mpc = problem()
    smooth, corners = rounded_mpc(mpc, 1e-3)
    assert {corner.name for corner in corners} == {"fmax", "pow", "fabs"}
    assert smooth.terminal_cost is mpc.terminal_cost  # its root has no corner
    np.testing.assert_array_equal(smooth.theta, mpc.theta)
    changed = mpc.with_values({"model.k": 1.5, "stage_cost.x_ref": [0.5, 0.1]}).theta
    x, u = [0.3, 0.2], [2.0]
    for name in ("dynamics_function", "stage_function"):
        for theta in (mpc.theta, changed):
            given, expected = (getattr(problem_, name)(x, u, theta).full() for problem_ in (smooth, mpc))
            np.testing.assert_allclose(given, expected, rtol=2e-3)
