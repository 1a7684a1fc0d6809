"""Costs that are linear in the states: ddp takes the curvature of the model, and finds what ipopt finds."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from hard_plants import Prices, reactor
from numpy.typing import NDArray

from mpcoffline import MPC, Model, make_solver


def fishery() -> MPC:
    """Harvest pays by the catch u x: bilinear, indefinite, best at the bounds."""

    class Catch(Prices):
        def expression(self, x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
            return -p["c"][0] * u[0] * x[0] + 0.1 * u[0]

    model = Model(lambda x, u, p: x * (1 - x) - u * x, 1, 1, 0.2)
    return MPC(model, Catch([1.0]), Prices([-1.0]), 15, 0.97, [0.0], [1.0])


def batch_reactor() -> MPC:
    """Growth that too much food inhibits, fed by the input."""

    def rates(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        growth = 0.5 * x[1] / (0.2 + x[1] + 0.5 * x[1] ** 2)
        return ca.vertcat(growth * x[0] - u[0] * x[0], -2 * growth * x[0] + u[0] * (2 - x[1]))

    return MPC(Model(rates, 2, 1, 0.2), Prices([-1.0, 0.0, 0.1]), Prices([-1.0, 0.0]), 20, 0.97, [0.0], [1.0])


def states(mpc: MPC, n: int) -> NDArray[np.float64]:
    return np.random.default_rng(1).uniform(0.1, 1.0, size=(n, mpc.nx))


@pytest.mark.parametrize("effort", [0.0, 1e-6, 1e-3, 1e-2])
def test_all_states_of_the_reactor_are_solved(effort: float) -> None:
    mpc = reactor(effort)
    solver, x = make_solver(mpc, "ddp"), states(mpc, 100)
    cold = solver.solve(x)
    assert cold.success.all()
    assert solver.solve(x + 0.001, warm_start=cold.plan.shifted()).success.all()
    inside = (cold.u > 1e-3) & (cold.u < 2.0 - 1e-3)
    assert inside.mean() > 0.1  # else the bounds alone would decide


@pytest.mark.slow
@pytest.mark.parametrize("make", [reactor, batch_reactor])
def test_the_values_are_ipopts_or_better(make: Callable[[], MPC]) -> None:
    mpc = make()
    x = states(mpc, 4)
    ddp, oracle = make_solver(mpc, "ddp").solve(x), make_solver(mpc, "ipopt").solve(x)
    assert ddp.success.all()
    assert (ddp.value <= oracle.value + 1e-6 * np.abs(oracle.value)).all()


@pytest.mark.parametrize("make", [reactor, fishery, batch_reactor])
def test_what_is_accepted_is_a_minimum(make: Callable[[], MPC]) -> None:
    """ipopt, started there, goes nowhere."""
    mpc = make()
    x = states(mpc, 5)
    found = make_solver(mpc, "ddp").solve(x)
    assert found.success.all()
    refined = make_solver(mpc, "ipopt").solve(x, warm_start=found.plan)
    np.testing.assert_allclose(found.value, refined.value, rtol=1e-6)


def test_a_linear_plant_with_prices_is_driven_at_its_bounds() -> None:
    """A linear programme: x+ = 0.9 x + u sold at 1, u bought at 5; worth it while the rest of the horizon pays."""
    N, gamma = 30, 0.98
    model = Model(lambda x, u, p: 0.9 * x + u, 1, 1, 1.0, discrete=True)
    mpc = MPC(model, Prices([-1.0, 5.0]), Prices([-1.0]), N, gamma, [0.0], [2.0])
    solution = make_solver(mpc, "ddp").solve([1.0])
    worth = [sum(gamma ** (j - k) * 0.9 ** (j - k - 1) for j in range(k + 1, N + 1)) for k in range(N)]
    assert solution.success
    np.testing.assert_allclose(solution.u[:, 0], np.where(np.array(worth) > 5.0, 2.0, 0.0), atol=1e-9)
