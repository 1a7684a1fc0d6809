"""The ddp solver under limits: against ipopt, in any units, when infeasible, warm, in batches, with imposed inputs."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import casadi as ca
import numpy as np
import pytest
from limited_problems import PROBLEMS, cart_pole, integrator
from mpc_problems import simulated
from numpy.typing import NDArray
from random_limits import RandomProblem

from mpcoffline import MPCPolicy
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC, Constraint, Model, Penalty, QuadraticCost, StateBounds
from mpcoffline.solvers import DDPSolver, IpoptSolver, Plan, Solution, make_solver

Array = NDArray[np.float64]
N, DISCOUNT, START = 6, 0.95, np.array([2.0, 0.0])


def double_integrator(
    constraints: Any, position: float = 1.0, force: float = 1.0, cost: float = 1.0, **changes: Any
) -> MPC:
    """Position and speed, x+ = x + 0.5 v, v+ = v + 0.5 u; its states, inputs and costs in other units."""

    def step(x: Any, u: Any, p: Any) -> Any:
        return ca.vertcat(x[0] + 0.5 * x[1], x[1] + 0.5 * position * u[0] / force)

    return MPC(
        Model(step, 2, 1, 0.5, discrete=True),
        QuadraticCost(np.diag([1.0, 0.1]) * cost / position**2, [[0.1 * cost / force**2]]),
        QuadraticCost(np.diag([2.0, 1.0]) * cost / position**2),
        horizon=changes.pop("horizon", N),
        discount=DISCOUNT,
        action_low=[-2.0 * force],
        action_high=[2.0 * force],
        constraints=constraints,
    )


def slow(position: float = 1.0, soft: Penalty | None = None) -> StateBounds:
    return StateBounds([-np.inf, -0.5 * position], [np.inf, position], "speed", soft)


def agree(mpc: MPC, x: Any, **given: Any) -> Solution:
    """ddp finds what ipopt does, and says of itself what is so."""
    ours, theirs = DDPSolver(mpc).solve(x, **given), IpoptSolver(mpc).solve(x, **given)
    np.testing.assert_array_equal(ours.success, theirs.success)
    good = ours.success
    np.testing.assert_allclose(ours.value[good], theirs.value[good], rtol=1e-6)
    np.testing.assert_allclose(ours.u[good], theirs.u[good], atol=1e-4)
    return ours


# ---------------------------------------------------------------- every kind of limit

REST = Constraint(lambda x, p: ca.vertcat(x - 0.1, -x - 0.1), "rest", terminal=True)
STOP = Constraint(lambda x, p: ca.vertcat(x[1], -x[1]), "stop", terminal=True)
POWER = Constraint(lambda x, u, p: ca.vertcat(-x[1] * u[0] - 0.3, x[1] * u[0] - 0.3), "power")
KINDS: dict[str, Any] = {
    "bounds, mixed, equality at the end": [slow(), POWER, STOP],
    "twice the same, end": [slow(), StateBounds([-np.inf, -0.5], [np.inf, 1.0], "again"), REST],
    "soft": [
        slow(soft=Penalty(0.3)),
        Constraint(lambda x, u, p: u - 0.4, "gentle", Penalty(0.05, 0.1)),
        Constraint(lambda x, p: ca.vertcat(x[0] + 9.0), "far", Penalty(l2=1.0), terminal=True),
    ],
    "hard and soft": [slow(), Constraint(lambda x, u, p: u - 0.4, "gentle", Penalty(l2=2.0))],
    "exact": slow(soft=Penalty(100.0)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_kinds(kind: str) -> None:
    starts = np.random.default_rng(1).uniform([-2.0, -0.5], [2.0, 0.5], (4, 2))
    solution = agree(double_integrator(KINDS[kind]), starts)
    assert solution.success.any()
    assert solution.multipliers is not None


def test_the_value_is_the_true_cost() -> None:
    """The costs of the model run with these inputs, and the price of what is violated: nothing of the algorithm's."""
    weights = Penalty(0.1, 1.0)
    mpc = double_integrator(slow(soft=weights))
    solution = DDPSolver(mpc).solve(START[None])
    states, cost = simulated(mpc, START[None], solution.u)
    np.testing.assert_allclose(solution.x, states, atol=1e-12)
    s = np.maximum(-0.5 - states[0, 1:, 1], 0.0)
    price = DISCOUNT ** np.arange(1, N + 1) @ (weights.l1 * s + weights.l2 * s**2)
    assert s.max() > 0.05
    assert solution.value[0] == pytest.approx(cost[0] + price, rel=1e-12)


def test_parameters_in_limits() -> None:
    model = Model(lambda x, u, p: x + u * p["gain"], 1, 1, 1.0, {"gain": 1.0, "limit": 0.3}, discrete=True)
    limit = Constraint(lambda x, u, p: ca.vertcat(u - p["limit"], -u - p["limit"]), "limit")
    cost = QuadraticCost([[1.0]], [[0.1]])
    mpc = MPC(model, cost, QuadraticCost([[1.0]]), N, DISCOUNT, [-2.0], [2.0], constraints=limit)
    theta = np.stack([mpc.space.pack({"model.limit": value}) for value in (0.2, 0.7)])
    solution = DDPSolver(mpc).solve([[5.0], [5.0]], theta)
    np.testing.assert_allclose(solution.u0[:, 0], [-0.2, -0.7], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["obstacle", "four tanks, l1 = 20", "lane"])
def test_problems_of_all_kinds(name: str) -> None:
    """No dearer than ipopt's plan, which keeps its limits to a millionth of what they are measured by."""
    problem = PROBLEMS[name]
    mpc, x = problem.make(), problem.draw(3, np.random.default_rng(5))
    ours, oracle = DDPSolver(mpc).solve(x), IpoptSolver(mpc)
    theirs = oracle.solve(x)
    assert ours.success.all()
    assert (ours.value <= theirs.value + 1e-4 * np.abs(theirs.value)).all()
    assert (oracle.violation(x, ours.u) <= 1e-5).all()


@pytest.mark.parametrize(("units", "soft"), [((1e3, 1e-3, 1e3), None), ((1e-3, 1e3, 1e-3), Penalty(0.5))])
def test_no_unit_matters(units: tuple[float, float, float], soft: Penalty | None) -> None:
    """States, inputs and costs in other units: the same plan, and as many iterations, up to a few."""
    position, force, cost = units
    scaled = soft and Penalty(soft.l1 * cost / position)
    starts = np.random.default_rng(1).uniform([-2.0, -0.5], [2.0, 0.5], (8, 2))
    first = DDPSolver(double_integrator(slow(soft=soft))).solve(starts)
    other = DDPSolver(double_integrator(slow(position, scaled), *units)).solve(position * starts)
    assert first.success.all()
    assert other.success.all()
    np.testing.assert_allclose(other.u / force, first.u, atol=1e-4)
    assert (other.stats["iterations"] <= first.stats["iterations"] + 5).all()


# ---------------------------------------------------------------- what cannot be kept


@pytest.mark.parametrize(
    ("constraints", "named"),
    [
        ([StateBounds([-1.0, -9.0], [1.0, 9.0], "track")], r"infeasible: 'track\[0\]' at stage 1 is violated by 5"),
        ([Constraint(lambda x, u, p: 3.0 - u, "push")], r"infeasible: 'push' at stage \d is violated by 1"),
        ([Constraint(lambda x, p: x[0] + 50.0, "goal", terminal=True)], r"'goal' at stage 6 is violated by 48.5"),
    ],
)
def test_infeasible_problems_are_told(constraints: Any, named: str) -> None:
    """With the plan that violates the least, as ipopt's."""
    solution = DDPSolver(double_integrator(constraints)).solve([[6.0, 0.0], [6.0, 0.5]])
    assert solution.success.tolist() == [False, False]
    assert solution.status[0] == "infeasible"
    assert solution.stats["violation"][0] > 0.5
    assert np.isnan(solution.multipliers).all()
    with pytest.raises(AssertionError, match=named):
        raise AssertionError(solution.words[0])


def test_too_few_iterations_are_not_infeasibility() -> None:
    solution = DDPSolver(double_integrator(slow()), max_iterations=2).solve([START])
    assert solution.success.tolist() == [False]
    assert solution.status == ["iteration limit"]


def test_the_given_state_may_violate_what_no_input_changes() -> None:
    """It is reported; the future is planned as if nothing were amiss."""
    mpc = double_integrator(Constraint(lambda x, u, p: x[1] - 0.5, "speed"))
    solution = agree(mpc, [[1.0, 1.0], [1.0, 0.2]])
    assert solution.success.all()
    assert solution.stats["violation_now"][0] > 0.0
    assert solution.stats["violation_now"][1] == 0.0
    assert solution.x[0, 1:, 1].max() <= 0.5 + 1e-6


def test_imposed_inputs() -> None:
    mpc = double_integrator(Constraint(lambda x, u, p: u - 1.0, "gentle"))
    solution = agree(mpc, [[1.0, 0.0]] * 2, u0=[[1.5], [0.5]])
    assert solution.status == ["infeasible", "converged"]
    assert "'gentle' at stage 0 is violated by 0.5" in solution.words[0]
    np.testing.assert_array_equal(solution.u0[:, 0], [1.5, 0.5])


def test_violations_of_plans() -> None:
    """Of none, of a plan that keeps to its limits, and of one that is not finite."""
    solver = DDPSolver(double_integrator(slow()))
    solution = solver.solve([START, START, START])
    plans = solution.u.copy()
    plans[1], plans[2, 0] = -2.0, np.nan
    violation = solver.violation(solution.x[:, 0], plans)
    assert violation[0] == 0.0
    assert 0.1 < violation[1] < np.inf
    assert violation[2] == np.inf


# ---------------------------------------------------------------- warm, in batches, from process to process


def test_batches_threads_and_repeats() -> None:
    mpc, x = cart_pole(), PROBLEMS["cart-pole"].draw(19, np.random.default_rng(2))
    solver = DDPSolver(mpc)
    first, threaded = solver.solve(x), DDPSolver(mpc, n_threads=3).solve(x)
    one = [solver.solve(state) for state in x[:3]]
    for name in ("u", "value", "multipliers"):
        np.testing.assert_array_equal(getattr(first, name), getattr(threaded, name))
        np.testing.assert_array_equal(getattr(first, name)[:3], [getattr(s, name) for s in one])
    warm = solver.solve(x, warm_start=first.plan.shifted())
    again = solver.solve(x[:3], warm_start=first.plan.shifted().rows(np.arange(3)))
    np.testing.assert_array_equal(warm.u[:3], again.u)


@pytest.mark.parametrize("name", ["cart-pole", "double integrator", "cart-pole, l1 = 5, l2 = 50"])
def test_warm_starts(name: str) -> None:
    """Few iterations from the plan of the step before, to the cold solution; likewise without its multipliers."""
    problem = PROBLEMS[name]
    mpc, x = problem.make(), problem.draw(8, np.random.default_rng(3))
    solver = DDPSolver(mpc)
    plan = solver.solve(x)
    following = mpc.model(x, plan.u0)
    warm, cold = solver.solve(following, warm_start=plan.plan.shifted()), solver.solve(following)
    assert warm.success.all()
    assert np.median(warm.stats["iterations"]) < 20
    assert (warm.value <= cold.value + 1e-4 * np.abs(cold.value)).sum() >= 7  # there may be another minimum
    shifted = plan.plan.shifted()
    without = solver.solve(following, warm_start=Plan(shifted.x, shifted.u))
    assert (np.abs(without.value - warm.value) <= 1e-5 * np.abs(warm.value)).sum() >= 7


def test_multipliers_of_other_limits_are_refused() -> None:
    solver, plan = DDPSolver(double_integrator(slow())), DDPSolver(double_integrator(REST)).solve([START]).plan
    with pytest.raises(InvalidArgumentError, match=r"warm_start\.multipliers"):
        solver.solve([START], warm_start=plan)


def test_plans_travel() -> None:
    """In SB3's state, through pickles and copies, one array more than without limits."""
    policy, y, state = MPCPolicy(integrator()), np.array([[1.2, 0.0], [-0.7, 0.3]]), None
    for _ in range(5):
        actions, state = policy.predict(y, state=state)
        y = policy.mpc.model(y, actions)
        assert len(state) == 3
        for other in (pickle.loads(pickle.dumps(state)), copy.deepcopy(state), tuple(state)):
            np.testing.assert_array_equal(policy.predict(y, state=other)[0], policy.predict(y, state=state)[0])
    assert policy.solver_stats.n_failures == 0
    cold, _ = policy.predict(y, state=state, episode_start=[True, False])
    np.testing.assert_allclose(cold, policy.predict(y)[0], atol=1e-4)


def test_a_policy_with_limits_and_past_inputs() -> None:
    """Its state is states, inputs, past inputs, multipliers."""
    model = Model(lambda x, u, p: 0.9 * x + u, 1, 1, 1.0, discrete=True, delay=2)
    bounds = StateBounds([-0.4], [3.0], "level")
    mpc = MPC(model, QuadraticCost([[1.0]], [[0.01]], x_ref=[-1.0]), QuadraticCost([[1.0]]), 8, 0.95, [-1], [1], bounds)
    policy, y, state = MPCPolicy(mpc), np.array([[2.0]]), None
    past = [0.0, 0.0]
    for _ in range(6):
        action, state = policy.predict(y, state=state)
        assert len(state) == 4
        y = 0.9 * y + past.pop(0)
        past.append(float(action[0, 0]))
    assert y[0, 0] == pytest.approx(-0.4, abs=1e-4)


def test_auto_takes_it() -> None:
    solver = make_solver(double_integrator(slow()), "auto")
    assert solver.name == "ddp"
    assert solver.n_starts == 1  # affine model and limits, convex costs: one minimum


def test_what_cannot_be_kept_is_told_soon() -> None:
    """In no more than 10 times the iterations of the others."""
    problem = PROBLEMS["cart-pole"]
    x = problem.draw(24, np.random.default_rng(4))
    x[12:, 1] = np.where(x[12:, 0] > 0.0, 2.0, -2.0)  # too fast for what is left of the track
    solution = DDPSolver(problem.make()).solve(x)
    kept, lost = solution.success, np.array(solution.status) == "infeasible"
    assert kept.sum() >= 8
    assert lost.sum() >= 8
    iterations = solution.stats["iterations"]
    assert np.median(iterations[lost]) <= 10.0 * np.median(iterations[kept])
    assert iterations[lost].max() < 848  # all starts to their last iteration


def test_what_was_cut_short_is_no_infeasibility() -> None:
    """Between an obstacle and a bound the minimisations take hundreds of iterations; ipopt gets through."""
    problem = RandomProblem(38)
    unit, x = problem.units(), problem.states(10)[6]
    ours, theirs = DDPSolver(problem.mpc(unit)).solve(unit.x * x), IpoptSolver(problem.mpc()).solve(x)
    assert theirs.success
    assert ours.success
    assert ours.value / unit.cost == pytest.approx(float(theirs.value), rel=1e-4)


def test_what_cannot_be_kept_is_not_solved_twice_from_plan_to_plan() -> None:
    """A plan of all starts that violates what it must, is gone on from; the first time it is tried from all starts."""
    mpc, start = double_integrator([StateBounds([-1.0, -9.0], [1.0, 9.0], "track")]), np.array([[6.0, 1.0]])
    solver = DDPSolver(mpc, n_starts=16)
    cold = solver.solve(start)
    warm = solver.solve(cold.x[:, 1], warm_start=cold.plan.shifted())
    again = solver.solve(cold.x[:, 1])
    assert warm.status == again.status == ["infeasible"]
    assert warm.stats["all_starts"].all()
    assert warm.stats["iterations"][0] < 0.5 * again.stats["iterations"][0]
    np.testing.assert_allclose(warm.stats["violation"], again.stats["violation"], rtol=1e-3)
    policy = MPCPolicy(mpc, solver)
    state = None
    for _ in range(2):
        _, state = policy.predict(start, state=state)
    assert policy.solver_stats.answers == {"retried": 0, "rescued": 0, "best_plan": 2, "previous_plan": 0, "zero": 0}
    free = solver.solve([[0.5, 0.0]])
    assert free.success.all()
    changed = solver.solve(cold.x[:, 1], warm_start=free.plan)  # of a problem that was solved: from all starts besides
    assert changed.stats["iterations"][0] > again.stats["iterations"][0]
