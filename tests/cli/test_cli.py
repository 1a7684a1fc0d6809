"""The command line as a user meets it: help, one-line errors with exit code 1, files."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner, Result

import mpcoffline
from mpcoffline import MPCPolicy, OfflineMPCLearner, nominal_mpc
from mpcoffline.cli.main import app

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = tmp_path / "minari"
    store.mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(store))
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def plain(result: Result) -> str:
    return re.sub(r"\x1b\[[0-9;]*m", "", result.output)


def refused(*arguments: str | Path) -> str:
    """The one line of an error that is not in the command line."""
    return told(1, *arguments)


def told(exit_code: int, *arguments: str | Path) -> str:
    """The one line of an error."""
    result = call(*arguments)
    assert result.exit_code == exit_code, result.output
    assert result.stdout == ""
    assert isinstance(result.exception, SystemExit), "no traceback"
    lines = [line for line in plain(result).splitlines() if line.strip()]
    assert len(lines) == 1, lines
    assert lines[0].startswith("Error: ")
    return lines[0]


COMMANDS = [
    "run", "reproduce", "collect", "new", "check", "tune", "retune", "serve", "learn", "evaluate", "diagnose", "plot",
    "distill", "export", "clean", "doctor",
]  # fmt: skip
DATASETS = [f"datasets {name}" for name in ("list", "show", "verify", "replay", "repair", "download", "upload")]


def test_the_commands_are_these() -> None:
    group = typer.main.get_group(app)
    context = group.make_context("mpcoffline", ["datasets"])
    assert group.list_commands(context) == [*COMMANDS, "datasets"]


@pytest.mark.parametrize("command", [*COMMANDS, *DATASETS])
def test_every_command_has_help_with_examples(command: str) -> None:
    result = call(*command.split(), "--help")
    assert result.exit_code == 0
    assert "Usage: " in plain(result)
    assert f"mpcoffline {command}" in re.split("Examples?:", plain(result))[1]
    if command in ("run", "reproduce", "collect", "tune", "learn", "evaluate"):
        assert "--seed" in plain(result)


def test_version_and_no_arguments() -> None:
    assert plain(call("--version")) == f"mpcoffline {mpcoffline.__version__}\n"
    assert "datasets" in plain(call())


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\nfrom mpcoffline.cli import app\n"
        "try: app(['--help'])\nexcept SystemExit: pass\n"
        "print(sorted({'torch', 'casadi', 'stable_baselines3', 'minari', 'scipy', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.slow
def test_the_installed_command_shows_errors_without_traceback() -> None:
    command = [str(Path(sys.executable).parent / "mpcoffline"), "run", "pendulum", "--dataset", "mpcoffline/nope-v0"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("Error: data set id: expected one of ")
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_datasets_list_names_the_shipped_ones() -> None:
    output = plain(call("datasets", "list"))
    for name in ("linear", "pendulum", "cartpole"):
        assert re.search(rf"mpcoffline/{name}/ddpg-v0 +shipped +500 +50000", output)


def test_bad_input_is_one_line(tmp_path: Path) -> None:
    assert "Did you mean" in refused("run", "pendulum", "--dataset", "mpcoffline/pendulum/dpg-v0")
    assert "alpha" in told(2, "run", "pendulum", "--alpha", "3")
    assert "mpcoffline collect" in refused("run", "linear", "--alpha", "0.25")
    assert "alpha" in told(2, "collect", "pendulum", "--alpha", "0.5")
    assert "no dots" in told(2, "collect", "linear", "--dataset-id", "no.dots-v0")
    foreign = tmp_path / "foreign.zip"
    foreign.write_bytes(b"PK but not really")
    assert "foreign.zip" in refused("evaluate", foreign, "--env", PENDULUM)


@pytest.mark.usefixtures("shipped")
def test_an_output_that_is_no_folder_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "file" in refused("run", "pendulum", "--out", tmp_path / "file" / "below")


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "pendulom"],
        ["run", "pendulum", "--episodes", "0"],
        ["run", "pendulum", "--value", "best"],
        ["learn", "pendulum", "--learn", "everything"],
        ["learn"],
        ["learn", "pendulom"],
        ["learn", "missing.py"],
        ["learn", "pendulum", "--discount", "0"],
        ["learn", "pendulum", "--discount", "1.1"],
        ["evaluate", "missing.zip", "--env", PENDULUM],
    ],
)
def test_wrong_arguments_show_usage(arguments: list[str]) -> None:
    result = call(*arguments)
    assert result.exit_code == 2
    assert "Usage" in plain(result)


@pytest.fixture
def policy_file(tmp_path: Path) -> Path:
    path = tmp_path / "policy.zip"
    MPCPolicy(nominal_mpc(PENDULUM).replace(horizon=5)).save(path)
    return path


def test_evaluate_reports_costs(policy_file: Path) -> None:
    result = call("evaluate", policy_file, "--env", PENDULUM, "--episodes", "2", "--start", "hanging", "--seed", "3")
    assert result.exit_code == 0, result.output
    output = plain(result)
    expected = mpcoffline.evaluate(
        MPCPolicy.load(policy_file), PENDULUM, 2, 3, options={"start": "hanging"}
    ).cost.mean()
    assert re.search(rf"cost J +{expected:.2f}", output)
    assert "discounted cost (0.9)" in output
    assert "of 200" in output


def test_evaluate_refuses_what_does_not_belong_together(policy_file: Path) -> None:
    assert "observation" in refused("evaluate", policy_file, "--env", "mpcoffline/CartPoleSwingUp-v0")
    linear = "mpcoffline/LinearTracking-v0"
    assert "--start" in told(2, "evaluate", policy_file, "--env", linear, "--start", "hanging")
    assert f"Did you mean '{PENDULUM}'?" in refused("evaluate", policy_file, "--env", "mpcoffline/Pendulum-v0")
    assert "--alpha" in told(2, "evaluate", policy_file, "--env", PENDULUM, "--alpha", "0.5")


@pytest.mark.usefixtures("shipped")
def test_learn_saves_learner_and_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Brief(OfflineMPCLearner):
        def __init__(self, *args: object, **kwargs: object) -> None:
            super().__init__(*args, value_n_steps=10, fit_n_steps=5, refit_rows=500, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr("mpcoffline.learner.learner.OfflineMPCLearner", Brief)
    result = call(
        *("learn", "--dataset", "mpcoffline/pendulum/ddpg-v0", "--preset", "paper"),
        *("--learn", "cost", "--value", "td", "--seed", "2"),
    )
    assert result.exit_code == 0, result.output
    learner = OfflineMPCLearner.load(tmp_path / "learner.zip")
    assert (learner.learn, learner.method.options["value"], learner.seed) == ("cost", "td", 2)
    np.testing.assert_array_equal(MPCPolicy.load(tmp_path / "learner_policy.zip").mpc.theta, learner.theta)
    np.testing.assert_array_equal(learner.nominal_mpc.theta, nominal_mpc(PENDULUM, alpha=1.0, seed=2).theta)
    assert "stage_cost.W" in plain(result)
    assert f"mpcoffline evaluate learner_policy.zip --env {PENDULUM}" in plain(result)
    assert call("evaluate", "learner.zip", "--env", PENDULUM, "--episodes", "1").exit_code == 0


def test_collect_prints_the_return_curve_and_what_to_do_next(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, object] = {}

    def collected(task: str, **options: object) -> SimpleNamespace:
        seen.update(options, task=task)
        return SimpleNamespace(spec=SimpleNamespace(dataset_id="mine/pendulum-v0"), total_steps=300)

    monkeypatch.setattr("mpcoffline.gallery.collection.collect", collected)
    monkeypatch.setattr("mpcoffline.gallery.collection.return_curve", lambda _: np.array([-900.0, -500.0, -100.0]))
    result = call("collect", "pendulum", "--steps", "300", "--dataset-id", "mine/pendulum-v0")
    assert result.exit_code == 0, result.output
    assert seen["task"] == "pendulum"
    assert seen["steps"] == 300
    assert re.search(r"1-1 +-900.0 +█ *\n", plain(result))
    assert "mpcoffline learn --dataset mine/pendulum-v0" in plain(result)


def test_run_hands_its_options_on_and_says_where_the_files_are(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, object] = {}

    def run_task(task: str, **options: object) -> SimpleNamespace:
        seen.update(options, task=task)
        return SimpleNamespace(table=lambda: "TABLE", notes=lambda: ["a note"])

    monkeypatch.setattr("mpcoffline.studies.run_task", run_task)
    result = call("run", "cartpole", "--alpha", "1.5", "--seed", "4", "--episodes", "6", "--value", "expectile")
    assert result.exit_code == 0, result.output
    assert seen == {
        "task": "cartpole",
        "alpha": 1.5,
        "seed": 4,
        "dataset": None,
        "n_episodes": 6,
        "output": Path("results/cartpole"),
        "value": "expectile",
    }
    assert "results/cartpole/figure.png" in plain(result)
