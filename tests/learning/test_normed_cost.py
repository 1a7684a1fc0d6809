"""Costs that are distances, and those of the state that a step reaches, against the formulas that made them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mpcoffline import MPC, MPCPolicy, OfflineMPCLearner, TransitionTable
from mpcoffline.learning import FitResult, Known
from mpcoffline.learning.bellman.stages import TerminalConfig, with_terminal_cost
from mpcoffline.learning.ends import priced_ends
from mpcoffline.learning.known_cost import agreeing_cost
from mpcoffline.learning.stages import KnownCost
from mpcoffline.mpc import Model, ParameterSpace, QuadraticCost
from mpcoffline.simulation.logged_cost import LoggedCost

Array = NDArray[np.float64]
Cost = Callable[[Array, Array], Array]

DT = 0.2
W, R = np.diag([2.0, 2.0, 0.0, 0.0]), 0.1 * np.eye(2)


def mpc_of(scale: float = 1.0) -> MPC:
    """A mass that two forces push over a table, with friction."""

    def ode(x: ca.SX, u: ca.SX, _: object) -> ca.SX:
        return ca.vertcat(x[2:], u - 0.5 * x[2:])

    return MPC(
        model=Model(ode, nx=4, nu=2, dt=DT),
        stage_cost=QuadraticCost(scale * W, scale * R),
        terminal_cost=QuadraticCost(5.0 * scale * W),
        horizon=15,
        discount=0.95,
        action_low=[-2.0, -2.0],
        action_high=[2.0, 2.0],
    )


def walks(cost: Cost, *, reached: bool, n_episodes: int = 40, n_steps: int = 30, seed: int = 0) -> TransitionTable:
    """Episodes under a noisy feedback, whose costs are of the state that is left, or that is reached."""
    rng, mpc = np.random.default_rng(seed), mpc_of()
    s = np.zeros((n_steps + 1, n_episodes, 4))
    u = np.zeros((n_steps, n_episodes, 2))
    s[0, :, :2] = rng.uniform(-2.0, 2.0, (n_episodes, 2))
    for t in range(n_steps):
        u[t] = np.clip(-s[t, :, :2] - s[t, :, 2:] + rng.normal(size=(n_episodes, 2)), -2.0, 2.0)
        s[t + 1] = mpc.dynamics_function(s[t].T, u[t].T, mpc.theta).full().T
    before, after = s[:-1].swapaxes(0, 1).reshape(-1, 4), s[1:].swapaxes(0, 1).reshape(-1, 4)
    inputs = u.swapaxes(0, 1).reshape(-1, 2)
    costs = cost(after if reached else before, inputs)
    episodes = np.repeat(np.arange(n_episodes), n_steps)
    return TransitionTable.from_arrays(before, inputs, costs, after, np.zeros(len(costs)), episodes)


def distance(s: Array, u: Array) -> Array:
    return np.hypot(s[:, 0], s[:, 1]) + 0.1 * np.sum(u**2, axis=1)


def absolute(s: Array, u: Array) -> Array:
    return np.abs(s[:, 0]) + 3.0 * np.abs(s[:, 1] - 0.2) + 0.5 * np.abs(u[:, 0]) + 0.5 * np.abs(u[:, 1])


def quadratic(s: Array, u: Array) -> Array:
    return np.asarray(np.einsum("bi,ij,bj->b", s, W, s) + np.einsum("bi,ij,bj->b", u, R, u))


@pytest.mark.parametrize("reached", [False, True])
@pytest.mark.parametrize("cost", [distance, absolute])
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-6, -3.0), (1e5, 1e6)])
def test_a_distance_is_found_in_any_unit(cost: Cost, reached: bool, scale: float, offset: float) -> None:
    found = agreeing_cost(mpc_of(), walks(lambda s, u: offset + scale * cost(s, u), reached=reached))
    assert found is not None
    mpc, known = found
    assert (known.regressed, known.reached, known.agreeing, known.scale, known.offset) == (True, reached, 1.0, 1.0, 0.0)
    away = walks(cost, reached=False, seed=5).values()  # other rows; kinks are rounded, near the goal alone
    ours = mpc.stage_function(away.observations.T, away.actions.T, mpc.theta).full().ravel()
    missed = np.abs((ours - offset) / scale - cost(away.observations, away.actions))
    assert np.median(missed) < 1e-2
    assert missed.max() < 0.1
    assert str(known).startswith(f"L = a quadratic with norms{' of the state reached' if reached else ''}, up to")


@pytest.mark.parametrize("reached", [False, True])
def test_weights_of_the_given_cost_come_first(reached: bool) -> None:
    """What the MPC's own cost explains needs no other, nor does a quadratic."""
    found = agreeing_cost(mpc_of(0.5), walks(lambda s, u: 3.0 + quadratic(s, u), reached=reached))
    assert found is not None
    assert (found[1].reached, found[1].regressed) == (reached, False)
    assert found[1].scale == pytest.approx(2.0, rel=1e-5)
    assert found[1].offset == pytest.approx(3.0, rel=1e-5)


@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_noise_is_no_norm(noise: float) -> None:
    rng = np.random.default_rng(0)

    def noisy(s: Array, u: Array) -> Array:
        return distance(s, u) + noise * rng.normal(size=len(s))

    assert agreeing_cost(mpc_of(), walks(noisy, reached=True)) is None


@pytest.mark.parametrize("repeated", [1, 5])
def test_of_a_few_rows_nothing_is_exact(repeated: int) -> None:
    """A smooth cost that is no norm, of few rows, also where each is logged five times."""

    def smooth(s: Array, u: Array) -> Array:
        return np.log(1.0 + s[:, 0] ** 2 + s[:, 1] ** 2) + 0.1 * np.sum(u**2, axis=1)

    few = walks(smooth, reached=False, n_episodes=4)
    assert agreeing_cost(mpc_of(), TransitionTable.concat([few] * repeated)) is None


def test_costs_of_the_state_reached_leave_the_last_to_the_terminal_cost() -> None:
    """sum_k L(x_k+1, u_k) = sum_k L(x_k, u_k) + Lx(x_N) - Lx(x_0)."""
    mpc, rng = mpc_of(), np.random.default_rng(0)
    x, u = rng.normal(size=(16, 4)), rng.normal(size=(15, 2))
    known = KnownCost(reached=True)
    of_reached, of_left = quadratic(x[1:], u).sum(), quadratic(x[:-1], u).sum()
    ends = known.of_state(mpc, x[[-1, 0]])
    assert of_reached == pytest.approx(of_left + ends[0] - ends[1])
    np.testing.assert_array_equal(KnownCost().of_state(mpc, x), 0.0)
    assert KnownCost.from_json(known.__dict__) == known


def test_the_terminal_cost_holds_it() -> None:
    """V of a table whose costs are all of s+ and T differ by Lx, and by a constant."""
    table = walks(quadratic, reached=True)
    mpc = mpc_of()

    class Value(torch.nn.Module):
        def forward(self, s: torch.Tensor) -> torch.Tensor:
            return 7.0 * s[:, 0] ** 2 + s[:, 2] ** 2

    result = FitResult(mpc.theta, 1.0, 1.0)
    known = Known(mpc, table, ("cost",), value_function=Value(), result=result)  # type: ignore[arg-type]
    s = table.values().observations[:200]
    costs = []
    for cost in (None, KnownCost(scale=2.0), KnownCost(scale=2.0, reached=True)):
        made = with_terminal_cost(replace(known, cost=cost), TerminalConfig("quadratic")).mpc
        costs.append(made.terminal_function(s.T, made.theta).full().ravel())
    lx = quadratic(s, np.zeros((200, 2)))
    V = 7.0 * s[:, 0] ** 2 + s[:, 2] ** 2
    for T, expected in zip(costs, (V, V / 2.0, V / 2.0 + lx), strict=True):
        np.testing.assert_allclose(T - T.mean(), expected - expected.mean(), atol=1e-3 * expected.std())


def test_ends_cost_what_the_log_says() -> None:
    """Lhat(s+,a) + price = L: the plan pays Lhat(s,a), and at the end T, which holds the price and Lx."""
    table = walks(quadratic, reached=True)
    columns = table.values()
    over = np.arange(len(table)) % 30 == 29
    costs = columns.costs + np.where(over, 5_000.0, 0.0)
    ended = TransitionTable.from_arrays(
        columns.observations, columns.actions, costs, columns.next_observations, over, table.episode_ids
    )
    mpc = mpc_of()
    found = priced_ends(mpc, ended, KnownCost(reached=True))
    assert found is not None
    lx = quadratic(columns.next_observations[over], np.zeros((over.sum(), 2)))
    np.testing.assert_allclose(found.values, 5_000.0 / mpc.discount + lx, rtol=1e-6)


@pytest.mark.parametrize("cost", [distance, quadratic])
def test_simulations_cost_what_is_reached(cost: Cost) -> None:
    table = walks(cost, reached=True)
    learned = LoggedCost(table, mpc=mpc_of())
    fresh = walks(cost, reached=True, seed=3).values()
    found = learned(fresh.observations, fresh.actions, fresh.next_observations)
    np.testing.assert_allclose(found, fresh.costs, atol=0.03 * fresh.costs.std())
    assert learned.known is not None
    assert "of the state reached" in str(learned)


def test_what_is_learned_from_a_distance_is_nearly_the_best() -> None:
    """Against an MPC with the distance itself as its stage cost; MPC_1's squares ask for less near the goal."""
    plant = mpc_of()
    learner = OfflineMPCLearner(plant, seed=0, value_n_steps=1_000, polyak=0.06)
    learner.fit(walks(distance, reached=True))
    assert learner.candidates is not None
    assert "logged cost" in learner.candidates

    class Distance:
        nx = 4

        def __init__(self) -> None:
            self.space = ParameterSpace([])

        def expression(self, x: ca.SX, u: ca.SX, _: object) -> ca.SX:
            return ca.sqrt(x[0] ** 2 + x[1] ** 2 + 1e-4) + 0.1 * ca.sumsqr(u)

        def terminal_expression(self, x: ca.SX, _: object) -> ca.SX:
            return ca.sqrt(x[0] ** 2 + x[1] ** 2 + 1e-4)

    best = plant.replace(stage_cost=Distance(), terminal_cost=Distance(), horizon=40, discount=1.0)

    def closed_loop(mpc: MPC) -> float:
        policy, rng = MPCPolicy(mpc), np.random.default_rng(1)
        s, state, total = np.hstack([rng.uniform(-2.0, 2.0, (16, 2)), np.zeros((16, 2))]), None, 0.0
        for _ in range(40):
            u, state = policy.predict(s, state)
            s = plant.dynamics_function(s.T, u.T, plant.theta).full().T
            total += distance(s, u).mean()
        return total

    learned, given, least = (closed_loop(each) for each in (learner.mpc, plant, best))
    assert learned < 1.02 * least
    assert given > 1.03 * least
