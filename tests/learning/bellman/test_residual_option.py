"""The learned residual as a part of a fit."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from logged_plants import pendulum_log, pendulum_mpc, tank_log, tank_mpc

import mpcoffline
from mpcoffline import OfflineMPCLearner
from mpcoffline.learning.bellman.stages import StartConfig, identified
from mpcoffline.learning.stages import Known

CONFIG = StartConfig(init="identified", adapt_above=0.03, residual=True)


def test_a_model_of_the_wrong_structure_gets_one(caplog: pytest.LogCaptureFixture) -> None:
    table = pendulum_log(15, 100, 0, friction=True)
    with caplog.at_level(logging.INFO):
        known = identified(Known(pendulum_mpc(), table), CONFIG)
    assert known.residual_share is not None
    assert known.residual_share > 0.9
    assert known.model_error is not None
    assert known.model_error < 0.03
    assert "explains" in caplog.text
    columns = table.values()
    missed = columns.next_observations - known.mpc.model(columns.observations, columns.actions)
    spread = (columns.next_observations - columns.observations).std(axis=0)
    assert np.sqrt(np.mean((missed / spread) ** 2)) < 0.03
    without = identified(Known(pendulum_mpc(), table), StartConfig(init="identified", adapt_above=0.03))
    assert without.residual_share is None
    np.testing.assert_array_equal(without.mpc.theta, known.mpc.theta)


def test_a_model_that_is_right_or_not_learned_gets_none() -> None:
    assert identified(Known(tank_mpc(), tank_log(10, 100, 0)), CONFIG).residual_share is None
    table = pendulum_log(5, 60, 0, friction=True)
    assert identified(Known(pendulum_mpc(), table, ("cost",)), CONFIG).residual_share is None


def test_a_learner_keeps_it(tmp_path: Path) -> None:
    options = {"residual": True, "horizon": 5, "terminal": "quadratic", "value_n_steps": 20}
    learner = OfflineMPCLearner(pendulum_mpc(), preset="default", candidate="full", seed=0, **options)
    table = pendulum_log(10, 60, 0, friction=True)
    learner.fit(table, show_progress=False)
    assert learner.result is not None
    assert learner.result.residual_share is not None
    assert "explains" in str(learner)
    learner.save(tmp_path / "learner.zip")
    again = OfflineMPCLearner.load(tmp_path / "learner.zip")
    assert again.result is not None
    assert again.result.residual_share == learner.result.residual_share
    x, u = np.array([[0.2, 0.5]]), np.array([[0.3]])
    np.testing.assert_allclose(again.mpc.model(x, u), learner.mpc.model(x, u), rtol=1e-12)
    plain = learner.nominal_mpc.with_theta(np.concatenate([learner.mpc.theta[:2], learner.nominal_mpc.theta[2:]]))
    assert not np.allclose(plain.model(x, u), learner.mpc.model(x, u))
    report = mpcoffline.diagnose(learner, table, n_starts=1, n_steps=2)
    assert report.prediction.learned < 0.1 * report.prediction.nominal
    assert not report.lag.found
    assert "explains" in str(report)
