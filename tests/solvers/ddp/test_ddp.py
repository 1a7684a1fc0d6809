"""The ddp solver against ipopt, scipy, and its own promises: results are re-simulated and differentiated here."""

from __future__ import annotations

import gc
from functools import cache

import casadi as ca
import numpy as np
import pytest
from mpc_problems import projected_gradient, random_linear, random_states, random_theta, simulated
from scipy.optimize import minimize
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.envs import ENV_IDS
from mpcoffline.mpc import MPC, Model, NormCost, QuadraticCost
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.solvers import DDPSolver, IpoptSolver, Plan, Solution, make_solver


@cache
def solver_of(env_id: str, horizon: int | None = None) -> DDPSolver:
    mpc = nominal_mpc(env_id)
    return DDPSolver(mpc.replace(horizon=horizon or mpc.horizon))


def check(solver: DDPSolver, x: np.ndarray, solution: Solution, theta: np.ndarray | None = None) -> None:
    """Everything that a solution must satisfy, by independent means; ``success`` must be true of it."""
    mpc = solver.mpc
    path, cost = simulated(mpc, x, solution.u, theta)
    scale = 1.0 + np.abs(path).max()
    np.testing.assert_allclose(solution.x, path, rtol=0, atol=1e-8 * scale)
    np.testing.assert_allclose(solution.value, cost, rtol=1e-8, atol=1e-9)
    np.testing.assert_array_equal(solution.u0, solution.u[:, 0])
    assert ((solution.u >= mpc.action_low) & (solution.u <= mpc.action_high)).all()
    # A predicted decrease below 1e-10 (1 + |J|) bounds the gradient by its root, times the root of the curvature.
    gradient = projected_gradient(mpc, solution, theta) / np.sqrt(1.0 + np.abs(solution.value))
    assert (gradient[solution.success] < 2e-3).all()


# ---------------------------------------------------------------- numbers


@pytest.mark.parametrize("env_id", [PENDULUM, CARTPOLE])
def test_iterations_do_not_creep_and_end_at_the_minimum(env_id: str) -> None:
    """First inputs against those that many more iterations give; the count includes those of all starts."""
    mpc = nominal_mpc(env_id)
    solver, exact = solver_of(env_id), DDPSolver(mpc, tolerance=1e-17, max_iterations=400)
    iterations, errors = [], []
    for seed in range(20):
        theta, x = random_theta(mpc, 300 + seed), random_states(env_id, 4, 300 + seed)
        found = solver.solve(x, theta)
        polished = exact.solve(x, theta, warm_start=found)
        same = np.abs(found.value - polished.value) <= 1e-6 * (1.0 + np.abs(found.value))
        errors.extend(np.abs(found.u0 - polished.u0)[same].max(axis=1))
        iterations.extend(found.stats["iterations"])
    assert len(errors) >= 78
    assert np.mean(np.array(errors) < 1e-4) >= 0.99
    assert np.mean(iterations) < 90


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_solutions_of_random_problems_are_solutions(env_id: str) -> None:
    """Full horizons, random theta with full weights: re-simulated states and cost, bounds, gradient."""
    solver, solved = solver_of(env_id), []
    for seed in range(10):
        theta, x = random_theta(solver.mpc, seed), random_states(env_id, 20, seed)
        solution = solver.solve(x, theta)
        solved.append(solution.success.mean())
        check(solver, x, solution, theta)
    assert np.mean(solved) >= 0.99  # Gauss-Newton creeps where the model's curvature is large: 1 in 3000 of these


@pytest.mark.parametrize(("env_id", "horizon"), [(LINEAR, 20), (PENDULUM, 20), (CARTPOLE, 15)])
def test_agreement_with_ipopt(env_id: str, horizon: int) -> None:
    """Never worse than ipopt's best of four starts; where the minimum is the same, so is the input."""
    solver = solver_of(env_id, horizon)
    ipopt = IpoptSolver(solver.mpc, n_starts=2)
    for seed in range(8):
        theta, x = random_theta(solver.mpc, 100 + seed), random_states(env_id, 3, 100 + seed)
        ours, theirs = solver.solve(x, theta), ipopt.solve(x, theta)
        assert ours.success.all()
        assert theirs.success.all()
        assert (ours.value <= theirs.value + 1e-5 * (1.0 + np.abs(theirs.value))).all()
        same = np.abs(ours.value - theirs.value) <= 1e-6 * (1.0 + np.abs(theirs.value))
        assert same.mean() > 0.3  # ipopt stays in local minima now and then
        np.testing.assert_allclose(ours.u0[same], theirs.u0[same], rtol=0, atol=1e-4)


@pytest.mark.parametrize("nu", [1, 2, 3])
def test_random_linear_systems_with_active_bounds(nu: int) -> None:
    """Convex problems: L-BFGS-B over all inputs from the solution finds nothing better; from zero nothing else."""
    active = []
    for seed in range(6):
        mpc = random_linear(seed, nu=nu)
        solver = DDPSolver(mpc)
        x = 2.0 * np.random.default_rng(seed).normal(size=(6, 4))
        solution = solver.solve(x)
        assert solution.success.all()
        check(solver, x, solution)
        active.append(((solution.u <= mpc.action_low) | (solution.u >= mpc.action_high)).mean())
        inputs = ca.SX.sym("u", nu, mpc.horizon)
        state, cost = ca.SX(x[0]), ca.SX(0)
        for k in range(mpc.horizon):
            cost += mpc.discount**k * mpc.stage_function(state, inputs[:, k], mpc.theta)
            state = mpc.dynamics_function(state, inputs[:, k], mpc.theta)
        cost += mpc.discount**mpc.horizon * mpc.terminal_function(state, mpc.theta)
        J = ca.Function("J", [ca.vec(inputs)], [cost])
        gradient = ca.Function("g", [ca.vec(inputs)], [ca.gradient(cost, ca.vec(inputs))])
        bounds = list(zip(np.tile(mpc.action_low, mpc.horizon), np.tile(mpc.action_high, mpc.horizon), strict=True))
        for start in (solution.u[0].ravel(), np.zeros(nu * mpc.horizon)):
            found = minimize(
                lambda v, J=J: float(J(v)),
                start,
                jac=lambda v, g=gradient: g(v).full().ravel(),
                method="L-BFGS-B",
                bounds=bounds,
                options={"ftol": 1e-15, "gtol": 1e-10, "maxiter": 3000, "maxfun": 10000},
            ).fun
            assert solution.value[0] <= found + 1e-9 * (1.0 + abs(found))
            assert solution.value[0] == pytest.approx(found, rel=1e-5)
    assert 0.1 < np.mean(active) < 0.95  # the box QP had something to do


def test_three_inputs_against_ipopt() -> None:
    mpc = random_linear(3, nu=3)
    x = 2.0 * np.random.default_rng(3).normal(size=(10, 4))
    ours, theirs = DDPSolver(mpc).solve(x), IpoptSolver(mpc, tolerance=1e-10).solve(x)
    assert theirs.success.all()
    np.testing.assert_allclose(ours.value, theirs.value, rtol=1e-7)
    np.testing.assert_allclose(ours.u0, theirs.u0, rtol=0, atol=1e-4)


def exotic_mpc() -> MPC:
    """A plant with most of CasADi's operations, eight of them summed in each of four states."""

    def dynamics(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        a = p["a"] * x[0]
        s = ca.tanh(a)  # in (-1, 1), where every function below is defined
        c = ca.cos(a)
        terms = [
            *(f(s) for f in (ca.sin, ca.tan, ca.exp, ca.expm1, ca.sinh, ca.cosh, ca.asinh, ca.atan, ca.erf, ca.fabs)),
            *(f(0.9 * s) for f in (ca.asin, ca.acos, ca.atanh)),
            *(f(1.5 + s) for f in (ca.sqrt, ca.log, ca.log1p, ca.log10)),
            ca.acosh(2.5 + s),
            ca.if_else(s > 0.2, 0.3 * (s - 0.2) ** 2, 0.0),
            ca.if_else(ca.logic_or(s <= 0.1, ca.logic_not(s < 3.0)), s * s, 0.2 * s - 0.01),
            ca.if_else(ca.logic_and(s >= -0.3, s != 7.0), ca.sign(2.0 + s), 1.0),
            ca.if_else(s == 7.0, 5.0, ca.floor(s + 10.5) + ca.ceil(0.5 * s - 10.25)),
            ca.fmin(s, 0.3),
            ca.fmax(s, -0.3),
            ca.atan2(s, 1.0 + c * c),
            ca.hypot(s, 1.0),
            ca.power(1.5 + s, 1.7),
            ca.power(1.5 + s, 0.5 + 0.1 * c),
            ca.fmod(s + 10.0, 3.0),
            ca.remainder(s + 10.0, 3.0),
            ca.copysign(1.0 + s, 2.0 + s),
            -s * u[0] / (2.0 + c),
            s / (1.2 + s) + 1.0 / (1.3 + s),
        ]
        weighted = [(0.5 + 0.1 * k) * term for k, term in enumerate(terms)]
        return ca.vertcat(0.8 * x[0] + 0.5 * u[0], *(sum(weighted[k::4]) for k in range(4)))

    n = 5
    return MPC(
        model=Model(dynamics, n, 1, 0.1, {"a": 0.7}, discrete=True),
        stage_cost=QuadraticCost(0.1 * np.eye(n), [[0.1]]),
        terminal_cost=NormCost(np.zeros(n)),
        horizon=4,
        discount=0.9,
        action_low=[-1.0],
        action_high=[1.5],
    )


def test_every_operation_of_a_model() -> None:
    """Values by re-simulation with CasADi, derivatives by the gradient's vanishing, minima by ipopt."""
    solver = DDPSolver(exotic_mpc())
    x = np.zeros((12, solver.mpc.nx))
    x[:, 0] = np.linspace(-2.0, 2.0, 12)
    solution = solver.solve(x)
    check(solver, x, solution)
    assert solution.success.mean() > 0.7  # a minimum at a kink is none for a solver of smooth problems
    theirs = IpoptSolver(solver.mpc).solve(x)
    both = solution.success & theirs.success
    assert (solution.value[both] <= theirs.value[both] + 1e-5).all()


def test_operations_without_a_counterpart_in_c_are_refused() -> None:
    mpc = exotic_mpc()
    model = Model(lambda x, u, p: ca.erfinv(0.1 * x) + u, 1, 1, 0.1, discrete=True)
    small = mpc.replace(model=model, stage_cost=QuadraticCost([[1.0]], [[1.0]]), terminal_cost=NormCost([0.0]))
    with pytest.raises(InvalidArgumentError, match="operation"):
        DDPSolver(small)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_q_value_is_at_least_the_value(env_id: str) -> None:
    solver = solver_of(env_id)
    x = random_states(env_id, 50)
    solution = solver.solve(x)
    tolerance = 1e-7 * (1.0 + solution.value)
    rng = np.random.default_rng(1)
    for _ in range(3):
        u = rng.uniform(solver.mpc.action_low, solver.mpc.action_high, size=(50, solver.mpc.nu))
        imposed = solver.solve(x, u0=u)
        assert imposed.success.all()
        np.testing.assert_array_equal(imposed.u0, u)
        assert (imposed.value >= solution.value - tolerance).all()
        assert (imposed.value > solution.value + 1e-4).any()
        # Two ways to the same number: one step by hand, then the optimum from there with a horizon less one.
        np.testing.assert_allclose(simulated(solver.mpc, x, imposed.u)[1], imposed.value, rtol=1e-9)
    # Warm: from other starting points it may find a better local minimum with the same first input.
    same = solver.solve(x, u0=solution.u0, warm_start=solution)
    assert (np.abs(same.value - solution.value) <= tolerance).all()


# ---------------------------------------------------------------- batches


def rows_equal(one: Solution, many: Solution, i: int) -> None:
    for name in ("u0", "x", "u", "value", "success"):
        np.testing.assert_array_equal(getattr(one, name)[0], getattr(many, name)[i], err_msg=name)
    assert one.status[0] == many.status[i]
    assert one.stats["iterations"][0] == many.stats["iterations"][i]


@pytest.mark.parametrize("n", [3, 13, 100])
@pytest.mark.parametrize("case", [CARTPOLE, "three inputs"])
def test_a_batch_is_bit_for_bit_its_rows(case: str, n: int) -> None:
    """Whatever is solved in the neighbouring lanes, cold and warm, and however many threads share the batch."""
    rng = np.random.default_rng(n)
    if case == CARTPOLE:
        solver, x = solver_of(CARTPOLE, 20), random_states(CARTPOLE, n, n)
    else:
        solver, x = DDPSolver(random_linear(0, nu=3)), 2.0 * rng.normal(size=(n, 4))
    cold = solver.solve(x)
    moved = x + 0.1 * rng.normal(size=x.shape)
    warm = solver.solve(moved, warm_start=cold)
    threads = DDPSolver(solver.mpc, n_threads=3)
    np.testing.assert_array_equal(threads.solve(x).u, cold.u)
    np.testing.assert_array_equal(threads.solve(moved, warm_start=cold).u, warm.u)
    for i in range(0, n, max(1, n // 13)):
        rows_equal(solver.solve(x[i : i + 1]), cold, i)
        rows_equal(solver.solve(moved[i : i + 1], warm_start=Plan(cold.x[i : i + 1], cold.u[i : i + 1])), warm, i)


def test_a_single_state_gives_unbatched_arrays() -> None:
    solver = solver_of(PENDULUM)
    x = random_states(PENDULUM, 1)
    one, batch = solver.solve(x[0]), solver.solve(x)
    assert one.u0.shape == (1,)
    assert one.x.shape == (51, 3)
    assert np.ndim(one.value) == 0
    np.testing.assert_array_equal(one.u, batch.u[0])


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_warm_and_cold_agree(env_id: str) -> None:
    """From the solution of a state nearby, and from the solution itself: the same minimum, in fewer iterations."""
    solver = solver_of(env_id)
    x = random_states(env_id, 60)
    cold = solver.solve(x)
    again = solver.solve(x, warm_start=cold)
    assert again.success.all()
    np.testing.assert_allclose(again.value, cold.value, rtol=1e-9)
    assert again.stats["iterations"].max() <= 3
    near = solver.solve(x + 1e-3, warm_start=cold)
    fresh = DDPSolver(solver.mpc, n_starts=16).solve(x + 1e-3)
    assert near.success.all()
    assert (np.abs(near.value / fresh.value - 1.0) < 1e-6).mean() >= 0.9  # else the better of two minima changed
    assert near.stats["iterations"].mean() < 0.2 * fresh.stats["iterations"].mean()
    # A shifted plan does not obey the model at its end: the defect is taken out in the first step.
    shifted = solver.solve(cold.x[:, 1], warm_start=cold.plan.shifted())
    assert shifted.success.all()
    check(solver, cold.x[:, 1], shifted)


def test_a_batch_of_warm_and_cold_rows() -> None:
    """Rows of NaN start cold, each row as if it were alone."""
    solver = solver_of(PENDULUM)
    x = random_states(PENDULUM, 11)
    cold = solver.solve(x)
    keep = np.arange(11) % 3 == 0
    mixed = solver.solve(x + 0.01, warm_start=cold.plan.select(keep))
    warm, fresh = solver.solve(x + 0.01, warm_start=cold), solver.solve(x + 0.01)
    np.testing.assert_array_equal(mixed.u[keep], warm.u[keep])
    np.testing.assert_array_equal(mixed.u[~keep], fresh.u[~keep])
    np.testing.assert_array_equal(mixed.value[keep], warm.value[keep])
    assert mixed.success.all()


def test_a_plan_that_leads_nowhere_costs_nothing_but_time() -> None:
    solver = solver_of(CARTPOLE)
    x = random_states(CARTPOLE, 5)
    for size in (1e3, 1e150, 1e300):
        plan = Plan(np.full((5, 51, 5), size), np.full((5, 50, 1), -size))
        solution = solver.solve(x, warm_start=plan)
        assert solution.success.all()
        check(solver, x, solution)


def test_a_plan_with_holes_is_none() -> None:
    solver = solver_of(PENDULUM, 20)
    x = random_states(PENDULUM, 4)
    cold = solver.solve(x)
    states, inputs = cold.x.copy(), cold.u.copy()
    states[0, 7, 1] = inputs[1, 0] = inputs[2, 9] = np.nan
    holed = solver.solve(x, warm_start=Plan(states, inputs))
    np.testing.assert_array_equal(holed.u[:3], cold.u[:3])
    np.testing.assert_allclose(holed.value, cold.value, rtol=1e-9)
    assert holed.success.all()


def test_plans_and_states_may_be_read_only() -> None:
    solver = solver_of(PENDULUM, 20)
    x = random_states(PENDULUM, 3)
    cold = solver.solve(x)
    warm = solver.solve(x, warm_start=cold.plan)
    for array in (x, *cold.plan):
        array.flags.writeable = False
    np.testing.assert_array_equal(solver.solve(x, warm_start=cold.plan).u, warm.u)
    spread = np.broadcast_to(solver.mpc.theta, (3, solver.mpc.space.size))
    np.testing.assert_array_equal(solver.solve(x[::-1], spread).u[::-1], cold.u)


def test_the_callers_arrays_are_left_alone() -> None:
    solver = solver_of(PENDULUM)
    x = random_states(PENDULUM, 4)
    cold = solver.solve(x)
    copies = x.copy(), cold.x.copy(), cold.u.copy()
    solver.solve(x, warm_start=cold)
    gc.collect()
    for array, copy in zip((x, cold.x, cold.u), copies, strict=True):
        np.testing.assert_array_equal(array, copy)
    fortran = Plan(np.asfortranarray(cold.x), np.asfortranarray(cold.u))
    np.testing.assert_array_equal(
        solver.solve(np.asfortranarray(x), warm_start=fortran).u, solver.solve(x, warm_start=cold).u
    )


def test_equal_calls_give_equal_bits() -> None:
    x = random_states(CARTPOLE, 9)
    mpc = nominal_mpc(CARTPOLE)
    first, second = DDPSolver(mpc).solve(x), make_solver(mpc, "auto").solve(x)
    np.testing.assert_array_equal(first.u, second.u)
    np.testing.assert_array_equal(first.value, second.value)


def test_theta_is_data() -> None:
    """Another theta, horizon, discount or other bounds need no other library, and give what a new solver gives."""
    mpc = nominal_mpc(PENDULUM)
    theta, x = random_theta(mpc, 5), random_states(PENDULUM, 6)
    given, own = DDPSolver(mpc).solve(x, theta), DDPSolver(mpc.with_theta(theta)).solve(x)
    np.testing.assert_array_equal(given.u, own.u)
    np.testing.assert_array_equal(given.value, own.value)
    changed = mpc.replace(horizon=7, discount=0.99, action_low=[-1.0], action_high=[0.5])
    check(DDPSolver(changed), x, DDPSolver(changed).solve(x))


def test_each_problem_may_have_its_own_theta() -> None:
    """Cold, warm and mixed: each row is what it is with its theta alone."""
    solver = solver_of(PENDULUM)
    x = random_states(PENDULUM, 7)
    theta = np.stack([random_theta(solver.mpc, seed) for seed in range(7)])
    cold = solver.solve(x, theta)
    warm = solver.solve(x + 0.01, theta, warm_start=cold)
    mixed = solver.solve(x + 0.01, theta, warm_start=cold.plan.select(np.arange(7) < 3))
    for i in range(7):
        np.testing.assert_array_equal(solver.solve(x[i], theta[i]).u, cold.u[i])
        np.testing.assert_array_equal(mixed.u[i], (warm if i < 3 else solver.solve(x + 0.01, theta[i])).u[i])
