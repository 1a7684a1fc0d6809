"""``learn`` and ``evaluate``: the options reach the fit, machines get JSON, an interrupted fit goes on."""

from __future__ import annotations

import csv
import json
import logging
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import mpcoffline
from mpcoffline import MPCPolicy, OfflineMPCLearner, nominal_mpc
from mpcoffline.cli.main import app
from mpcoffline.cli.options import Preset
from mpcoffline.learner.candidates import outcome
from mpcoffline.learner.presets import PRESETS
from mpcoffline.learning import Bellman

PENDULUM = "mpcoffline/PendulumSwingUp-v0"
DATA = "mpcoffline/pendulum/ddpg-v0"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "minari").mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)
    brief = Bellman().replaced(
        {"value_n_steps": 20, "value_batch_size": 16, "hidden": (8,), "fit_n_steps": 2, "refit_rows": 300}
    )
    for name in ("default", "paper"):  # whether learning succeeds is tested elsewhere
        monkeypatch.setitem(PRESETS, name, brief)


def call(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def test_the_choices_are_those_of_the_library() -> None:
    assert [preset.value for preset in Preset] == list(PRESETS)


@pytest.mark.usefixtures("shipped")
def test_options_reach_the_fit_and_json_describes_it() -> None:
    result = call(
        *("learn", "--dataset", DATA, "--preset", "paper", "--value", "td", "--discount", "0.93", "--horizon", "7"),
        *("--learn", "cost", "--steps", "30", "--seed", "3", "--out", "mine.zip", "--log-csv", "fit.csv", "--json"),
    )
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    learner = OfflineMPCLearner.load("mine.zip")
    assert (learner.preset, learner.learn, learner.method.options["value"]) == ("paper", "cost", "td")
    assert (learner.mpc.discount, learner.mpc.horizon, learner.seed) == (0.93, 7, 3)
    assert (document["discount"], document["horizon"], document["preset"]) == (0.93, 7, "paper")
    np.testing.assert_array_equal(document["learned"]["stage_cost.W"], learner.mpc.values["stage_cost.W"])
    assert Path(document["policy"]).is_file()
    assert [entry["epoch"] for entry in document["history"]] == [epoch for epoch, _ in learner.history]
    rows = csv.DictReader(Path("fit.csv").read_text().splitlines())
    assert {row["metric"] for row in rows} == {"value_loss", "fit_loss"}


@pytest.mark.usefixtures("shipped")
def test_what_is_handed_out_is_told_by_the_result_alone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fit = OfflineMPCLearner.fit

    def telling(self: OfflineMPCLearner, *args: object, **kwargs: object) -> object:
        outcome.warning("Handed out: MPC_1.")
        logging.getLogger("mpcoffline.learner").warning("Something else.")
        return fit(self, *args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(OfflineMPCLearner, "fit", telling)
    result = call("learn", "--dataset", DATA, "--steps", "30", "--candidate", "full")
    assert result.exit_code == 0, result.output
    assert "Handed out" not in caplog.text
    assert "Something else." in caplog.text
    assert outcome.level == logging.NOTSET


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_an_interrupted_fit_goes_on_from_its_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ("learn", "--dataset", DATA, "--steps", "501", "--checkpoint", "fit.ckpt")  # an epoch has 500
    fit = OfflineMPCLearner.fit

    def interrupted(self: OfflineMPCLearner, *args: object, **kwargs: object) -> object:
        kwargs["callbacks"] = [lambda _, epoch, __: signal.raise_signal(signal.SIGINT) if epoch == 2 else None]
        return fit(self, *args, **kwargs)  # type: ignore[arg-type]

    with monkeypatch.context() as patched:
        patched.setattr(OfflineMPCLearner, "fit", interrupted)
        result = call(*arguments)
    assert result.exit_code == 130
    assert result.stdout == ""
    assert "goes on from fit.ckpt" in result.stderr
    assert "Interrupted." in result.stderr
    assert "Traceback" not in result.output
    assert {path.name for path in Path().iterdir()} == {"minari", "fit.ckpt"}, "no half-written files"

    assert call(*arguments).exit_code == 0
    resumed = OfflineMPCLearner.load("learner.zip").theta
    Path("fit.ckpt").unlink()
    assert call(*arguments).exit_code == 0
    np.testing.assert_array_equal(resumed, OfflineMPCLearner.load("learner.zip").theta)


def test_a_missing_package_is_named_with_its_extra_before_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    result = call("learn", "pendulum", "--tensorboard", "events")
    assert result.exit_code == 1
    assert 'pip install "mpcoffline[tensorboard]"' in result.stderr
    assert not Path("learner.zip").exists()


def test_numbers_out_of_range_are_refused() -> None:
    assert "--horizon" in call("learn", "pendulum", "--horizon", "0").stderr
    assert "discount" in call("learn", "pendulum", "--discount", "0").stderr
    Path("taken").write_text("no folder")
    result = call("learn", "pendulum", "--checkpoint", "taken/where.ckpt")
    assert result.exit_code == 1
    assert "taken" in result.stderr


def test_evaluate_as_json_has_a_cost_an_episode() -> None:
    MPCPolicy(nominal_mpc(PENDULUM).replace(horizon=5)).save("policy.zip")
    result = call("evaluate", "policy.zip", "--env", PENDULUM, "--episodes", "3", "--seed", "5", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    expected = mpcoffline.evaluate(MPCPolicy.load("policy.zip"), PENDULUM, 3, 5)
    np.testing.assert_allclose(document["costs"], expected.cost)
    np.testing.assert_allclose(document["discounted_cost"], expected.discounted_cost.mean())
    assert document["successes"] == expected.success.tolist()
    assert document["n_solves"] == 300
