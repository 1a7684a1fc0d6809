"""Trials on models of a log against closed loops and sums that are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import lq_plant
import numpy as np
import pytest
from late_plants import belt_mpc
from lq_episodes import episodes
from lq_plant import BEST
from numpy.typing import NDArray

from mpcoffline import MPCPolicy
from mpcoffline.control import OutputFeedbackPolicy
from mpcoffline.control.course import Course
from mpcoffline.core.errors import FileFormatError
from mpcoffline.datasets import TransitionTable
from mpcoffline.datasets.table.memory import with_memory
from mpcoffline.estimation import Sensors, identify
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.mpc import MPC
from mpcoffline.simulation.choice import FIRST, choose, various_first
from mpcoffline.simulation.logged_cost import LoggedCost
from mpcoffline.simulation.models import LogModels
from mpcoffline.simulation.starts import cheapest_step, costs_before, initial_rows, returns_along
from mpcoffline.simulation.surroundings import surroundings_of
from mpcoffline.simulation.trials import Surroundings, Trials

Array = NDArray[np.float64]

LOG = episodes()
TRUE_MPC = lq_plant.make_mpc((lq_plant.A, lq_plant.B))
_X, _U = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
OUTPUTS = [_X[0] + 2.0 * _X[1], _X[0] + 2.0 * _X[1] + 0.5 * _U[0]]


def place(mpc: MPC, log: TransitionTable, rows: list[int], n_steps: int, members: int = 0) -> Surroundings:
    found = identify_one_step(mpc, log)
    models = LogModels.of(mpc, log, found, n_perturbed=members, n_residual=0)
    return Surroundings(models, LoggedCost(log, seen=mpc.ny), log, np.array(rows), n_steps, mpc.layout)


def test_a_trial_is_the_closed_loop_of_the_optimal_gain() -> None:
    around = place(TRUE_MPC, LOG, [0, 30, 60, 90, 120], 40)
    done = around.act([MPCPolicy(TRUE_MPC)], kept=2)[0]
    x, expected = LOG.observations[[0, 30, 60, 90, 120]].astype(np.float64), np.zeros(5)
    for _ in range(40):
        u = x @ BEST.K.T
        expected += lq_plant.quadratic(lq_plant.W, x) + lq_plant.quadratic(lq_plant.R, u)
        x = x @ lq_plant.A.T + u @ lq_plant.B.T
    np.testing.assert_allclose(done.cost[0], expected, rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(done.second, done.cost)  # a quadratic is exact: there is no other opinion
    assert not done.lost.any()
    assert done.states.shape == (5, 41, 2)
    np.testing.assert_array_equal(done.states_kept[0], done.states[:2])
    np.testing.assert_array_equal(done.actions_kept[0], done.actions[:2])
    assert done.states_kept.shape == (len(around.models), 2, 41, 2)
    some = around.act([MPCPolicy(TRUE_MPC)], slice(1, 3))[0]
    np.testing.assert_allclose(some.cost, done.cost[:, 1:3], rtol=1e-6)
    assert some.states_kept.shape[1] == 0


def test_what_an_episode_costs_at_least_is_known_from_its_steps() -> None:
    """The cheapest step of log and simulation, times the steps; an episode that may end costs nothing afterwards."""
    around = place(TRUE_MPC, LOG, [0, 30, 60], 40)
    assert around.least == cheapest_step(LOG) == pytest.approx(float(LOG.costs.min()))
    trials = Trials.none(["MPC_1"], around)
    assert trials.floor == 40 * around.least
    done = trials.fill({"MPC_1": MPCPolicy(TRUE_MPC)}, around, slice(None))["MPC_1"]
    x, u = done.states, done.actions
    steps = [around.cost(x[:, k], u[:, k], x[:, k + 1]) for k in range(40)]
    assert done.least[0] == pytest.approx(float(np.min(steps)), rel=1e-9)
    assert trials.floor == pytest.approx(40 * min(around.least, float(done.least[0])))
    assert (trials.floor <= trials.cost).all()
    assert Trials.from_arrays(trials.names, trials.models, trials.to_arrays()).floor == -np.inf  # nobody has looked
    columns = LOG.values()
    ends = np.zeros(len(LOG), dtype=bool)
    ends[-1] = True
    parts = columns.observations, columns.actions, columns.costs + 5.0, columns.next_observations
    assert cheapest_step(TransitionTable.from_arrays(*parts, ends)) == 0.0


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_behind_sensors_an_mpc_sees_outputs_and_a_clone_of_the_logged_controller_states(share: float) -> None:
    """Against a loop of its own: a Kalman filter from where episodes begin, and the same noise for each controller."""
    noise, process, start = np.array([0.3]), np.array([0.05, 0.02]), np.array([1.0, -0.5])
    h = ca.Function("outputs", [_X, _U] if share else [_X], [OUTPUTS[bool(share)]])
    sensors = Sensors(h, noise, process, start, np.array([2.0, 2.0]))
    rows, n_steps = np.array([0, 30, 60]), 25
    models = LogModels.of(TRUE_MPC, LOG, identify_one_step(TRUE_MPC, LOG), n_perturbed=2, n_residual=0)
    cost = LoggedCost(LOG, seen=2)
    around = Surroundings(models, cost, LOG, rows, n_steps, TRUE_MPC.layout, seed=4, sensors=sensors)
    plain = Surroundings(models, cost, LOG, rows, n_steps, TRUE_MPC.layout, seed=4)
    controller = around.seeing(MPCPolicy(TRUE_MPC))
    assert isinstance(controller, OutputFeedbackPolicy)
    behind, seeing = around.act([controller, MPCPolicy(TRUE_MPC)], kept=3)
    # The same but for rounding: costs of a batch of another size are summed in another order.
    np.testing.assert_allclose(seeing.cost, plain.act([MPCPolicy(TRUE_MPC)])[0].cost, rtol=1e-13)
    for m in range(len(models)):
        x, state, expected = LOG.observations[rows].astype(np.float64), None, np.zeros(3)
        policy = OutputFeedbackPolicy(MPCPolicy(TRUE_MPC), sensors.observer(TRUE_MPC))
        u = np.full((3, 1), 1e3)  # before the first step: nobody may look at what it would show
        for k in range(n_steps):
            y = x[:, :1] + 2.0 * x[:, 1:] + share * u + around.output_noise[k]
            u, state = policy.predict(y, state)
            reached = models.step(np.tile(x, (len(models), 1, 1)), np.tile(u, (len(models), 1, 1)))[m]
            reached += around.disturbances[m, :, k]
            expected += cost(x, u.astype(np.float64), reached)
            x = reached
        np.testing.assert_allclose(behind.cost[m], expected, rtol=1e-6)
    assert around.reordered(np.array([2, 0, 1])).output_noise[3, 0] == around.output_noise[3, 2]


def test_a_disturbance_of_the_log_meets_every_controller_again() -> None:
    """The logged inputs on the exact model give the logged states, whatever disturbed them."""
    rng = np.random.default_rng(0)
    pushed = LOG.values()
    push = 0.01 * rng.standard_normal(pushed.next_observations.shape)
    x, rows = LOG.observations[0].astype(np.float64), []
    for k in range(30):
        reached = lq_plant.A @ x + lq_plant.B @ pushed.actions[k] + push[k]
        rows.append((x, pushed.actions[k], 0.0, reached, 0.0))
        x = reached
    log = TransitionTable.from_arrays(*(np.array(part) for part in zip(*rows, strict=True)))
    around = place(TRUE_MPC, log, [0], 30)

    class Replay:
        k = 0

        def predict(self, observation: Array, state: object = None) -> tuple[Array, None]:
            action = log.actions[self.k].astype(np.float64)
            self.k += 1
            return np.broadcast_to(action, (len(observation), 1)), None

    np.testing.assert_allclose(
        around.act([Replay()])[0].states[0, 1:], log.next_observations, atol=1e-2
    )  # but outliers


def test_a_state_that_runs_away_is_lost_and_dear() -> None:
    unstable = lq_plant.make_mpc((3.0 * np.eye(2), np.zeros((2, 1))))
    log = LOG.take(np.arange(60))
    around = place(unstable, log, [0, 30], 30)
    around.starts[1], around.disturbances[:] = 0.0, 0.0
    done = around.act([MPCPolicy(TRUE_MPC)])[0]
    assert done.lost.tolist() == [[True, False]]
    assert done.cost[0, 0] > 10 * log.costs.max()
    assert np.isfinite(done.cost).all()


def test_past_inputs_that_the_log_hardly_varied_are_no_state_that_runs_away() -> None:
    """The log holds a belt's input near 0.1; the policy needs up to 1, one step late."""
    mpc, rng, parts = belt_mpc(1, gain=0.5, decay=0.9), np.random.default_rng(0), []
    for e in range(30):
        x, before = rng.uniform(0.0, 5.0), 0.1
        for _ in range(20):
            u, reached = 0.1 + 0.002 * rng.normal(), 0.9 * x + 0.5 * before + 0.1
            parts.append(([x], [u], (x - 3.0) ** 2 + 0.02 * u**2, [reached], False, e))
            x, before = reached, u
    log = with_memory(TransitionTable.from_arrays(*(np.array(part) for part in zip(*parts, strict=True))), mpc.layout)
    around = place(mpc, log, [0], 30)
    around.starts[:], around.disturbances[:] = [0.5, 0.1], 0.0
    done = around.act([MPCPolicy(mpc)])[0]
    assert done.actions.max() > 0.9
    assert not done.lost.any()
    assert done.states[0, -1, 0] == pytest.approx(3.0, abs=0.3)


def test_starts_are_those_of_the_log() -> None:
    assert set(initial_rows(LOG, 12, 3)) <= set(range(0, 600, 30))
    assert len(initial_rows(LOG, 50, 0)) == 50  # more than there are episodes
    rows = initial_rows(LOG, 12, 3, spare=30)
    assert len(rows) == 42
    assert set(range(0, 600, 30)) <= set(rows)  # all first ones before any other
    assert len(set(rows)) == 42


def test_further_starts_are_like_the_first_ones_and_no_runaway() -> None:
    rng = np.random.default_rng(0)
    first = rng.uniform(-1.0, 1.0, (40, 1))
    states = first * 1.3 ** np.arange(12)  # an episode runs away, to 18 times where it began
    log = TransitionTable.from_arrays(
        states[:, :-1].reshape(-1, 1), np.zeros((440, 1)), np.zeros(440), states[:, 1:].reshape(-1, 1), np.zeros(440),
        np.repeat(np.arange(40), 11),
    )  # fmt: skip
    rows = initial_rows(log, 40, 0, spare=100)
    more = np.asarray(log.observations[rows[40:], 0])
    assert np.abs(more).max() < 2.0
    assert more.std() == pytest.approx(first.std(), rel=0.25)
    assert len(set(rows)) == 140


def test_episodes_cost_what_the_log_did_before_past_inputs_are_known() -> None:
    layout = TRUE_MPC.with_delay(2).layout
    table = with_memory(LOG, layout)
    before = costs_before(LOG, table, np.array([0, 28, 30]), 2)
    costs = LOG.values().costs
    np.testing.assert_allclose(before, [costs[:2].sum(), costs[30:32].sum(), 0.0])
    around = Surroundings(
        place(TRUE_MPC, LOG, [0], 1).models, LoggedCost(LOG), LOG, np.array([0, 30]), 5, TRUE_MPC.layout,
        before=before[:2], n_before=2,
    )  # fmt: skip
    plain = Surroundings(around.models, around.cost, LOG, np.array([0, 30]), 5, TRUE_MPC.layout)
    trials = [Trials.none([FIRST], each) for each in (around, plain)]
    for each, where in zip(trials, (around, plain), strict=True):
        each.fill({FIRST: MPCPolicy(TRUE_MPC)}, where, slice(None))
    np.testing.assert_allclose(trials[0].cost - trials[1].cost, np.broadcast_to(before[:2], (1, 1, 2)))
    assert (trials[0].n_steps, trials[1].n_steps) == (7, 5)


@pytest.mark.parametrize("before", [0.0, 1.0])
def test_episodes_begin_where_the_log_did_if_nothing_unusual_was_applied_before(before: float) -> None:
    """A belt that acts two steps late: what it does in the first steps tells what was applied before the log."""
    mpc, rng, parts = belt_mpc(2, gain=0.5, decay=0.9), np.random.default_rng(0), []
    for e in range(30):
        x, past = rng.uniform(0.0, 5.0), [before, before]
        for _ in range(20):
            u = rng.uniform()
            reached = 0.9 * x + 0.5 * past[0] + 0.1 + 0.01 * rng.normal()
            parts.append(([x], [u], (x - 3.0) ** 2 + 0.02 * u**2, [reached], False, e))
            x, past = reached, [past[1], u]
    log = TransitionTable.from_arrays(*(np.array(part) for part in zip(*parts, strict=True)))
    around = surroundings_of(mpc, mpc, log, identify(mpc, log), n_starts=10)
    assert around.n_before == (0 if before == 0.0 else 2)
    assert around.n_before + around.n_steps == 20
    costs = log.values().costs.reshape(30, 20)
    assert set(np.round(around.returns, 6)) <= set(np.round(costs.sum(axis=1), 6))
    heard = []

    class Listens:
        mpc = belt_mpc(2).replace(applied_before=[0.7])

        def predict(self, observation: Array, state: Course) -> tuple[Array, Course]:
            heard.append(np.asarray(state.memory))
            return np.zeros((len(observation), 1)), state

    around.act([Listens()])
    if before == 0.0:
        np.testing.assert_array_equal(around.starts[:, 1:], np.zeros((10, 2)))
        np.testing.assert_array_equal(heard[0], np.full_like(heard[0], 0.7))  # nobody told it what was applied
    else:
        np.testing.assert_array_equal(heard[0], np.tile(around.starts[:, 1:], (len(around.models), 1)))


def test_controllers_together_do_what_each_does_alone() -> None:
    around = place(TRUE_MPC, LOG, [0, 30, 60], 5, members=1)
    other = MPCPolicy(TRUE_MPC.replace(action_high=[0.1], action_low=[-0.1]))
    both = around.act([MPCPolicy(TRUE_MPC), other])
    np.testing.assert_allclose(both[1].cost, around.act([other])[0].cost, rtol=1e-12)
    assert (both[0].cost != both[1].cost).any()


def test_what_the_log_cost_is_known_where_it_goes_on_or_ends_for_good() -> None:
    costs, ends = np.arange(10.0), np.array([0, 0, 0, 0, 1, 0, 0, 0, 0, 0.0])
    x = np.zeros((10, 1))
    log = TransitionTable.from_arrays(x, x, costs, x, ends, np.repeat([0, 1], 5))
    np.testing.assert_array_equal(returns_along(log, np.array([0, 3, 5, 8]), 3), [3.0, 7.0, 18.0, np.nan])
    falling = TransitionTable.from_arrays(x, x, costs, x, ends, np.repeat([7, 2], 5))
    np.testing.assert_array_equal(returns_along(falling, np.array([0, 3, 5, 8]), 3), [3.0, 7.0, 18.0, np.nan])


def trials_of(gains: dict[str, float], votes: list[bool]) -> Trials:
    around = place(TRUE_MPC, LOG, list(range(0, 600, 30)), 5, members=len(votes) - 1)
    empty = Trials.none([FIRST, *gains], around)
    rng = np.random.default_rng(0)
    common = rng.uniform(1.0, 2.0, empty.cost.shape[1:])
    cost = np.stack([common, *(common + gain for gain in gains.values())])
    return replace(empty, cost=cost, second=cost.copy(), votes=np.array(votes)).judged_from(12)


def test_better_is_what_most_models_and_both_costs_say() -> None:
    trials = trials_of({"a": -0.1, "b": 0.1}, [True, True, True])
    assert trials.improves("a")
    assert not trials.improves("b")
    np.testing.assert_allclose(trials.differences("a"), -0.1)
    trials.second[1] += 0.2
    assert not trials.improves("a")


def test_trials_come_back_from_arrays_and_others_are_refused() -> None:
    trials = trials_of({"a": -0.1}, [True, False])
    arrays = trials.to_arrays()
    again = Trials.from_arrays(trials.names, trials.models, arrays)
    for name, array in again.to_arrays().items():
        np.testing.assert_array_equal(array, arrays[name])
    with pytest.raises(FileFormatError, match="trials/cost"):
        Trials.from_arrays((*trials.names, "b"), trials.models, arrays)
    with pytest.raises(FileFormatError, match="trials/votes"):
        Trials.from_arrays(trials.names, trials.models, {k: v for k, v in arrays.items() if k != "votes"})


def test_the_best_of_some_is_chosen_and_the_worse_leave_early() -> None:
    wrong, lazy = lq_plant.make_mpc(), TRUE_MPC.replace(horizon=1)
    around = place(TRUE_MPC, LOG, list(range(0, 600, 30)), 30)
    mpcs = {FIRST: wrong, "best": TRUE_MPC, "lazy": lazy}
    trials, chosen = choose(mpcs, around)
    assert chosen == "best"
    assert not np.isnan(trials.of("best")).any()
    assert np.isnan(trials.of("lazy")).any()
    assert choose({FIRST: TRUE_MPC, "wrong": wrong}, around)[1] == FIRST
    assert choose({FIRST: TRUE_MPC, "same": TRUE_MPC.replace(horizon=TRUE_MPC.horizon)}, around)[1] == "same"


def test_each_beginning_of_the_starts_is_as_various_as_the_whole() -> None:
    around = place(TRUE_MPC, LOG, list(range(0, 600, 35))[:16], 30)
    (plain,) = around.act([MPCPolicy(TRUE_MPC)])
    sorted_ = various_first(around, TRUE_MPC)
    (done,) = sorted_.act([MPCPolicy(TRUE_MPC)])
    order = np.array([np.flatnonzero(around.rows == row)[0] for row in sorted_.rows])
    np.testing.assert_allclose(done.cost, plain.cost[:, order], rtol=1e-9)
    np.testing.assert_array_equal(sorted_.returns, around.returns[order])
    rank = np.argsort(np.argsort(-np.median(plain.cost, axis=0)[order]))
    assert rank[0] == 0  # the dearest one
    for n in (2, 4, 8):
        assert sorted(rank[:n] // (16 // n)) == list(range(n))


def test_starts_that_are_spared_stay_at_the_end() -> None:
    around = place(TRUE_MPC, LOG, list(range(0, 600, 30)), 30)
    around.usual = 5
    found = various_first(around, TRUE_MPC)
    np.testing.assert_array_equal(found.rows[5:], around.rows[5:])
    assert sorted(found.rows[:5]) == sorted(around.rows[:5])


def test_variants_of_what_is_good_are_tried_too() -> None:
    around = place(TRUE_MPC, LOG, list(range(0, 600, 30)), 30)
    still, half = (lq_plant.make_mpc((share * lq_plant.A, lq_plant.B)) for share in (0.1, 0.5))
    mpcs = {FIRST: still, "half": half}
    asked: list[tuple[list[str], int]] = []

    def variants(good: Mapping[str, MPC], turn: int) -> dict[str, MPC]:
        asked.append((list(good), turn))
        return {f"{name}, whole": TRUE_MPC for name in good} if turn == 0 else {}

    trials, chosen = choose(mpcs, around, variants)
    assert chosen == "half, whole"
    assert trials.names == tuple(mpcs) == (FIRST, "half", "half, whole")
    assert asked == [(["half"], 0), (["half, whole"], 1)]
