"""What users and shells do to a command: misspell, interrupt, close the pipe, complete."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mpcoffline import MPCPolicy, nominal_mpc
from mpcoffline.cli.main import app

PENDULUM = "mpcoffline/PendulumSwingUp-v0"
COMMAND = str(Path(sys.executable).parent / "mpcoffline")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "minari").mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)
    MPCPolicy(nominal_mpc(PENDULUM).replace(horizon=5)).save("policy.zip")


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        (["lern"], "learn"),
        (["datasets", "lst"], "list"),
        (["learn", "pendulum", "--horizn", "5"], "--horizon"),
        (["learn", "pendulum", "--preset", "papr"], "paper"),
        (["run", "pendulom"], "pendulum"),
    ],
)
def test_what_is_misspelt_is_a_usage_error_that_names_what_was_meant(given: list[str], meant: str) -> None:
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 2
    assert meant in result.stderr
    assert result.stdout == ""


LONG = {
    "mpcoffline.studies.run_task": ["run", "pendulum"],
    "mpcoffline.gallery.collection.collect": ["collect", "pendulum"],
    "mpcoffline.learner.OfflineMPCLearner.fit": ["learn", "pendulum"],
    "mpcoffline.evaluate": ["evaluate", "policy.zip", "--env", PENDULUM],
    "mpcoffline.control.export.export_c": ["export", "policy.zip"],
    "mpcoffline.datasets.replay": ["datasets", "replay", "mpcoffline/pendulum/ddpg-v0"],
    "mpcoffline.datasets.download_dataset": ["datasets", "download", "mine/plant/log-v0"],
    "mpcoffline.cli.doctor.checkup": ["doctor"],
}


@pytest.mark.parametrize("work", LONG)
def test_ctrl_c_ends_any_command_without_traceback_or_files(work: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work, lambda *_, **__: signal.raise_signal(signal.SIGINT))
    before = set(Path().iterdir())
    result = CliRunner().invoke(app, LONG[work])
    assert result.exit_code == 130
    assert result.stdout == ""
    assert result.stderr.strip().splitlines()[-1] == "Interrupted."
    assert "Traceback" not in result.stderr
    assert set(Path().iterdir()) == before


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["datasets", "list"], ["datasets", "list", "--json"], ["--help"]])
def test_a_closed_pipe_is_silent(arguments: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)  # as `| head -1` does when it has its line
    try:
        done = subprocess.run([COMMAND, *arguments], stdout=writing, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(writing)
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("words", "expected"),
    [("mpcoffline le", ["learn"]), ("mpcoffline learn --hor", ["--horizon"]), ("mpcoffline run p", ["pendulum"])],
)
def test_the_shell_completes(words: str, expected: list[str]) -> None:
    environment = {
        "_MPCOFFLINE_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    result = CliRunner().invoke(app, [], prog_name="mpcoffline", env=environment)
    assert result.output.split() == expected
