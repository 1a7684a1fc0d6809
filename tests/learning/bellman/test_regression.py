"""(FIT) against numpy, Riccati equations and convex solutions found another way."""

from __future__ import annotations

from typing import Any

import casadi as ca
import lq_plant
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from lq_plant import BEST, DISCOUNT, QuadraticValue
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets import TransitionTable
from mpcoffline.learning import FitResult, ParameterConfig, ParameterTraining, ValueFunction, fit_parameters
from mpcoffline.learning.bellman.equation import BellmanProblem
from mpcoffline.mpc import MPC, Model, NormCost, Parameter, QuadraticCost
from mpcoffline.mpc.coordinates import Coordinates, canonical
from mpcoffline.mpc.scaling import Scaling
from mpcoffline.plants.nominal import nominal_mpc

Array = NDArray[np.float64]
COST, BOTH = ("cost",), ("cost", "model")
SWING_UPS = ["mpcoffline/PendulumSwingUp-v0", "mpcoffline/CartPoleSwingUp-v0"]


def swing_up_log(env_id: str, n: int = 64, seed: int = 0) -> TransitionTable:
    """Rows of the right sizes and magnitudes; every third one terminates."""
    mpc, rng = nominal_mpc(env_id), np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, size=(n, 1))
    y = np.hstack([rng.uniform(-1, 1, size=(n, mpc.nx - 3)), np.cos(angle), np.sin(angle), rng.uniform(-5, 5, (n, 1))])
    if mpc.nx == 3:
        y = y[:, -3:]
    reached = y + 0.1 * rng.normal(size=y.shape)
    u = rng.uniform(-2, 2, size=(n, 1))
    return TransitionTable.from_arrays(y, u, rng.uniform(0, 9, n), reached, np.arange(n) % 3 == 0)


def network(table: TransitionTable, seed: int = 0) -> ValueFunction:
    """Some value function."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        value = ValueFunction(table.ny, (32, 32))
    value.normalise(table, 0.9)
    return value.eval().requires_grad_(False)


def fit(mpc: MPC, P: Array, table: TransitionTable, groups: tuple[str, ...], **options: Any) -> FitResult:
    return fit_parameters(mpc, QuadraticValue(P), table, groups, ParameterConfig(**options), seed=0)


# ---------------------------------------------------------------- the error


@pytest.mark.parametrize("env_id", SWING_UPS)
def test_the_error_is_its_formula_evaluated_by_casadi_and_numpy(env_id: str) -> None:
    mpc, table = nominal_mpc(env_id, alpha=0.7, seed=1), swing_up_log(env_id)
    value, unit = network(table), 2.5
    theta = mpc.theta.copy()
    theta[mpc.space.mask(BOTH)] *= 1.05
    columns = table.columns(table.rows.astype(np.float64))
    predicted = mpc.dynamics_function(columns.observations.T, columns.actions.T, theta).full().T
    stage = mpc.stage_function(columns.observations.T, columns.actions.T, theta).full().ravel()
    alive = 1.0 - columns.terminations
    bellman = value.predict(columns.next_observations) - value.predict(predicted)
    residual = columns.costs + mpc.discount * alive * bellman - stage
    problem = BellmanProblem(mpc, value, unit)
    found = problem.error(table.columns(torch.from_numpy(table.rows)), torch.from_numpy(theta))
    assert float(found) == pytest.approx(float(np.var(residual)) / unit**2, rel=1e-5)


def test_the_errors_gradient_is_its_slope() -> None:
    mpc, table = nominal_mpc(SWING_UPS[0], alpha=0.5, seed=0), swing_up_log(SWING_UPS[0])
    problem, coordinates = BellmanProblem(mpc, network(table).double(), 1.0), Coordinates(mpc, BOTH, scaling_of(mpc))
    batch = table.columns(torch.from_numpy(table.rows.astype(np.float64)))
    rng = np.random.default_rng(0)
    z = torch.from_numpy(0.1 * rng.normal(size=coordinates.size)).requires_grad_()
    problem.error(batch, coordinates.theta(z)).backward()
    assert z.grad is not None
    direction, h = rng.normal(size=coordinates.size), 1e-3
    with torch.no_grad():
        ahead, behind = (
            problem.error(batch, coordinates.theta(z + s * h * torch.from_numpy(direction))) for s in (1, -1)
        )
    # The successors pass through float32 on their way into V.
    assert float(z.grad @ torch.from_numpy(direction)) == pytest.approx(float(ahead - behind) / (2 * h), rel=2e-3)


# ---------------------------------------------------------------- coordinates


def scaling_of(mpc: MPC) -> Scaling:
    """That of states of unit spread, whose increments spread by 0.5, and costs that spread by 3."""
    rng = np.random.default_rng(0)
    return Scaling(rng.normal(size=(4_000, mpc.nx)), rng.normal(size=(4_000, mpc.nu)), np.full(mpc.nx, 0.5), cost=3.0)


def bounded_mpc() -> MPC:
    """Masses with bounds, a free number, a bounded one, an array, a full and a singular weight."""
    parameters = {
        "m": Parameter(2.0, low=0.5, high=8.0),
        "c": Parameter(-0.3, low=-1.0, high=0.0),
        "G": np.array([[0.0, 4.0], [-2.0, 1.0]]),
        "zero": 0.0,
    }
    model = Model(
        lambda x, u, p: p["G"] @ x / p["m"] + p["c"] * ca.vertcat(u[0], u[0]) + p["zero"],
        2,
        1,
        0.1,
        parameters,
        discrete=True,
    )
    cost = QuadraticCost([[4.0, 1.0], [1.0, 2.0]], [[0.0]])
    return MPC(model, cost, NormCost([0.0, 0.0]), 5, 0.9, [-1.0], [1.0])


@pytest.mark.parametrize("groups", [COST, BOTH])
@pytest.mark.parametrize("mpc", [bounded_mpc(), *(nominal_mpc(env_id, 0.5, 1) for env_id in SWING_UPS)])
def test_zero_is_theta_0_bit_for_bit(mpc: MPC, groups: tuple[str, ...]) -> None:
    coordinates = Coordinates(mpc, groups, scaling_of(mpc))
    found = coordinates.theta(torch.zeros(coordinates.size, dtype=torch.float64)).numpy()
    np.testing.assert_array_equal(found, mpc.theta)


def test_coordinates_reach_their_bounds_and_come_back() -> None:
    mpc = bounded_mpc()
    coordinates = Coordinates(mpc, BOTH, scaling_of(mpc))
    names = [name for name, learned in zip(mpc.space.names, coordinates.mask, strict=True) if learned]
    for sign, bound, limit in ((-1, coordinates.low, mpc.space.low), (1, coordinates.high, mpc.space.high)):
        z = torch.from_numpy(np.where(np.isfinite(bound), bound, 3.0 * sign))
        theta = coordinates.theta(z).numpy()
        for i, name in enumerate(names):
            k = mpc.space.names.index(name)
            if np.isfinite(bound[i]):
                assert theta[k] == pytest.approx(limit[k], abs=1e-15), name
            else:  # free coordinates move in their scale
                assert (theta[k] - mpc.theta[k]) / coordinates.scale[i] == pytest.approx(3.0 * sign), name
    assert coordinates.logarithmic[names.index("model.m")]
    assert coordinates.low[names.index("model.m")] == pytest.approx(np.log(0.25))
    assert coordinates.high[names.index("model.m")] == pytest.approx(np.log(4.0))
    assert coordinates.logarithmic.sum() == 1


def test_only_the_chosen_groups_move() -> None:
    mpc = bounded_mpc()
    for groups in (COST, BOTH):
        coordinates = Coordinates(mpc, groups, scaling_of(mpc))
        moved = coordinates.theta(torch.ones(coordinates.size, dtype=torch.float64)).numpy() != mpc.theta
        np.testing.assert_array_equal(moved, mpc.space.mask(groups))
        assert coordinates.size == moved.sum()


def test_units_are_sizes_or_effects() -> None:
    mpc = bounded_mpc()
    coordinates = Coordinates(mpc, BOTH, scaling_of(mpc))
    names = [name for name, learned in zip(mpc.space.names, coordinates.mask, strict=True) if learned]
    scale = dict(zip(names, coordinates.scale, strict=True))
    # The states spread alike, so the entries of G have the size of the largest.
    assert [scale[f"model.G[{i},{j}]"] for i in (0, 1) for j in (0, 1)] == pytest.approx([4.0] * 4, rel=0.1)
    assert scale["model.c"] == pytest.approx(0.3)
    assert scale["model.zero"] == pytest.approx(0.5 / np.sqrt(2.0))  # adds to both states
    assert scale["stage_cost.constant"] == pytest.approx(3.0)
    assert scale["stage_cost.W[0,0]"] == pytest.approx(2.0)
    assert scale["stage_cost.W[1,0]"] == scale["stage_cost.W[1,1]"] == pytest.approx(np.sqrt(2.0))
    # R is zero: C^2 u^2 should be as large as the spread of the cost, and E[u^4] = 3.
    assert scale["stage_cost.R[0,0]"] == pytest.approx(np.sqrt(3.0 / np.sqrt(3.0)), rel=0.1)


@pytest.mark.parametrize("powers", [(0, 7, -3), (-20, 4, 8)])
def test_units_follow_those_of_the_data(powers: tuple[int, int, int]) -> None:
    """Position in 2^a m, speed in 2^b m/s, cost in 4^c: every coordinate of theta takes the unit that it has."""
    a, b, c = (2.0**power for power in powers)
    rng = np.random.default_rng(0)
    s, u = rng.normal(size=(300, 2)) * [1.0, 3.0], rng.normal(size=(300, 1))

    def units(a: float, b: float, c: float) -> NDArray[np.float64]:
        D = np.diag([a, b])
        A = D @ np.array([[1.0, 0.1], [0.0, 0.9]]) @ np.linalg.inv(D)
        W = c**2 * np.linalg.inv(D) @ np.diag([1.0, 1e-4]) @ np.linalg.inv(D)
        model = Model(lambda x, v, p: p["A"] @ x + p["b"] * v[0], 2, 1, 0.1, {"A": A, "b": np.zeros(2)}, discrete=True)
        mpc = MPC(model, QuadraticCost(W, [[0.0]]), NormCost([0.0, 0.0]), 5, 0.9, [-1.0], [1.0])
        scaling = Scaling(s @ D, u, np.array([0.3, 0.2]) @ D, 5.0 * c**2)
        return np.asarray(scaling.units(mpc, BOTH)[mpc.space.mask(BOTH)])

    expected = np.array([1.0, a / b, b / a, 1.0, a, b, c / a, c / b, c / b, c, c**2])
    np.testing.assert_array_equal(units(a, b, c), expected * units(1.0, 1.0, 1.0))


def test_gradients_stay_finite_far_out() -> None:
    mpc = bounded_mpc()
    coordinates = Coordinates(mpc, BOTH, scaling_of(mpc))
    # exp(1000) overflows; coordinates that are not logarithmic must not notice.
    z = torch.where(torch.from_numpy(coordinates.logarithmic), 1.0, 1_000.0).double().requires_grad_()
    coordinates.theta(z).sum().backward()
    assert z.grad is not None
    expected = np.where(coordinates.logarithmic, mpc.theta[coordinates.mask] * np.e, coordinates.scale)
    np.testing.assert_allclose(z.grad.numpy(), expected, rtol=1e-12)


def test_canonical_factors_give_the_same_matrices() -> None:
    mpc = bounded_mpc()
    theta = mpc.theta
    part = mpc.space.slices["stage_cost.W"]
    theta[part] = [-1.0, 0.5, -2.0]
    found = canonical(mpc, theta)
    np.testing.assert_array_equal(found[part], [1.0, -0.5, 2.0])
    block = next(block for block in mpc.space if block.name == "stage_cost.W")
    np.testing.assert_array_equal(block.natural(found[part]), block.natural(theta[part]))
    mpc.space.checked(found)


# ---------------------------------------------------------------- known answers


def test_exact_dynamics_and_cost_make_the_loss_vanish() -> None:
    """(FIT) is zero at the true (A, B, L) whatever V is."""
    mpc = lq_plant.make_mpc(model=(lq_plant.A, lq_plant.B))
    table = lq_plant.random_log(500)
    result = fit_parameters(mpc, network(table), table, BOTH, ParameterConfig(n_steps=20), seed=0)
    assert result.loss_before < 1e-9
    assert result.loss_after < 1e-4


def gain_of(mpc: MPC, weights: Array, model: tuple[Array, Array], terminal: Array) -> Array:
    """The first gain of a horizon of one step: argmin_u Lhat + gamma T(f), by linear algebra."""
    AB = np.hstack(model)
    Q = weights + mpc.discount * AB.T @ terminal @ AB
    return np.asarray(-np.linalg.solve(Q[2:, 2:], Q[2:, :2]))


def test_fitting_cost_and_model_ends_near_the_optimal_gain() -> None:
    """With T = V* the learned MPC's gain follows from Lhat and f by linear algebra; by (THM) it is the optimal one."""
    mpc = lq_plant.make_mpc()
    result = fit(mpc, BEST.P, lq_plant.random_log(4_000), BOTH, n_steps=400, prior=0.0, batch_size=256)
    learned = mpc.with_theta(result.theta).values
    weights = np.zeros((3, 3))
    weights[:2, :2], weights[2:, 2:] = learned["stage_cost.W"], learned["stage_cost.R"]
    gain = gain_of(mpc, weights, (learned["model.A"], learned["model.B"]), BEST.P)
    before = np.zeros((3, 3))
    before[:2, :2], before[2:, 2:] = lq_plant.W, lq_plant.R
    nominal = gain_of(mpc, before, (lq_plant.MODEL_A, lq_plant.MODEL_B), BEST.P)
    assert result.loss_after < 1e-3 * result.loss_before
    assert np.abs(gain - BEST.K).max() < 0.05 * np.abs(nominal - BEST.K).max()


SINGULAR = [
    (lq_plant.W, lq_plant.R),
    (np.diag([1.0, 0.0]), lq_plant.R),
    (np.zeros((2, 2)), lq_plant.R),
    (np.zeros((2, 2)), np.zeros((1, 1))),
]


@pytest.mark.parametrize(("W", "R"), SINGULAR)
def test_with_a_cross_term_the_cost_becomes_that_of_the_theorem(W: Array, R: Array) -> None:
    """Lhat* = Q* - gamma V*(f_0) with a wrong model f_0; weights that start at zero must not stay there."""
    AB = np.hstack([lq_plant.MODEL_A, lq_plant.MODEL_B])
    exact = BEST.Q - DISCOUNT * AB.T @ BEST.P @ AB
    assert np.linalg.eigvalsh(exact)[0] > 0.01  # within reach of a PSD weight
    mpc = lq_plant.make_mpc(W=W, R=R, S=np.zeros((2, 1)))
    result = fit(mpc, BEST.P, lq_plant.random_log(1_000), COST, prior=0.0)
    learned = mpc.with_theta(result.theta)
    np.testing.assert_allclose(learned.values["stage_cost.H"], exact, atol=2e-4)
    assert abs(learned.values["stage_cost.constant"]) < 2e-4
    assert result.loss_after < 1e-7
    # (THM): the gain under the wrong model is the plant's optimal one.
    gain = gain_of(mpc, learned.values["stage_cost.H"], (lq_plant.MODEL_A, lq_plant.MODEL_B), BEST.P)
    np.testing.assert_allclose(gain, BEST.K, atol=2e-3)


def test_on_the_linear_task_too() -> None:
    from riccati import optimum

    from mpcoffline.envs.linear_tracking import A0, ACTION_WEIGHT, B0, STATE_WEIGHT, plant_matrices

    plant = plant_matrices(1.0)
    best = optimum(*plant, STATE_WEIGHT, ACTION_WEIGHT, 0.9)
    rng = np.random.default_rng(0)
    s, a = lq_plant.float32_uniform(rng, 4_000, 4), lq_plant.float32_uniform(rng, 4_000, 2, 5.0)
    costs = lq_plant.quadratic(STATE_WEIGHT, s) + lq_plant.quadratic(ACTION_WEIGHT, a)
    table = TransitionTable.from_arrays(s, a, costs, s @ plant[0].T + a @ plant[1].T, np.zeros(4_000))
    mpc = nominal_mpc("mpcoffline/LinearTracking-v0")
    mpc = mpc.replace(stage_cost=QuadraticCost(STATE_WEIGHT, ACTION_WEIGHT, np.zeros((4, 2))))
    result = fit(mpc, best.P, table, COST, prior=0.0, refit_iterations=2_000)
    AB = np.hstack([A0, B0])
    exact = best.Q - 0.9 * AB.T @ best.P @ AB
    np.testing.assert_allclose(mpc.with_theta(result.theta).values["stage_cost.H"], exact, atol=5e-3)


def least_squares(table: TransitionTable, mpc: MPC, P: Array) -> tuple[Array, float, float]:
    """The unconstrained quadratic H and constant with the smallest error, and that error, by numpy."""
    c = table.columns(table.rows.astype(np.float64))
    predicted = mpc.dynamics_function(c.observations.T, c.actions.T, mpc.theta).full().T
    target = c.costs + DISCOUNT * (lq_plant.quadratic(P, c.next_observations) - lq_plant.quadratic(P, predicted))
    w = np.hstack([c.observations, c.actions])
    i, j = np.triu_indices(3)
    features = np.hstack([w[:, i] * w[:, j] * np.where(i == j, 1.0, 2.0), np.ones((len(w), 1))])
    solution, *_ = np.linalg.lstsq(features, target, rcond=None)
    H = np.zeros((3, 3))
    H[i, j] = H[j, i] = solution[:-1]
    error = float(np.mean((features @ solution - target) ** 2)) / float(table.costs.var(dtype=np.float64))
    return H, float(solution[-1]), error


def noisy_log(n: int, seed: int = 0) -> TransitionTable:
    """A log whose costs have noise and an offset, so that no cost explains them all."""
    clean, rng = lq_plant.random_log(n, seed), np.random.default_rng(seed + 100)
    costs = clean.costs + 0.7 + 0.2 * rng.normal(size=n)
    return TransitionTable.from_arrays(clean.observations, clean.actions, costs, clean.next_observations, np.zeros(n))


def test_the_refit_is_the_least_squares_solution_where_that_is_psd() -> None:
    mpc, table = lq_plant.make_mpc(S=np.zeros((2, 1))), noisy_log(800)
    H, constant, error = least_squares(table, mpc, BEST.P)
    assert np.linalg.eigvalsh(H)[0] > 0.01
    result = fit(mpc, BEST.P, table, COST, prior=0.0, refit_iterations=1_000)
    learned = mpc.with_theta(result.theta).values
    np.testing.assert_allclose(learned["stage_cost.H"], H, atol=2e-4)
    assert learned["stage_cost.constant"] == pytest.approx(constant, abs=2e-4)
    assert result.loss_after == pytest.approx(error, rel=1e-6)


def test_the_refit_satisfies_the_optimality_conditions_where_least_squares_is_indefinite() -> None:
    """KKT of min f(H) over H >= 0: the gradient G is PSD and G H = 0."""
    clean = lq_plant.random_log(800)
    costs = clean.costs - 1.5 * clean.actions[:, 0] ** 2  # cheap to act: the best quadratic is indefinite
    table = TransitionTable.from_arrays(
        clean.observations, clean.actions, costs, clean.next_observations, np.zeros(800)
    )
    mpc = lq_plant.make_mpc(S=np.zeros((2, 1)))
    H, _, unconstrained = least_squares(table, mpc, BEST.P)
    assert np.linalg.eigvalsh(H)[0] < -0.5
    result = fit(mpc, BEST.P, table, COST, prior=0.0, refit_iterations=1_000)
    learned = mpc.with_theta(result.theta).values["stage_cost.H"]
    c = table.columns(table.rows.astype(np.float64))
    predicted = mpc.dynamics_function(c.observations.T, c.actions.T, mpc.theta).full().T
    target = c.costs + DISCOUNT * (
        lq_plant.quadratic(BEST.P, c.next_observations) - lq_plant.quadratic(BEST.P, predicted)
    )
    w = np.hstack([c.observations, c.actions])
    constant = float(mpc.with_theta(result.theta).values["stage_cost.constant"])
    residual = lq_plant.quadratic(learned, w) + constant - target
    G = 2 * np.einsum("n,ni,nj->ij", residual, w, w) / len(w)
    assert abs(residual.mean()) < 1e-4
    assert np.abs(G @ learned).max() < 1e-3
    assert np.linalg.eigvalsh(G)[0] > -1e-3
    assert result.loss_after > unconstrained


def test_the_published_cost_is_fitted_as_well_as_a_convex_search_can() -> None:
    """Separate W, R (no cross term): numpy's least squares over their entries."""
    mpc, table = lq_plant.make_mpc(), noisy_log(800)
    c = table.columns(table.rows.astype(np.float64))
    predicted = mpc.dynamics_function(c.observations.T, c.actions.T, mpc.theta).full().T
    target = c.costs + DISCOUNT * (
        lq_plant.quadratic(BEST.P, c.next_observations) - lq_plant.quadratic(BEST.P, predicted)
    )
    s, a = c.observations, c.actions[:, 0]
    features = np.stack([s[:, 0] ** 2, 2 * s[:, 0] * s[:, 1], s[:, 1] ** 2, a**2, np.ones(len(a))], axis=1)
    w00, w01, w11, r, constant = np.linalg.lstsq(features, target, rcond=None)[0]
    assert w00 * w11 > w01**2
    assert min(w00, r) > 0
    result = fit(mpc, BEST.P, table, COST, prior=0.0, refit_iterations=1_000)
    learned = mpc.with_theta(result.theta).values
    np.testing.assert_allclose(learned["stage_cost.W"], [[w00, w01], [w01, w11]], atol=2e-4)
    assert learned["stage_cost.R"] == pytest.approx(r, abs=2e-4)
    assert learned["stage_cost.constant"] == pytest.approx(constant, abs=2e-4)


# ---------------------------------------------------------------- prior, bounds, groups


def without_constant(mpc: MPC, theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Theta without what the prior does not hold, as no input depends on it."""
    return np.delete(theta, mpc.space.names.index("stage_cost.constant"))


@pytest.mark.parametrize("groups", [COST, BOTH])
def test_a_huge_prior_keeps_theta_0(groups: tuple[str, ...]) -> None:
    mpc = lq_plant.make_mpc()
    result = fit(mpc, BEST.P, noisy_log(300), groups, prior=1e9, n_steps=300)
    np.testing.assert_allclose(without_constant(mpc, result.theta), without_constant(mpc, mpc.theta), atol=1e-4)


def test_the_prior_pulls_towards_theta_0() -> None:
    mpc = lq_plant.make_mpc()
    fitted = [fit(mpc, BEST.P, noisy_log(300), COST, prior=prior).theta for prior in (0.0, 1.0, 100.0)]
    distances = [float(np.linalg.norm(without_constant(mpc, theta - mpc.theta))) for theta in fitted]
    assert distances == sorted(distances, reverse=True)
    assert distances[-1] < 0.2 * distances[0]


def test_fitting_the_cost_leaves_everything_else_bit_identical() -> None:
    mpc = lq_plant.make_mpc()
    result = fit(mpc, BEST.P, noisy_log(300), COST)
    cost = mpc.space.mask(COST)
    np.testing.assert_array_equal(result.theta[~cost], mpc.theta[~cost])
    assert (result.theta[cost] != mpc.theta[cost]).any()


def test_references_and_terminal_cost_are_never_learned() -> None:
    mpc = lq_plant.make_mpc()
    result = fit(mpc, BEST.P, noisy_log(300), BOTH, n_steps=30)
    others = mpc.space.mask(("reference", "terminal"))
    np.testing.assert_array_equal(result.theta[others], mpc.theta[others])
    assert (result.theta[mpc.space.mask(("model",))] != mpc.theta[mpc.space.mask(("model",))]).any()


@settings(max_examples=12)
@given(
    seed=st.integers(0, 2**31),
    n=st.integers(1, 40),
    env_id=st.sampled_from(SWING_UPS),
    groups=st.sampled_from([COST, BOTH]),
    size=st.sampled_from([1e-3, 1.0, 1e3]),
)
def test_every_fit_gives_a_well_posed_mpc(seed: int, n: int, env_id: str, groups: tuple[str, ...], size: float) -> None:
    """Whatever the data: finite parameters within bounds, and positive semidefinite weights."""
    raw = swing_up_log(env_id, n, seed)
    c = raw.columns(raw.rows)
    table = TransitionTable.from_arrays(c.observations, c.actions, -size * c.costs, c.next_observations, c.terminations)
    mpc = nominal_mpc(env_id, alpha=1.0, seed=seed)
    config = ParameterConfig(n_steps=15, learning_rate=1.0, refit_iterations=30)
    result = fit_parameters(mpc, network(table, seed), table, groups, config, seed=seed)
    assert np.isfinite(result.loss_after)
    assert (mpc.space.low <= result.theta).all()
    assert (result.theta <= mpc.space.high).all()
    learned = mpc.with_theta(result.theta)
    for name in ("stage_cost.W", "stage_cost.R"):
        weight = learned.values[name]
        assert np.linalg.eigvalsh(weight)[0] >= -1e-12 * max(1.0, np.abs(weight).max())


def test_a_gradient_that_is_not_finite_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = 0
    honest = BellmanProblem.error

    def faulty(self: BellmanProblem, batch: Any, theta: torch.Tensor, constant: Any = None) -> torch.Tensor:
        nonlocal calls
        calls += 1
        return honest(self, batch, theta, constant) * (torch.nan if calls % 3 == 0 else 1.0)

    monkeypatch.setattr(BellmanProblem, "error", faulty)
    training = ParameterTraining(
        lq_plant.make_mpc(),
        QuadraticValue(BEST.P),
        lq_plant.random_log(300),
        BOTH,
        ParameterConfig(n_steps=50),
        seed=0,
    )
    losses = [training.advance(25)["fit_loss"] for _ in range(3)]
    result = training.result
    assert calls > 50
    assert np.isfinite(result.theta).all()
    assert result.loss_after < result.loss_before
    assert np.isfinite(losses).all()


def test_a_model_that_is_not_finite_on_the_data_is_refused() -> None:
    model = Model(lambda x, u, p: ca.sqrt(x) + p["b"] * ca.vertcat(u, u), 2, 1, 0.1, {"b": 1.0}, discrete=True)
    with pytest.raises(InvalidArgumentError, match="mpc: expected a model and a cost that are finite on the data"):
        fit(lq_plant.make_mpc().replace(model=model), BEST.P, lq_plant.random_log(100), BOTH)


# ---------------------------------------------------------------- running


def test_the_seed_decides_every_bit() -> None:
    table, mpc = noisy_log(600), lq_plant.make_mpc()
    options = ParameterConfig(n_steps=40, batch_size=64)
    first, again, other = (
        fit_parameters(mpc, QuadraticValue(BEST.P), table, BOTH, options, seed=seed) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first.theta, again.theta)
    assert (first.loss_before, first.loss_after) == (again.loss_before, again.loss_after)
    assert (first.theta != other.theta).any()


def test_steps_lead_to_the_end() -> None:
    steps: list[tuple[int, int]] = []
    options = ParameterConfig(n_steps=25, refit_iterations=10)
    for groups in (BOTH, COST):
        training = ParameterTraining(
            lq_plant.make_mpc(), QuadraticValue(BEST.P), noisy_log(100), groups, options, seed=0
        )
        while not training.done:
            training.advance(10)
            steps.append((training.step, training.n_steps))
    assert steps == [(10, 26), (20, 26), (25, 26), (26, 26), (1, 1)]


def test_a_large_table_is_refitted_on_a_subset() -> None:
    table, mpc = noisy_log(2_000), lq_plant.make_mpc()
    result = fit(mpc, BEST.P, table, COST, prior=0.0, refit_rows=100)
    everything = fit(mpc, BEST.P, table, COST, prior=0.0)
    assert (result.theta != everything.theta).any()
    np.testing.assert_allclose(result.theta, everything.theta, atol=0.3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prior": -1e-9}, "prior: expected a finite number from 0, got -1e-09"),
        ({"prior": np.nan}, "prior"),
        ({"prior": np.inf}, "prior"),
        ({"n_steps": -1}, "n_steps: expected an integer >= 0, got -1"),
        ({"batch_size": 2.0}, "batch_size"),
        ({"refit_rows": 0}, "refit_rows"),
        ({"refit_iterations": -5}, "refit_iterations"),
        ({"learning_rate": -1.0}, "learning_rate"),
        ({"clip": 0.0}, "clip"),
        ({"clip": None}, "clip"),
    ],
)
def test_bad_configurations_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        ParameterConfig(**options)
