"""Exact penalties in place of hard limits: the same solutions where they can be kept, solved where they cannot."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC, Constraint, Model, Penalty, QuadraticCost, StateBounds
from mpcoffline.solvers import DDPSolver, softened

STATES = np.random.default_rng(0).uniform([-1.5, -0.3], [1.5, 0.3], (8, 2))


def limited(cost: float = 1.0, size: float = 1.0) -> MPC:
    """A double integrator with a bounded speed, a valve, and a soft limit; costs and the first limit in units."""

    def step(x: Any, u: Any, p: Any) -> Any:
        return ca.vertcat(x[0] + 0.5 * x[1], x[1] + 0.5 * u[0])

    return MPC(
        Model(step, 2, 1, 0.5, discrete=True),
        QuadraticCost(cost * np.diag([1.0, 0.1]), [[0.1 * cost]]),
        QuadraticCost(2.0 * cost * np.eye(2)),
        horizon=6,
        discount=0.95,
        action_low=[-2.0],
        action_high=[2.0],
        constraints=[
            StateBounds([-9.0, -9.0], [9.0, 9.0], "room"),
            Constraint(lambda x, u, p: size * ca.vertcat(x[1] - 0.4, -x[1] - 0.4), "speed"),
            Constraint(lambda x, u, p: u - 1.5, "valve"),
            Constraint(lambda x, u, p: x[0] - 2.0, "soft", Penalty(l2=1.0)),
        ],
    )


def test_solutions_that_keep_limits_stay() -> None:
    mpc = limited()
    soft = softened(mpc, STATES)
    kinds = {c.name: c.soft for c in soft.constraints}
    assert list(kinds) == ["room", "speed", "valve", "soft"]
    assert kinds["valve"] is None
    assert kinds["soft"] == Penalty(l2=1.0)
    assert kinds["speed"].l1 > 0.0
    hard, changed = DDPSolver(mpc).solve(STATES), DDPSolver(soft).solve(STATES)
    assert hard.success.sum() >= 4
    good = hard.success
    np.testing.assert_allclose(changed.value[good], hard.value[good], rtol=1e-5)
    np.testing.assert_allclose(changed.u[good], hard.u[good], atol=1e-3)


def test_what_cannot_be_kept_is_solved() -> None:
    """Full braking brings a speed of 2 to 1 in a step, which is over the limit of 0.4, and on to it in the next."""
    mpc, start = limited(), [-3.0, 2.0]
    assert not DDPSolver(mpc).solve(start).success
    solution = DDPSolver(softened(mpc, STATES)).solve(start)
    assert solution.success
    np.testing.assert_allclose(solution.x[1:3, 1], [1.0, 0.4], atol=1e-3)


def test_prices_follow_units() -> None:
    """In the unit of the cost over that of the limit."""
    plain, other = (softened(limited(*units), STATES) for units in ((1.0, 1.0), (1e3, 1e-2)))
    price, scaled = (next(c.soft.l1 for c in mpc.constraints if c.name == "speed") for mpc in (plain, other))
    assert scaled == pytest.approx(1e5 * price, rel=1e-3)


def test_nothing_to_soften_and_nothing_to_ask() -> None:
    valve = limited().replace(constraints=[Constraint(lambda x, u, p: u - 1.5, "valve")])
    assert softened(valve, STATES) is valve
    assert softened(limited().replace(constraints=None), STATES).constraints is None
    with pytest.raises(InvalidArgumentError, match="x"):
        softened(limited(), np.ones((3, 5)))
