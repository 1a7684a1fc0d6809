"""Whole diagnoses of small linear fits whose truth is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import casadi as ca
import lq_plant
import numpy as np
import pytest
from late_plants import belt_log, belt_mpc
from lq_episodes import episodes
from lq_plant import QuadraticValue

import mpcoffline
from mpcoffline import OfflineMPCLearner, TransitionTable
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError, MPCOfflineError
from mpcoffline.diagnostics import Report, diagnose
from mpcoffline.diagnostics.page import page_of
from mpcoffline.estimation.smoothing import with_measurement_noise
from mpcoffline.mpc import MPC, Block, ParameterSpace
from mpcoffline.mpc.component import Component

LOG = episodes(n=40, steps=40)
# An engineer who believes that inputs act the other way.
WRONG = lq_plant.make_mpc((lq_plant.A, -0.5 * lq_plant.B))


def fitted(mpc: MPC, table: TransitionTable = LOG, candidate: str = "auto", **more: Any) -> OfflineMPCLearner:
    options: dict[str, Any] = {"method": "bellman", "init": "identified", "fit_n_steps": 1, "trim": 1.0, **more}
    value = QuadraticValue(lq_plant.BEST.P)
    learner = OfflineMPCLearner(mpc, value_function=value, candidate=candidate, **options)
    learner.fit(table, show_progress=False)
    return learner


@pytest.fixture(scope="module")
def good() -> Report:
    return diagnose(fitted(WRONG), LOG, n_starts=8, n_steps=40)


def test_a_fit_that_repairs_a_wrong_model_is_recommended(good: Report) -> None:
    assert good.verdict == "recommend"
    assert good.judgement.first is not None
    assert good.judgement.first.better.all()
    assert good.trials.of(good.judgement.proposal).mean() < 0.5 * good.trials.of("MPC_1").mean()
    assert good.prediction.identified < 1e-5 < good.prediction.nominal
    assert good.theorem.eigenvalues[0] < 1.0
    assert good.value.correlation > 0.5
    assert good.fit[0].after < good.fit[0].before
    assert good.noise.negligible
    assert not good.lag.found
    assert good.at_bounds == ()
    assert good.goal is not None
    assert good.goal.share > 0.01
    assert (good.n_rows, good.n_episodes) == (1_600, 40)


def test_the_page_shows_loops_from_the_log_parameters_and_where_they_are_from(good: Report) -> None:
    found = good.background
    assert found is not None
    assert [loop.why for loop in found.loops][:2] == ["A usual start: the median gain", "Where it gains most"]
    for loop in found.loops:
        np.testing.assert_array_equal(loop.states[0], LOG.observations[loop.row])
        np.testing.assert_array_equal(loop.actions[0], LOG.actions[loop.row])
        assert list(loop.states_on) == ["MPC_1", good.judgement.proposal]
        for states in loop.states_on.values():
            assert states.shape == (good.trials.votes.sum(), 41, 2)
            np.testing.assert_allclose(states[:, 0], np.broadcast_to(loop.states[0], states[:, 0].shape), rtol=1e-6)
    assert found.episodes == (40, 40, 40, 0)
    assert [column.high for column in found.columns[:2]] == pytest.approx(LOG.observations.max(axis=0))
    b = {line.name: line for line in found.parameters if line.name.startswith("model.B")}
    assert [line.before for line in b.values()] == pytest.approx(WRONG.values["model.B"].ravel())
    assert [line.found for line in b.values()] == pytest.approx(lq_plant.B.ravel(), abs=1e-4)
    assert len(dict(found.made_by)["SHA-256 of the learned theta"]) == 64
    page = page_of(good)
    assert page.count("row ") >= len(found.loops)
    assert all(f">{line.name}<" in page for line in found.parameters)


def test_text_and_json_say_the_same(good: Report) -> None:
    text, data = str(good), json.loads(good.to_json())
    assert text.startswith(f"Verdict: recommend\n  - {good.judgement.proposal} costs ")
    assert data["verdict"] == "recommend"
    assert data["costs"][good.judgement.proposal] == pytest.approx(good.judgement.expected)
    assert data["theorem"]["eigenvalues"] == pytest.approx(good.theorem.eigenvalues)
    assert "traces" not in data
    assert "models predict the log well enough to be asked" in " ".join(text.split())
    assert all(len(line) < 100 for line in text.splitlines())


def test_the_figure_is_drawn(good: Report, tmp_path: Path) -> None:
    files = good.figure(tmp_path / "report.png")
    assert [file.name for file in files] == ["report.pdf", "report.png"]
    assert all(file.stat().st_size > 10_000 for file in files)
    again = good.figure(tmp_path / "fit.0.95")
    assert [file.name for file in again] == ["fit.0.95.pdf", "fit.0.95.png"]  # a point in its name begins no suffix
    assert again[0].read_bytes() == files[0].read_bytes()


def test_the_same_seed_gives_the_same_report(good: Report) -> None:
    assert diagnose(fitted(WRONG), LOG, n_starts=8, n_steps=40).to_json() == good.to_json()


class Unaimed(Component):
    """The linear plant's cost, written so that nobody says where it is zero."""

    def __init__(self) -> None:
        self.space = ParameterSpace([Block.free("scale", np.array(1.0), "cost")])

    def expression(self, x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return p["scale"] * (x.T @ ca.DM(lq_plant.W) @ x + u.T @ ca.DM(lq_plant.R) @ u)

    def terminal_expression(self, x: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        return p["scale"] * (x.T @ ca.DM(lq_plant.W) @ x)


def test_without_a_goal_in_the_description_nothing_is_said_of_one() -> None:
    """A learned V has a middle of its own, zero where nobody says another: it is no goal of the plant."""
    learner = fitted(WRONG.replace(stage_cost=Unaimed(), terminal_cost=Unaimed()), terminal="quadratic")
    assert learner.nominal_mpc.reference is None
    assert learner.mpc.reference is not None
    report = diagnose(learner, LOG, n_starts=8, n_steps=40)
    assert report.traces is not None
    assert report.traces.goal is None
    assert report.goal is None
    assert report.theorem.eigenvalues == ()
    page = page_of(report)
    assert "Distance to where the loops end" in page
    assert "Distance to the goal" not in page


def test_where_nothing_can_be_gained_mpc_1_is_kept() -> None:
    exact = lq_plant.make_mpc((lq_plant.A, lq_plant.B))
    report = diagnose(fitted(exact, discount=exact.discount), LOG, n_starts=8, n_steps=40)  # without one it is better
    assert report.verdict == "keep MPC_1"
    own, first = (report.trials.of(name).mean() for name in (report.judgement.proposal, "MPC_1"))
    assert own == pytest.approx(first, rel=0.02)
    assert "MPC_1" in report.reasons[0]


def test_a_dead_time_that_the_fit_found_is_known_to_the_diagnosis() -> None:
    log = belt_log(3)
    learner = OfflineMPCLearner(belt_mpc(), value_n_steps=200, hidden=(16,), terminal="quadratic", seed=0)
    learner.fit(log, show_progress=False)
    report = diagnose(learner, log)
    assert report.verdict == "recommend"
    assert not report.lag.found
    assert report.judgement.today.known


def test_late_inputs_are_found() -> None:
    late = episodes(n=40, steps=40, lag=1)
    report = diagnose(fitted(WRONG, late, "full"), late, n_starts=5, n_steps=30)
    assert report.lag.found


def test_noise_and_a_log_without_the_goal_are_noted() -> None:
    noisy = with_measurement_noise(LOG, 0.05, 0)
    far = WRONG.with_theta(WRONG.space.pack({"stage_cost.x_ref": [9.0, 0.0]}))
    report = diagnose(fitted(far, noisy, "full"), noisy, n_starts=3, n_steps=10)
    assert report.noise.level == pytest.approx(0.05, rel=0.15)
    assert any("noise" in note for note in report.notes)
    assert any("never reaches the goal" in note for note in report.notes)
    assert "never reaches the goal" in str(report)


def test_a_short_single_episode_gives_a_report_without_nan() -> None:
    table = TransitionTable(LOG.rows[:30], LOG.ny, LOG.nu, np.zeros(30, dtype=np.int64))
    report = diagnose(fitted(WRONG, table), table, n_starts=3, n_steps=10)
    assert report.value.n == 0
    assert np.isfinite(report.trials.cost).all()
    assert "no episode is long enough" in str(report)
    json.loads(report.to_json())


def test_what_cannot_be_diagnosed_is_refused() -> None:
    with pytest.raises(MPCOfflineError, match="fit"):
        diagnose(OfflineMPCLearner(WRONG, preset="paper"), LOG)
    learner = fitted(WRONG, candidate="full")
    with pytest.raises(InvalidArgumentError, match="n_starts"):
        diagnose(learner, LOG, n_starts=0)
    pendulum = TransitionTable.from_arrays(
        np.zeros((5, 3)), np.zeros((5, 1)), np.zeros(5), np.zeros((5, 3)), np.zeros(5)
    )
    with pytest.raises(InvalidDataError, match="observations"):
        diagnose(learner, pendulum)


def test_odd_data_give_a_verdict_and_no_nan() -> None:
    s, a, after = (v.astype(np.float64) for v in (LOG.observations, LOG.actions, LOG.next_observations))
    n = len(LOG)
    ones, ids = np.ones((n, 1)), LOG.episode_ids
    for table in (
        TransitionTable.from_arrays(
            np.hstack([s[:, :1], ones]), a, LOG.costs, np.hstack([after[:, :1], ones]), np.zeros(n), ids
        ),
        TransitionTable.from_arrays(s, a, 1e6 * LOG.costs, after, np.ones(n), np.arange(n)),
        TransitionTable.from_arrays(s, a, np.full(n, 7.0), after, np.zeros(n), ids),
        TransitionTable.from_arrays(*(np.repeat(v[:9], 9, axis=0) for v in (s, a, LOG.costs, after, np.zeros(n)))),
    ):
        report = diagnose(fitted(WRONG, table), table, n_starts=2, n_steps=5)
        assert np.isfinite(report.trials.cost).all()
        assert report.reasons
        json.loads(report.to_json())


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_a_swing_up_is_diagnosed() -> None:
    from mpcoffline.learning import ValueConfig, fit_value

    table = TransitionTable.from_minari("mpcoffline/pendulum/ddpg-v0")
    part = TransitionTable(table.rows[40_000:], table.ny, table.nu, table.episode_ids[40_000:])
    mpc = mpcoffline.nominal_mpc("mpcoffline/PendulumSwingUp-v0", alpha=1.5, seed=1)
    value = fit_value(part, 0.95, ValueConfig(method="expectile", n_steps=500), seed=0)
    learner = OfflineMPCLearner(mpc, preset="default", terminal="quadratic", value_function=value, candidate="full")
    learner.fit(part, show_progress=False)
    report = diagnose(learner, part)
    assert report.verdict == "recommend"
    assert report.cost_r2 > 0.99
    assert len(report.theorem.eigenvalues) == 2  # the radius is no motion of the plant
