"""The main job from the shipped data to table and figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from riccati import optimum

from mpcoffline import InvalidArgumentError, MPCPolicy, OfflineMPCLearner, UnknownIdError
from mpcoffline.envs.linear_tracking import ACTION_WEIGHT, STATE_WEIGHT, plant_matrices
from mpcoffline.studies import TaskResult, run_task

BRIEF = {"value_n_steps": 20, "fit_n_steps": 5, "refit_rows": 500, "progress": False}
FILES = {"results.json", "results.md", "results.csv", "figure.pdf", "figure.png", "controllers"}

pytestmark = pytest.mark.usefixtures("shipped")


@pytest.mark.slow
def test_brief_run_writes_everything(tmp_path: Path) -> None:
    output = tmp_path / "new" / "folder"
    result = run_task("pendulum", n_episodes=3, output=output, **BRIEF)
    assert {path.name for path in output.iterdir()} == FILES
    assert TaskResult.load(output / "results.json") == result
    assert [c.name for c in result.controllers] == ["MPC_1", "MPC_2", "MPC_3", "reference"]
    assert result.starts == ["broad", "broad", "hanging"]
    assert result.dataset_id == "mpcoffline/pendulum/ddpg-v0"
    for c in result.controllers:
        assert len(c.costs) == len(c.discounted_costs) == 3
        assert np.shape(c.states) == (101, 2)
        assert np.shape(c.actions) == (100, 1)
        assert c.n_solves == 300
    starts = [c.states[0] for c in result.controllers if c.states is not None]
    assert starts == [starts[0]] * 4, "all controllers meet the same starts"
    # The saved controllers are those of the table.
    learner = OfflineMPCLearner.load(output / "controllers" / "MPC_3_learner.zip")
    policy = MPCPolicy.load(output / "controllers" / "MPC_3.zip")
    np.testing.assert_array_equal(learner.theta, policy.mpc.theta)
    assert policy.mpc.values["model.m"].tolist() == result.theta["MPC_3"]["model.m"]
    # MPC_2 shares the value function and keeps the model.
    np.testing.assert_array_equal(result.theta["MPC_2"]["model.m"], result.theta["MPC_1"]["model.m"])
    other = OfflineMPCLearner.load(output / "controllers" / "MPC_2_learner.zip")
    assert learner.value_function is not None
    assert other.value_function is not None
    np.testing.assert_array_equal(learner.value_function.predict([1, 0, 0]), other.value_function.predict([1, 0, 0]))


@pytest.mark.slow
def test_same_seed_same_table(tmp_path: Path) -> None:
    first, second = (run_task("linear", n_episodes=3, output=tmp_path / str(n), seed=1, **BRIEF) for n in range(2))
    assert first.theta == second.theta
    assert [c.costs for c in first.controllers] == [c.costs for c in second.controllers]


def test_bad_input_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    output = tmp_path / "output"
    with pytest.raises(InvalidArgumentError, match="n_episodes"):
        run_task("pendulum", n_episodes=0, output=output)
    with pytest.raises(UnknownIdError, match="task"):
        run_task("pendolum", output=output)
    with pytest.raises(UnknownIdError, match="mpcoffline collect"):
        run_task("linear", alpha=0.25, output=output)
    with pytest.raises(UnknownIdError, match="Did you mean 'residual'"):
        run_task("pendulum", value="residuals", output=output)
    assert not output.exists()


@pytest.mark.slow
def test_linear_task_mpc_3_is_near_optimal(tmp_path: Path) -> None:
    """On a plant that the model is not of; the bounds are inactive, so that the reference costs what Riccati says."""
    schedule = {"value_n_steps": 1_000, "fit_n_steps": 200, "fit_batch_size": 256}
    result = run_task("linear", n_episodes=8, output=tmp_path, progress=False, **schedule)
    best, reference = optimum(*plant_matrices(1.0), STATE_WEIGHT, ACTION_WEIGHT, 0.9), result.controller("reference")
    start = np.array(reference.states[0])  # type: ignore[index]
    assert reference.discounted_costs[result.example] == pytest.approx(start @ best.P @ start, rel=1e-3)
    assert result.relative_performance("MPC_3")[1] >= 0.995
    assert result.relative_performance("MPC_1")[1] < 0.99
    assert result.controller("MPC_3").success == 1.0
