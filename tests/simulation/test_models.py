"""Models of logs against plants whose maps, disturbances and prediction errors are known in closed form."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import lq_plant
import numpy as np
import pytest
from late_plants import belt_log, belt_mpc
from lq_episodes import episodes
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable
from mpcoffline.datasets.table.memory import with_memory
from mpcoffline.estimation import identify
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.mpc.integrators import Scheme
from mpcoffline.simulation.members import finer
from mpcoffline.simulation.models import STEPS, LogModels

Array = NDArray[np.float64]

LOG = episodes()


def models_of(mpc: MPC, log: TransitionTable, **options: int) -> LogModels:
    found = identify_one_step(mpc, log)
    return LogModels.of(mpc.with_theta(found.theta), log, found, **options)


def walk_mpc(drift: float) -> MPC:
    """X+ = x + drift + u, without parameters."""
    model = Model(lambda x, u, _: x + u + drift, 1, 1, 1.0, {}, discrete=True)
    return MPC(model, QuadraticCost([[1.0]], [[1.0]]), QuadraticCost([[1.0]]), 5, 0.9, [-1.0], [1.0])


def walk_log(drift: float, w: Array, seed: int = 0) -> TransitionTable:
    """Episodes ``(E, T)`` of the walk under random inputs, with disturbances w of each step."""
    rng, (n, steps) = np.random.default_rng(seed), w.shape
    u = rng.uniform(-1.0, 1.0, w.shape).astype(np.float32).astype(np.float64)
    x = np.cumsum(np.hstack([rng.uniform(-1.0, 1.0, (n, 1)), u + drift + w]), axis=1)
    zeros = np.zeros(n * steps)
    flat = [v.reshape(-1, 1) for v in (x[:, :-1], u, x[:, 1:])]
    return TransitionTable.from_arrays(flat[0], flat[1], zeros, flat[2], zeros, np.repeat(np.arange(n), steps))


def test_the_first_is_the_identified_model_and_the_moved_ones_are_near() -> None:
    models = models_of(lq_plant.make_mpc(), LOG)
    assert models.names == ("identified", *(f"moved {i}" for i in range(1, 6)))  # nothing is missed: no networks
    rng = np.random.default_rng(1)
    x, u = rng.uniform(-1, 1, (7, 2)), rng.uniform(-1, 1, (7, 1))
    reached = models.step(np.broadcast_to(x, (6, 7, 2)), np.broadcast_to(u, (6, 7, 1)))
    expected = x @ lq_plant.A.T + u @ lq_plant.B.T
    np.testing.assert_allclose(reached[0], expected, atol=1e-6)
    distances = np.abs(reached - expected).max(axis=(1, 2))
    assert (distances[1:] > 1e-4).all()  # moved, though the data leave no doubt
    assert (distances < 0.1).all()
    assert models.votes[0]
    assert models.errors[0] < 1e-4 < models.errors[1:].min()
    again = models_of(lq_plant.make_mpc(), LOG)
    np.testing.assert_array_equal(again.members.thetas, models.members.thetas)


def test_networks_know_what_the_structure_misses_and_have_the_vote() -> None:
    models = models_of(lq_plant.make_mpc(), episodes(n=60, friction=0.1), n_residual=3)
    assert models.names[-3:] == ("residual 1", "residual 2", "residual 3")
    test = episodes(n=20, friction=0.1, seed=9).values()
    s, a = (np.broadcast_to(v, (9, *v.shape)) for v in (test.observations, test.actions))
    errors = np.sqrt(np.mean((models.step(s, a) - test.next_observations) ** 2, axis=(1, 2)))
    assert errors[6:].max() < 0.5 * errors[:6].min()
    assert models.errors[6:].max() < 0.5 * models.errors[:6].min()
    assert not models.votes[:6].any()


def test_the_error_is_that_of_the_prediction_in_spreads_of_the_state() -> None:
    """A model whose drift is off by 0.1 is off by 0.1 k after k steps, whatever the inputs."""
    log = walk_log(0.0, np.zeros((20, 40)))
    models = models_of(walk_mpc(0.1), log, n_residual=0)
    assert models.names == ("identified",)  # there is no parameter to move
    held_out = models.errors[0] * log.observations.std()
    assert held_out == pytest.approx(0.1 * np.sqrt(np.mean(np.arange(1, STEPS + 1) ** 2)), rel=0.2)  # of other rows
    assert models.votes.tolist() == [True]


def test_no_model_has_a_vote_where_the_best_predicts_no_better_than_none() -> None:
    log = walk_log(0.5, 1e-3 * np.random.default_rng(0).normal(size=(20, 40)))
    actions = np.zeros_like(log.actions)
    states = np.cumsum(np.full((20, 41), 0.5), axis=1)
    flat = states[:, :-1].reshape(-1, 1), states[:, 1:].reshape(-1, 1)
    still = TransitionTable.from_arrays(flat[0], actions, log.costs, flat[1], log.terminations, log.episode_ids)
    models = models_of(walk_mpc(0.4), still, n_residual=0)
    assert models.baseline == pytest.approx(0.0, abs=1e-6)  # it goes on by its mean increment, exactly
    assert not models.votes.any()


def test_a_model_that_diverges_has_an_infinite_error_and_no_vote() -> None:
    unstable = lq_plant.make_mpc((3.0 * np.eye(2), np.zeros((2, 1))))
    models = LogModels.of(unstable, LOG, None, n_perturbed=0, n_residual=0)
    assert models.names == ("given",)
    assert models.errors.tolist() == [np.inf]
    assert not models.votes.any()


def test_replayed_errors_are_the_disturbances_of_the_log_and_zero_after_an_episode() -> None:
    w = 0.3 * np.random.default_rng(0).uniform(-1.0, 1.0, (12, 20))
    w[3, 4] = 1e3  # one row that is no disturbance
    log = walk_log(0.2, w)
    models = models_of(walk_mpc(0.2), log, n_residual=0)
    rows = np.array([0, 45, 70, 3 * 20])
    replayed = models.replayed(log, rows, 30)
    assert replayed.shape == (1, 4, 30, 1)
    np.testing.assert_allclose(replayed[0, 1, :15, 0], w[2, 5:], atol=2e-3)
    assert (replayed[0, 1, 15:] == 0.0).all()
    assert abs(replayed[0, 3, 4, 0]) <= 0.3
    x = np.broadcast_to(log.observations[rows[:1]].astype(np.float64), (1, 1, 1))
    for k in range(20):
        u = np.broadcast_to(log.actions[k].astype(np.float64), (1, 1, 1))
        x = models.step(x, u) + replayed[:, :1, k]
    np.testing.assert_allclose(x[0, 0], log.next_observations[19], atol=1e-2)  # the log, step by step


def test_wrapped_angles_stay_within_the_logs_turn() -> None:
    """A wheel that turns by 0.4 + u a step; its angle is logged within [0, 2 pi)."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-0.2, 0.2, (20, 50))
    angle = np.cumsum(np.hstack([rng.uniform(0.0, 6.0, (20, 1)), 0.4 + u]), axis=1) % (2.0 * np.pi)
    zeros, ids = np.zeros(1000), np.repeat(np.arange(20), 50)
    flat = [v.reshape(-1, 1) for v in (angle[:, :-1], u, angle[:, 1:])]
    log = TransitionTable.from_arrays(flat[0], flat[1], zeros, flat[2], zeros, ids)
    models = models_of(walk_mpc(0.4), log)
    assert models.errors[0] < 1e-4
    x = np.broadcast_to(log.observations.astype(np.float64), (1, 1000, 1))
    reached = models.step(x, np.broadcast_to(log.actions.astype(np.float64), (1, 1000, 1)))
    off = reached[0] - log.next_observations
    off -= 2.0 * np.pi * np.round(off / (2.0 * np.pi))
    np.testing.assert_allclose(off, 0.0, atol=1e-5)
    assert reached.min() > -0.1
    assert reached.max() < 2.0 * np.pi + 0.1
    assert np.abs(models.replayed(log, np.array([0, 500]), 50)).max() < 1e-5


def test_past_inputs_and_noise_are_known() -> None:
    """A belt with a dead time of two steps, measured with noise."""
    log = belt_log(2, noise=0.1)
    mpc = belt_mpc(2)
    table = with_memory(log, mpc.layout)
    found = identify(mpc, table)
    models = LogModels.of(mpc.replace(model=found.model), found.table, found, n_perturbed=1)
    assert models.noise == pytest.approx(0.1, rel=0.2)
    decay, gain = (float(found.theta[mpc.space.slices[f"model.{name}"]][0]) for name in ("decay", "gain"))
    z, u = np.array([2.0, 0.3, 0.8]), np.array([0.5])  # flow, the inputs one and two steps ago
    reached = models.step(np.tile(z, (len(models), 1, 1)), np.tile(u, (len(models), 1, 1)))
    np.testing.assert_allclose(reached[0, 0], [decay * 2.0 + gain * 0.8 + 0.1, 0.5, 0.3], rtol=1e-9)
    assert (models.replayed(found.table, np.array([0]), 5).shape) == (len(models), 1, 5, 1)


def test_a_model_that_is_not_finite_is_judged_and_stepped() -> None:
    def step(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return p["A"] @ x + p["B"] @ u + ca.sqrt(x[0] + 0.5) - ca.sqrt(x[0] + 0.5)

    parameters = {"A": lq_plant.MODEL_A, "B": lq_plant.MODEL_B}
    mpc = lq_plant.make_mpc().replace(model=Model(step, 2, 1, 0.1, parameters, discrete=True))
    models = LogModels.of(mpc, LOG, None, n_perturbed=2, n_residual=2)
    assert np.isfinite(models.replayed(LOG, np.array([0, 30]), 30)).all()
    assert len(models.votes) == len(models)


def test_simulations_take_finer_steps_where_states_farther_out_ask_for_them() -> None:
    """Near rest x' = -x^3 is slow; from x = 8 one RK4 step of .1 blows up, the plant does not."""
    model = Model(lambda x, u, _: -(x**3) + u, 1, 1, 0.1, {})
    mpc = MPC(
        model.with_scheme(Scheme("rk4")), QuadraticCost([[1.0]], [[1.0]]), QuadraticCost([[1.0]]), 5, 0.9, [-1.0], [1.0]
    )
    still, fast = (np.linspace(-far, far, 200)[:, None] for far in (0.1, 4.0))
    assert finer(mpc, still, 0.0 * still).model.scheme == Scheme("rk4", 1)
    found = finer(mpc, fast, 0.0 * fast).model
    assert found.scheme is not None
    assert found.scheme.substeps > 4
    exact = 8.0 / np.sqrt(1.0 + 2.0 * 64.0 * 0.1)
    assert float(found([8.0], [0.0])[0]) == pytest.approx(exact, rel=0.05)
    assert abs(float(mpc.model([8.0], [0.0])[0])) > 100.0
    fixed = mpc.replace(model=Model(lambda x, u, _: -x + u * x, 1, 1, 0.1, {}, integrator="rk4"))
    assert finer(fixed, fast, fast) is fixed
    linear = lq_plant.make_mpc((lq_plant.A, lq_plant.B))
    assert finer(linear, np.ones((3, 2)), np.ones((3, 1))) is linear


def test_a_model_without_a_vote_is_not_asked_while_controllers_are_chosen() -> None:
    models = replace(models_of(walk_mpc(0.0), walk_log(0.0, np.zeros((8, 20)))), names=("identified", "b", "c"))
    models = replace(models, errors=np.array([0.5, 0.03, 0.03]), baseline=1.0, members=_Three())  # type: ignore[arg-type]
    assert models.asked(2, identified=False).names == ("b", "c")
    assert models.asked(2).names == ("identified", "b", "c")


class _Three:
    def some(self, kept: NDArray[np.bool_]) -> int:
        return int(kept.sum())


def test_what_the_plant_cut_off_is_no_error_of_a_model() -> None:
    """A store that takes what fits, up to about 10: known from the rows in which costs agree."""
    rng, n, steps = np.random.default_rng(0), 20, 40
    x, u = np.empty((n, steps + 1)), rng.uniform(-1.0, 1.0, (n, steps)) + rng.choice([-1.5, 1.5], (n, 1))
    x[:, 0] = rng.uniform(0.0, 10.0, n)
    for k in range(steps):
        x[:, k + 1] = np.clip(x[:, k] + u[:, k], 0.0, 10.0 - 0.02 * x[:, k])  # no two full ones are alike
    applied = np.abs(x[:, :-1] + u - x[:, 1:]) < 1e-9
    parts = [v.reshape(-1, 1) for v in (x[:, :-1], u, x[:, 1:])]
    log = TransitionTable.from_arrays(
        parts[0], parts[1], applied.ravel().astype(float), parts[2], np.zeros(n * steps), np.repeat(np.arange(n), steps)
    )  # its "costs" say where the input was applied

    def believed(table: TransitionTable) -> NDArray[np.bool_]:
        return np.asarray(table.costs) > 0.5

    mpc = walk_mpc(0.0)
    blind, seeing = (LogModels.of(mpc, log, None, n_residual=2, believed=each) for each in (None, believed))
    assert seeing.errors[0] < 1e-5  # float32's
    assert seeing.votes[0]
    assert "residual 1" not in seeing.names  # nothing is missed
    states = np.full((len(seeing), 1, 1), 9.0)
    assert float(seeing.step(states, np.full_like(states, 3.0)).max()) == pytest.approx(9.8, abs=0.05)
    rows = np.arange(0, n * steps, steps)
    np.testing.assert_allclose(seeing.replayed(log, rows, steps, believed), 0.0, atol=1e-5)
    assert np.abs(blind.replayed(log, rows, steps)[0]).max() > 0.3
    nowhere = LogModels.of(mpc, log, None, n_residual=0, believed=lambda table: np.zeros(len(table), dtype=bool))
    assert np.isfinite(nowhere.errors).all()
