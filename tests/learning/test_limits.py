"""What soft limits cost: found in logged costs or added to them, seen by V, in their unit; limits that are learned."""

from __future__ import annotations

import dataclasses
from typing import Any

import lq_plant
import numpy as np
import pytest
from lq_episodes import episodes
from numpy.typing import NDArray
from riccati import optimum

from mpcoffline import OfflineMPCLearner, TransitionTable
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.learning.bellman.stages import Terminal, TerminalConfig, with_terminal_cost
from mpcoffline.learning.known_limits import limit_costs_of
from mpcoffline.learning.stages import Known, KnownCost
from mpcoffline.mpc import MPC, Constraint, Model, Parameter, Penalty, StateBounds
from mpcoffline.mpc.penalties import penalty_function, repriced
from mpcoffline.simulation.logged_cost import LoggedCost
from mpcoffline.solvers import DDPSolver

Array = NDArray[np.float64]

QUICK: dict[str, Any] = {"value_n_steps": 400, "fit_n_steps": 20, "hidden": (32,), "terminal": "quadratic", "seed": 0}
LOG = episodes(n=60, steps=30)
ROOM = StateBounds([-np.inf, -0.4], [0.5, np.inf], "room", Penalty(3.0, 10.0))


def limited(limit: Any = ROOM, **changes: Any) -> MPC:
    return lq_plant.make_mpc((lq_plant.A, lq_plant.B), constraints=limit, **changes)


def over(s: Array, most: float = 0.5) -> Array:
    """What ROOM is violated by, a column each."""
    return np.maximum(np.column_stack([s[:, 0] - most, -0.4 - s[:, 1]]), 0.0)


def price(s: Array) -> Array:
    return np.asarray((3.0 * over(s) + 10.0 * over(s) ** 2).sum(axis=1))


def paid(unit: float = 1.0, *, limits: Array | float = 0.0) -> TransitionTable:
    """The log with other costs, and what limits cost in them."""
    columns = LOG.values()
    costs = unit * (columns.costs + limits)
    parts = columns.observations, columns.actions, costs, columns.next_observations, columns.terminations
    return TransitionTable.from_arrays(*parts, LOG.episode_ids)


STATES = LOG.values().observations


def test_prices_of_a_stage() -> None:
    """By hand; what holds at the end, what is hard and what is not violated costs nothing."""
    effort = Constraint(lambda x, u, p: u - 1.0, "effort", Penalty(l2=2.0))
    end = Constraint(lambda x, p: x[0], "end", Penalty(1.0), terminal=True)
    mpc = limited([ROOM, effort, end, Constraint(lambda x, u, p: u - 1.5, "valve")])
    function = penalty_function(mpc)
    assert function is not None
    assert float(function([0.7, -1.0], [1.3], mpc.theta)) == pytest.approx(3 * 0.2 + 0.4 + 3 * 0.6 + 3.6 + 2 * 0.09)
    assert float(function([0.4, 0.0], [0.0], mpc.theta)) == 0.0
    assert penalty_function(limited(Constraint(lambda x, u, p: u - 1.5, "valve"))) is None
    assert [c.soft for c in repriced(mpc, 10.0).constraints] == [  # type: ignore[union-attr]
        Penalty(30.0, 100.0),
        Penalty(l2=20.0),
        Penalty(10.0),
        None,
    ]


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("contained", [False, True])
def test_whether_the_log_contains_them(unit: float, contained: bool) -> None:
    found = limit_costs_of(limited(), paid(unit, limits=price(STATES) if contained else 0.0))
    assert found is not None
    assert found.logged == contained
    assert found.scale == pytest.approx(unit, rel=1e-3)
    table = paid(unit, limits=price(STATES) if contained else 0.0)
    np.testing.assert_allclose(found.without(table).costs, paid(unit).costs, atol=1e-5 * unit)
    np.testing.assert_allclose(found.whole(table).costs, paid(unit, limits=price(STATES)).costs, atol=1e-5 * unit)


def test_where_the_cost_is_another_one() -> None:
    """The unit is the ratio of spreads where only that is known, and the coefficient where they are contained."""
    other = limited(W=np.diag([2.0, 0.7]), R=[[0.4]])
    apart, within = (limit_costs_of(other, paid(limits=limits)) for limits in (0.0, price(STATES)))
    assert apart is not None
    assert within is not None
    assert (apart.logged, within.logged) == (False, True)
    assert within.scale == pytest.approx(1.0, rel=0.02)
    assert 0.1 < apart.scale < 1.0
    assert limit_costs_of(limited(None), paid()) is None


def test_a_log_that_costs_little_but_for_its_violations() -> None:
    """What they cost says nothing of the unit of the rest: found as contained, beside noise and another stage cost."""
    room = StateBounds(ROOM.low, ROOM.high, "room", Penalty(300.0, 1000.0))
    other = limited(room, W=np.diag([2.0, 0.7]), R=[[0.4]])
    noise = 0.05 * LOG.values().costs.std() * np.random.default_rng(0).normal(size=len(LOG))
    within, apart = (limit_costs_of(other, paid(7.0, limits=noise + limits)) for limits in (100.0 * price(STATES), 0.0))
    assert within is not None
    assert apart is not None
    assert (apart.logged, within.logged) == (False, True)
    assert within.scale == pytest.approx(7.0, rel=0.02)
    clean = within.without(paid(7.0, limits=noise + 100.0 * price(STATES))).costs
    np.testing.assert_allclose(clean, paid(7.0, limits=noise).costs, atol=0.1 * 7.0 * LOG.values().costs.std())


def test_v_sees_them() -> None:
    """As much as they cost at least: what comes after costs, too."""
    beyond = STATES[over(STATES).max(axis=1) > 0.3]
    values = []
    for soft in (Penalty(1e-9), Penalty(30.0)):
        learner = OfflineMPCLearner(limited(StateBounds(ROOM.low, ROOM.high, "room", soft)), candidate="full", **QUICK)
        learner.fit(LOG, show_progress=False)
        assert learner.value_function is not None
        values.append(learner.value_function.predict(beyond))
        told = [each for each in learner.findings if each.startswith("Prices of soft limits")]
        assert told == ["Prices of soft limits: V has learned them, they were added to the logged costs."]
    more = np.mean(values[1] - values[0])
    assert more > 0.7 * np.mean(30.0 * over(beyond).sum(axis=1))


@pytest.mark.parametrize("terminal", ["quadratic", "network"])
@pytest.mark.parametrize("horizon", [1, 6])
def test_bounds_are_paid_for_once_where_v_is_the_terminal_cost(terminal: Terminal, horizon: int) -> None:
    """Bounds of no room at l2 make W larger: V is known, and an MPC that ends in it has it for a value, for any N."""
    bounds = StateBounds([0.0, 0.0], [0.0, 0.0], "middle", Penalty(l2=1.0))
    more = StateBounds([0.0, -np.inf], [0.0, np.inf], "one more", Penalty(l2=1.0))
    valve = StateBounds([-50.0, -50.0], [50.0, 50.0], "walls")
    mpc = limited([bounds, more, valve], horizon=horizon)
    best = optimum(lq_plant.A, lq_plant.B, lq_plant.W + np.diag([2.0, 1.0]), lq_plant.R, lq_plant.DISCOUNT)
    value = lq_plant.QuadraticValue(best.P)
    limits = limit_costs_of(mpc, paid())
    assert limits is not None
    assert not limits.logged
    known = Known(mpc, LOG, value_function=value, cost=KnownCost(), limits=limits, given=mpc)
    made = with_terminal_cost(known, TerminalConfig(terminal)).mpc
    solution = DDPSolver(made).solve(STATES[:20])
    np.testing.assert_allclose(solution.value, lq_plant.quadratic(best.P, STATES[:20]), rtol=0.02, atol=0.02)
    np.testing.assert_allclose(solution.u0, STATES[:20] @ best.K.T, rtol=0.02, atol=0.02)
    assert [each.at_end for each in made.state_bounds] == [False, False, True]
    unseen = with_terminal_cost(dataclasses.replace(known, limits=None), TerminalConfig(terminal)).mpc
    assert all(each.at_end for each in unseen.state_bounds)


def test_prices_of_a_learned_cost_are_in_its_unit() -> None:
    learner = OfflineMPCLearner(limited(W=np.diag([2.0, 0.7])), stage_cost="fitted", candidate="full", **QUICK)
    learner.fit(paid(1e3), show_progress=False)
    (limit,) = learner.mpc.state_bounds
    assert limit.soft is not None
    assert learner.result is not None
    assert learner.result.limits is not None
    scale, logged = learner.result.limits
    assert not logged
    assert limit.soft == Penalty(3.0 * scale, 10.0 * scale)
    assert 200.0 < scale < 2e3


def test_simulations_pay_for_them() -> None:
    for contained in (False, True):
        cost = LoggedCost(paid(2.0, limits=price(STATES) if contained else 0.0), mpc=limited())
        s, a = np.array([[0.9, -0.9], [0.1, 0.1]]), np.array([[0.5], [0.5]])
        plain = lq_plant.quadratic(lq_plant.W, s) + lq_plant.quadratic(lq_plant.R, a)
        np.testing.assert_allclose(cost(s, a, s), 2.0 * (plain + price(s)), rtol=1e-4)
        assert "2 times the prices of soft limits" in str(cost)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_a_back_off_of_zero_has_the_unit_of_its_limit(unit: float) -> None:
    """It has neither a size nor a range: the plant's costs rise from 0.5 on, the MPC believes that they do from 0.7."""
    parameters = {"A": lq_plant.A, "B": lq_plant.B, "backoff": 0.0}
    model = Model(lambda x, u, p: p["A"] @ x + p["B"] @ u, 2, 1, 0.1, parameters, discrete=True)
    limit = Constraint(lambda x, u, p: unit * (x[0] - 0.7) + p["backoff"], "room", Penalty(20.0 / unit))
    mpc = limited(None).replace(model=model, constraints=limit)
    learner = OfflineMPCLearner(mpc, "cost+model+constraints", candidate="full", prior=1e-3, **QUICK)
    learner.fit(paid(limits=20.0 * over(STATES, 0.5)[:, 0]), show_progress=False)
    assert float(learner.mpc.values["model.backoff"]) / unit == pytest.approx(0.2, abs=1e-3)


def backed_off(value: float, soft: Penalty | None) -> MPC:
    parameters = {"A": lq_plant.A, "B": lq_plant.B, "most": Parameter(value, low=0.1, high=1.0)}
    model = Model(lambda x, u, p: p["A"] @ x + p["B"] @ u, 2, 1, 0.1, parameters, discrete=True)
    return limited(None).replace(model=model, constraints=Constraint(lambda x, u, p: x[0] - p["most"], "room", soft))


def test_limits_may_be_learned() -> None:
    """The plant's costs rise beyond 0.5, the MPC believes that they do beyond 0.7."""
    table = paid(limits=20.0 * over(STATES, 0.5)[:, 0])
    before, after = (
        OfflineMPCLearner(backed_off(0.7, Penalty(20.0)), learn, candidate="full", prior=1e-6, **QUICK)
        for learn in ("cost+model", "cost+model+constraints")
    )
    for learner in (before, after):
        learner.fit(table, show_progress=False)
    assert float(before.mpc.values["model.most"]) == 0.7
    assert float(after.mpc.values["model.most"]) == pytest.approx(0.5, abs=0.02)
    assert before.result is not None
    assert after.result is not None
    assert after.result.loss_after < 0.1 * before.result.loss_before


def test_limits_that_cannot_be_learned_are_refused() -> None:
    for mpc in (backed_off(0.7, None), limited(), limited(None)):
        learner = OfflineMPCLearner(mpc, "cost+model+constraints", **QUICK)
        with pytest.raises(InvalidArgumentError, match="parameter of their own"):
            learner.fit(LOG, show_progress=False)
