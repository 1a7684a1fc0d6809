"""Dead time from logs of plants that have some, and none from those that have none."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from late_plants import belt_log, belt_mpc, pair_log, pair_mpc

from mpcoffline import MPC, InvalidArgumentError, Model, OfflineMPCLearner, Parameter, QuadraticCost, TransitionTable
from mpcoffline.diagnostics import diagnose
from mpcoffline.estimation import find_delays, identify
from mpcoffline.learning import Bellman, ParameterConfig, StartConfig, ValueConfig, ValueFunction, fit_value


@pytest.mark.parametrize("delay", [0, 1, 3, 7])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_the_belts_dead_time_is_found(delay: int, noise: float) -> None:
    for seed in range(2):
        found = find_delays(belt_mpc(), belt_log(delay, noise=noise, seed=seed))
        assert found.delay == (delay,)
        assert found.found == (delay > 0)


def test_inputs_at_random_that_act_very_late() -> None:
    """The errors with shorter dead times fall nowhere: what the errors follow tells how far to look."""
    assert find_delays(belt_mpc(), belt_log(12, white=True)).delay == (12,)


@pytest.mark.parametrize("delay", [(0, 0), (2, 0), (0, 3), (1, 5), (4, 1)])
def test_each_input_has_its_own(delay: tuple[int, int]) -> None:
    assert find_delays(pair_mpc(), pair_log(delay)).delay == delay


def test_units_do_not_matter() -> None:
    """The same log with its state in other units, far from zero: the same dead time, the same gain."""
    table, scale, offset = belt_log(3), 1e-4, 50.0
    values = table.values()
    y, reached = (scale * part + offset for part in (values.observations, values.next_observations))
    other = TransitionTable.from_arrays(
        y, 1e5 * values.actions, values.costs, reached, values.terminations, table.episode_ids
    )

    def step(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return offset + p["decay"] * (x - offset) + scale * (p["gain"] * u / 1e5 + 0.1)

    mpc = belt_mpc()
    model = Model(
        step,
        1,
        1,
        1.0,
        {block.name: Parameter(block.value, low=0.05, high=5.0) for block in mpc.model.space},
        discrete=True,
    )
    end = QuadraticCost([[1.0]])
    scaled = MPC(model, QuadraticCost([[1.0]], [[1.0]]), end, 20, 0.95, [0.0], [1e5])
    first, second = find_delays(mpc, table), find_delays(scaled, other)
    assert first.delay == second.delay == (3,)
    assert second.gain == pytest.approx(first.gain, rel=0.02)


def test_gaps_and_short_episodes_say_less_but_nothing_wrong() -> None:
    table = belt_log(3, n_episodes=60, length=40)
    kept = np.flatnonzero(np.random.default_rng(0).random(len(table)) > 0.03)
    assert find_delays(belt_mpc(), table.take(kept)).delay == (3,)
    single = TransitionTable.from_arrays(*table.values(), episode_ids=np.arange(len(table)))
    assert find_delays(belt_mpc(), single).longest == (0,)
    assert find_delays(belt_mpc(), belt_log(3, n_episodes=3, length=20)).delay == (0,)  # too few rows to tell


def test_a_model_that_knows_is_confirmed_or_corrected() -> None:
    table = belt_log(3)
    right, wrong = find_delays(belt_mpc(3), table), find_delays(belt_mpc(5), table)
    assert (right.found, right.delay) == (False, (3,))
    assert (wrong.found, wrong.delay, wrong.given) == (True, (3,), (5,))
    assert "dead time of [3] steps" in str(wrong)


def test_what_is_identified_is_the_plant_itself() -> None:
    """With the dead time known, the belt's parameters come out, noise or not; errors are those of its one state."""
    for noise in (0.0, 0.05):
        table = belt_log(3, noise=noise)
        found = identify(belt_mpc(3), table)
        np.testing.assert_allclose(found.theta[:2], [0.9, 0.5], rtol=0.05)
        assert found.errors_after.shape == (1,)
        assert found.noise.measurement.shape == (1,)
        assert found.noise.measurement[0] == pytest.approx(noise, abs=0.01)
        assert found.table.ny == 4


def quick(mpc: MPC, value_function: ValueFunction | None = None, **options: Any) -> OfflineMPCLearner:
    identify = StartConfig("identified", adapt_above=1.0, **options)
    fit = ParameterConfig(n_steps=1, refit_rows=500, refit_iterations=5)
    method = Bellman(identify=identify, value=ValueConfig(n_steps=5), fit=fit)
    return OfflineMPCLearner(mpc, "cost+model", method=method, value_function=value_function)


def test_the_learner_finds_it_and_its_policy_carries_it(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    learner = quick(belt_mpc())
    learner.fit(belt_log(3), show_progress=False)
    assert learner.mpc.model.delay == (3,)
    assert (learner.mpc.nx, learner.mpc.ny) == (4, 1)
    assert learner.value_function is not None
    assert learner.value_function.ny == 4
    assert "dead time [3]" in repr(learner)
    assert "dead time of [3] steps" in caplog.text
    assert learner.nominal_mpc.model.delay is None
    _, state = learner.policy.predict(np.array([2.0]))
    assert state[2].shape == (1, 3)


def test_a_value_function_that_was_given_stays_as_it_is(tmp_path: Path) -> None:
    log, grid = belt_log(3, n_episodes=8), np.linspace(0.0, 5.0, 9)[:, None]
    value = fit_value(log, belt_mpc().discount, ValueConfig(n_steps=5), seed=0)
    learner = quick(belt_mpc(), value_function=value)
    learner.fit(log, show_progress=False)
    assert learner.mpc.model.delay == (3,)
    learner.save(tmp_path / "learner.zip")
    for each in (learner, OfflineMPCLearner.load(tmp_path / "learner.zip")):
        assert each.value_function is not None
        past = np.random.default_rng(0).random((9, 3))
        np.testing.assert_allclose(each.value_function.predict(np.hstack([grid, past])), value.predict(grid), rtol=1e-6)
    again = OfflineMPCLearner.load(tmp_path / "learner.zip")
    again.fit(log, show_progress=False)
    np.testing.assert_array_equal(again.theta, learner.theta)


def test_mpc_1_handed_out_knows_no_past_inputs(tmp_path: Path) -> None:
    """V is of a state that it has not; file and report are complete all the same."""
    log = belt_log(3, n_episodes=8)
    learner = quick(belt_mpc())
    learner.candidate = "MPC_1"
    learner.fit(log, show_progress=False)
    assert (learner.mpc.nx, learner.value_function and learner.value_function.ny) == (1, 4)
    learner.save(tmp_path / "learner.zip")
    loaded = OfflineMPCLearner.load(tmp_path / "learner.zip")
    report = diagnose(loaded, log, n_starts=4, n_steps=20)
    assert report.verdict == "keep MPC_1"
    slope = (loaded.policy.predict(np.array([3.1]))[0] - loaded.policy.predict(np.array([2.9]))[0]) / 0.2
    np.testing.assert_allclose(report.theorem.eigenvalues, np.abs(0.8 + 0.7 * slope), atol=1e-3)  # its own model


@pytest.mark.parametrize("delay", [1, 5])
def test_one_with_another_dead_time_handed_out_is_diagnosed(delay: int, tmp_path: Path) -> None:
    log = belt_log(3, n_episodes=8)
    learner = quick(belt_mpc())
    learner.candidate = "mine"
    learner.fit(log, show_progress=False, also={"mine": belt_mpc().with_delay(delay)})
    assert learner.mpc.nx == 1 + delay
    learner.save(tmp_path / "learner.zip")
    report = diagnose(OfflineMPCLearner.load(tmp_path / "learner.zip"), log, n_starts=4, n_steps=20)
    assert len(report.theorem.eigenvalues) == 1 + delay


def test_a_delay_that_the_log_denies_is_kept_and_told(caplog: pytest.LogCaptureFixture) -> None:
    learner = quick(belt_mpc(1))
    learner.fit(belt_log(3), show_progress=False)
    assert learner.mpc.model.delay == (1,)
    assert "The model's delay is [1], the log says otherwise: a dead time of [3] steps" in caplog.text


def test_the_search_can_be_left_out() -> None:
    learner = quick(belt_mpc(), delays=False)
    learner.fit(belt_log(3), show_progress=False)
    assert learner.mpc.layout.is_plain


def test_a_value_function_learned_with_dead_time_goes_with_an_mpc_that_has_it() -> None:
    log = belt_log(3, n_episodes=8)
    learner = quick(belt_mpc())
    learner.fit(log, show_progress=False)
    with pytest.raises(InvalidArgumentError, match=r"of 1 coordinates, got 4.*with_delay"):
        quick(belt_mpc(), value_function=learner.value_function)
    again = quick(belt_mpc().with_delay(3), value_function=learner.value_function)
    again.fit(log, show_progress=False)
    assert again.value_function is learner.value_function
    np.testing.assert_allclose(again.theta, learner.theta, rtol=1e-6)
