"""Hard limits to what inputs change by in a step: kept by every plan; optimal by ipopt and by linear programming."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.optimize
from hard_plants import Prices
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from mpcoffline import MPC, Constraint, Model, MPCPolicy, QuadraticCost, StateBounds
from mpcoffline.solvers import DDPSolver, IpoptSolver, softened
from mpcoffline.solvers.limits import limits_of

Array = NDArray[np.float64]
N, DISCOUNT = 20, 0.97
LOW, HIGH = np.array([-1.0, 0.0]), np.array([1.0, 2.0])
A, B = np.array([[0.9, 0.1], [-0.2, 0.95]]), np.array([[0.3, 0.0], [0.1, 0.4]])


def rates(up: Any, down: Any, inputs: Any = (0, 1)) -> Constraint:
    chosen = list(inputs)

    def excess(x: ca.SX, u: ca.SX, before: ca.SX, p: object) -> ca.SX:
        change = u[chosen] - before[chosen]
        return ca.vertcat(change - ca.DM(up), -3.0 * (change + ca.DM(down)))

    return Constraint(excess, "rates", uses_previous=True)


def problem(constraints: Any, stage: Any = None, terminal: Any = None, unit: float = 1.0) -> MPC:
    model = Model(lambda x, u, p: ca.DM(A) @ x + ca.DM(B) @ (u / unit), 2, 2, 1.0, discrete=True)
    stage = stage or QuadraticCost(np.eye(2), 0.01 * np.eye(2) / unit**2, x_ref=[1.0, 2.0])
    terminal = terminal or QuadraticCost(np.eye(2), x_ref=[1.0, 2.0])
    return MPC(model, stage, terminal, N, DISCOUNT, unit * LOW, unit * HIGH, constraints=constraints)


def starts(n: int, unit: float = 1.0, seed: int = 0) -> Array:
    """States, and the inputs before."""
    rng = np.random.default_rng(seed)
    return np.hstack([rng.uniform(-3.0, 3.0, (n, 2)), unit * rng.uniform(LOW, HIGH, (n, 2))])


def changes(x: Array, u: Array) -> Array:
    """What inputs change by in each step, ``(B, N, nu)``."""
    return np.diff(np.concatenate([x[:, None, 2:], u], axis=1), axis=1)


@pytest.mark.parametrize("extra", [(), (StateBounds([-9.0, -9.0], [9.0, 2.2], "level"),)], ids=["rates", "and a level"])
@pytest.mark.parametrize("inputs", [(0, 1), (1,)])
def test_plans_are_ipopts(inputs: tuple[int, ...], extra: Any) -> None:
    up, down = np.array([0.2, 0.1])[list(inputs)], np.array([0.05, 0.3])[list(inputs)]
    mpc, x = problem([rates(up, down, inputs), *extra]), starts(12)
    ours, theirs = DDPSolver(mpc).solve(x), IpoptSolver(mpc).solve(x)
    np.testing.assert_array_equal(ours.success, theirs.success)
    good = ours.success
    assert good.sum() >= 8
    np.testing.assert_allclose(ours.value[good], theirs.value[good], rtol=1e-6)
    np.testing.assert_allclose(ours.u[good], theirs.u[good], atol=2e-3)


def test_one_side_alone() -> None:
    limit = Constraint(lambda x, u, before, p: before[0] - u[0] - 0.05, "falls", uses_previous=True)
    mpc, x = problem(limit), starts(8)
    ours, theirs = DDPSolver(mpc).solve(x), IpoptSolver(mpc).solve(x)
    assert ours.success.all()
    np.testing.assert_allclose(ours.value, theirs.value, rtol=1e-6)
    assert changes(x, ours.u)[:, :, 0].min() == pytest.approx(-0.05)


def test_beside_dead_time() -> None:
    """Of what is asked for, not of what acts: the input before is the newest of those that are remembered."""
    model = Model(lambda x, u, p: ca.DM(A) @ x + ca.DM(B) @ u, 2, 2, 1.0, discrete=True, delay=[2, 0])
    mpc = problem(rates([0.2, 0.1], [0.05, 0.3])).replace(model=model)
    rng = np.random.default_rng(0)
    x = np.hstack([rng.uniform(-2.0, 2.0, (6, 2)), rng.uniform(0.1, 0.9, (6, mpc.nx - 2))])
    found = limits_of(mpc, *(ca.SX.sym(name, n) for name, n in (("x", mpc.nx), ("u", 2), ("theta", mpc.space.size))))
    assert found is not None
    assert found.rates.elements.all()
    ours, theirs = DDPSolver(mpc).solve(x), IpoptSolver(mpc).solve(x)
    assert ours.success.all()
    np.testing.assert_allclose(ours.value, theirs.value, rtol=1e-6)
    first = ours.u[:, 0] - x[:, mpc.layout.previous]
    moved = np.concatenate([first[:, None], np.diff(ours.u, axis=1)], axis=1)
    assert (moved <= np.array([0.2, 0.1]) + 1e-12).all()
    assert (moved >= -np.array([0.05, 0.3]) - 1e-12).all()


def by_linear_programming(x: Array, of_state: Array, of_input: Array, up: Array, down: Array) -> float:
    """The least cost of a linear problem: states are eliminated, changes of inputs are rows."""
    effect = np.zeros((N + 1, 2, N, 2))
    free = np.zeros((N + 1, 2))
    free[0] = x[:2]
    for k in range(N):
        free[k + 1], effect[k + 1] = A @ free[k], np.einsum("ij,jkl->ikl", A, effect[k])
        effect[k + 1, :, k] += B
    weights = DISCOUNT ** np.arange(N + 1)
    price = np.einsum("k,i,kijl->jl", weights, of_state, effect) + weights[:N, None] * of_input
    change = np.eye(2 * N) - np.eye(2 * N, k=-2)
    before = np.concatenate([x[2:], np.zeros(2 * N - 2)])
    bounds = np.tile(np.stack([LOW, HIGH], axis=1), (N, 1))
    found = scipy.optimize.linprog(
        price.ravel(),
        np.vstack([change, -change]),
        np.concatenate([np.tile(up, N) + before, np.tile(down, N) - before]),
        bounds=bounds,
    )
    return float(found.fun + weights @ free @ of_state)


@pytest.mark.parametrize("seed", range(6))
def test_prices_alone_are_a_linear_programme(seed: int) -> None:
    """Plans rise and fall as fast as they may, and meet bounds that are multiples of their steps in corners."""
    rng = np.random.default_rng(seed)
    of_state, of_input = rng.normal(size=2), rng.normal(size=2)
    up, down = np.array([0.25, 0.125]), np.array([0.125, 0.25])
    mpc = problem(rates(up, down), Prices([*of_state, *of_input]), Prices([*of_state, 0.0, 0.0]))
    x = starts(6, seed=seed)
    x[:3, 2:] = [LOW, HIGH, LOW + 0.5]
    solution = DDPSolver(mpc).solve(x)
    assert solution.success.all()
    best = [by_linear_programming(each, of_state, of_input, up, down) for each in x]
    np.testing.assert_allclose(solution.value, best, rtol=1e-8, atol=1e-8)


@settings(max_examples=20, deadline=None)
@given(
    st.lists(st.floats(-1.5, 1.5), min_size=2, max_size=2),
    st.lists(st.floats(-2.0, 3.0), min_size=2, max_size=2),
    st.sampled_from([1.0, 1e-3, 2.0**20]),
)
def test_every_plan_keeps_them(place: list[float], before: list[float], unit: float) -> None:
    """From within the bounds; else the one that is violated first is named, at the first step."""
    up, down = np.array([0.2, 0.1]), np.array([0.05, 0.3])
    solver = SOLVERS.setdefault(unit, DDPSolver(problem(rates(unit * up, unit * down), unit=unit)))
    x = np.array([[*place, *(unit * np.array(before))]])
    solution = solver.solve(x)
    moved = changes(x, solution.u) / unit
    can = ((np.array(before) + up >= LOW) & (np.array(before) - down <= HIGH)).all()
    assert solution.success[0] == can
    later = moved[:, 1:] if not can else moved
    assert (later <= up + 1e-12).all()
    assert (later >= -down - 1e-12).all()
    if not can:
        assert solution.status[0] == "infeasible"
        assert "'rates[" in solution.words[0]
        assert "at stage 0" in solution.words[0]


SOLVERS: dict[float, DDPSolver] = {}


def test_an_imposed_input_is_not_asked_about() -> None:
    """Q(s, a) of an input that changes by more than it may is infeasible, and its plan goes on from there."""
    solver = DDPSolver(problem(rates([0.2, 0.2], [0.2, 0.2])))
    x, u0 = starts(4), np.array([0.5, 1.0]) + np.array([[0.1, 0.1], [0.0, -0.2], [0.3, 0.0], [0.0, 0.9]])
    x[:, 2:] = [0.5, 1.0]
    solution = solver.solve(x, u0=u0)
    np.testing.assert_array_equal(solution.success, [True, True, False, False])
    np.testing.assert_array_equal(solution.u[:, 0], u0)
    assert (np.abs(np.diff(solution.u, axis=1)) <= 0.2 + 1e-12).all()


def test_no_lane_looks_at_another_and_warm_is_cold() -> None:
    solver, x = DDPSolver(problem(rates([0.2, 0.1], [0.05, 0.3]))), starts(20)
    together = solver.solve(x)
    one_by_one = [solver.solve(each) for each in x]
    np.testing.assert_array_equal(together.u, [each.u for each in one_by_one])
    warm = solver.solve(x, warm_start=together.plan)
    assert warm.success.all()
    np.testing.assert_allclose(warm.value, together.value, rtol=1e-9)
    assert np.median(warm.stats["iterations"]) == 1


def test_a_policy_keeps_them_in_the_loop() -> None:
    mpc = problem(rates([0.2, 0.1], [0.05, 0.3]))
    policy, y = MPCPolicy(mpc), starts(8)[:, :2]
    state: Any = None
    inputs = []
    for _ in range(30):
        action, state = policy.predict(y, state)
        inputs.append(action)
        y = y @ A.T + np.asarray(action) @ B.T + 0.05 * np.sin(37.0 * y)
    moved = np.diff(np.stack(inputs), axis=0)
    assert (moved <= np.array([0.2, 0.1]) + 1e-6).all()  # in single precision
    assert (moved >= -np.array([0.05, 0.3]) - 1e-6).all()
    assert policy.solver_stats.n_failures == 0


def test_what_is_softened() -> None:
    """Not the changes of inputs, which any plan can keep."""
    mpc = problem([rates([0.2, 0.1], [0.05, 0.3]), StateBounds([-9.0, -9.0], [9.0, 2.2], "level")])
    soft = {each.name: each.soft for each in softened(mpc, starts(4)).constraints}
    assert soft["rates"] is None
    assert soft["level"] is not None


def test_others_are_no_rates() -> None:
    """A limit that falls with the state, one of parameters, and a contradiction are imposed as before."""
    limits = [
        Constraint(lambda x, u, before, p: u - before - 0.1 * x[:2], "by the state", uses_previous=True),
        Constraint(lambda x, u, before, p: u - 0.5 * before - 0.4, "half", uses_previous=True),
    ]
    mpc, x = problem(limits), np.array([[2.0, 2.0, 0.0, 0.2]])
    ours, theirs = DDPSolver(mpc).solve(x), IpoptSolver(mpc).solve(x)
    assert ours.success[0] == theirs.success[0]
    assert ours.value[0] == pytest.approx(theirs.value[0], rel=1e-5)
    never = DDPSolver(problem(rates([-0.2, -0.2], [0.1, 0.1]))).solve(x)
    assert never.status == ["infeasible"]
