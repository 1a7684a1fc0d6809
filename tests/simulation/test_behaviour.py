"""Clones of controllers that are known: a gain, a saturated one, PI control; and agreement of models with a log."""

from __future__ import annotations

from collections.abc import Callable

import lq_plant
import numpy as np
import pytest
from lq_episodes import episodes
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.mpc import MPC
from mpcoffline.mpc.layout import Layout
from mpcoffline.simulation.behaviour import Agreement, Behaviour, Returns, agreement
from mpcoffline.simulation.models import LogModels

Array = NDArray[np.float64]
PLAIN = Layout.of(2, 1)


def logged(act: object, *, n: int = 20, steps: int = 40, seed: int = 0) -> TransitionTable:
    """Episodes of the linear plant under ``act(x, memory) -> (u, memory)`` for all of them at once."""
    rng = np.random.default_rng(seed)
    x, memory, rows = rng.uniform(-1.0, 1.0, (n, 2)), None, []
    for _ in range(steps):
        u, memory = act(x, memory)  # type: ignore[operator]
        reached = x @ lq_plant.A.T + u @ lq_plant.B.T
        rows.append((x, u, reached))
        x = reached
    s, a, after = (np.stack(part, axis=1).reshape(n * steps, -1) for part in zip(*rows, strict=True))
    cost = lq_plant.quadratic(lq_plant.W, s) + lq_plant.quadratic(lq_plant.R, a)
    return TransitionTable.from_arrays(s, a, cost, after, np.zeros(n * steps), np.repeat(np.arange(n), steps))


def test_a_gain_is_found() -> None:
    table = logged(lambda x, _: (x @ lq_plant.GAIN.T, None))
    clone = Behaviour.of(table, PLAIN)
    assert clone.share == pytest.approx(1.0, abs=1e-5)
    assert not clone.remembers
    x = np.array([[0.2, -0.1], [0.05, 0.1]])
    np.testing.assert_allclose(clone.predict(x)[0], x @ lq_plant.GAIN.T, atol=1e-4)
    np.testing.assert_allclose(clone.predict(x[0])[0], lq_plant.GAIN @ x[0], atol=1e-4)
    far = clone.predict(np.array([[50.0, 50.0]]))[0]  # as MPCs, it knows bounds: those of the log
    assert far[0, 0] == pytest.approx(table.actions.min())


def test_what_is_tried_at_random_is_no_part_of_it_and_its_share_says_so() -> None:
    clone = Behaviour.of(episodes(n=40), PLAIN)  # the gain, and uniform noise in [-2, 2]
    table = episodes(n=40, seed=5)
    s, u = (v.astype(np.float64) for v in (table.observations, table.actions))
    policy = s @ lq_plant.GAIN.T
    np.testing.assert_allclose(clone.predict(s)[0], policy, atol=0.3)
    assert 0.1 < clone.share < 0.7
    tried = clone.deviations(table, np.array([0, 45]), 20)
    np.testing.assert_allclose(tried[0], (u - policy)[:20], atol=0.3)
    assert (tried[1, 15:] == 0.0).all()  # the second episode has ended


def test_a_saturated_one_needs_the_network() -> None:
    table = logged(lambda x, _: (-2.0 * np.tanh(2.0 * x[:, :1] + 1.5 * x[:, 1:]), None))
    clone = Behaviour.of(table, PLAIN)
    s, u = (v.astype(np.float64) for v in (table.observations, table.actions))
    missed = u - np.hstack([s, np.ones((len(s), 1))]) @ np.linalg.lstsq(np.hstack([s, np.ones((len(s), 1))]), u)[0]
    assert clone.share > 0.9
    assert 1.0 - clone.share < 0.3 * missed.var() / u.var()


def test_a_pi_controller_is_found_by_what_it_did_before() -> None:
    def act(x: Array, integral: Array | None) -> tuple[Array, Array]:
        integral = (np.linspace(-2.0, 2.0, len(x)) if integral is None else integral) + 0.1 * x[:, 0]
        return -(2.5 * x[:, :1] + 1.5 * x[:, 1:] + integral[:, None]), integral

    table = logged(act)
    clone = Behaviour.of(table, PLAIN)
    assert clone.remembers
    assert clone.share > 0.999
    before = np.array([[0.3, -0.2]])
    u, state = clone.predict(before)
    now = before @ lq_plant.A.T + u @ lq_plant.B.T
    expected = u - (now - before) @ np.array([[2.5], [1.5]]) - 0.1 * now[:, :1]
    np.testing.assert_allclose(clone.predict(now, state)[0], expected, atol=1e-3)


def test_inputs_that_never_vary_and_one_row_are_cloned() -> None:
    table = logged(lambda x, _: (np.full((len(x), 1), 0.25), None), n=3, steps=5)
    clone = Behaviour.of(table, PLAIN)
    assert clone.share == 1.0
    assert clone.predict(np.zeros((2, 2)))[0].tolist() == [[0.25], [0.25]]
    assert Behaviour.of(table.take(slice(0, 1)), PLAIN).predict(np.ones((1, 2)))[0].tolist() == [[0.25]]


def agreeing(
    mpc: MPC, table: TransitionTable, paid: Callable[[Array], Array] | None = None
) -> tuple[LogModels, Agreement]:
    models = LogModels.of(mpc, table, identify_one_step(mpc, table), n_perturbed=0, n_residual=0)
    clone, rows = Behaviour.of(table, PLAIN), table.episodes.firsts[:8]
    policy = clone.replaying(clone.deviations(table, rows, 30))

    def cost(x: Array, u: Array, _: Array) -> Array:
        return lq_plant.quadratic(lq_plant.W, x) + lq_plant.quadratic(lq_plant.R, u)

    return models, agreement(models, cost, table, policy, rows, 30, paid)


def test_the_right_model_reproduces_the_costs_of_the_log_and_a_wrong_one_does_not() -> None:
    table = episodes(n=40)
    _, right = agreeing(lq_plant.make_mpc((lq_plant.A, lq_plant.B)), table)
    np.testing.assert_allclose(right.simulated[0], right.logged, rtol=1e-3)
    assert abs(right.deviations[0]) < 1e-4
    assert right.scatters[0] < 1e-3
    first = table.take(table.episodes.rows(0)).costs.sum()
    assert right.logged[0] == pytest.approx(first, rel=1e-5)
    _, wrong = agreeing(lq_plant.make_mpc((lq_plant.A + 0.05, lq_plant.B)), table)
    assert wrong.scatters[0] > 0.1


def test_what_an_end_costs_is_part_of_what_models_say_of_the_log() -> None:
    plain = episodes(n=40, steps=30)
    columns, last = plain.values(), np.zeros(len(plain), dtype=bool)
    last[plain.episodes.firsts + plain.episodes.lengths - 1] = True
    parts = columns.observations, columns.actions, columns.costs + 7.0 * last, columns.next_observations, last
    table = TransitionTable.from_arrays(*parts, plain.episode_ids)
    mpc = lq_plant.make_mpc((lq_plant.A, lq_plant.B))
    _, without = agreeing(mpc, table)
    _, found = agreeing(mpc, table, lambda s: np.full(len(s), 7.0))
    np.testing.assert_allclose(found.simulated[0], found.logged, rtol=1e-3)
    np.testing.assert_allclose(without.logged - without.simulated[0], 7.0, rtol=1e-2)


def test_returns_are_those_of_the_episodes_with_their_spread() -> None:
    table = episodes(n=12, steps=10)
    found = Returns.of(table)
    costs = table.costs.astype(np.float64).reshape(12, 10)
    np.testing.assert_allclose(found.costs, costs.sum(axis=1))
    mean, error = found.per_step
    assert mean == pytest.approx(costs.mean())
    assert error == pytest.approx(costs.mean(axis=1).std(ddof=1) / np.sqrt(12))
    assert np.isnan(Returns.of(table.take(slice(0, 10))).per_step[1])
