"""``plot`` and ``diagnose``: files, JSON, and the wrong kind of file."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from mpcoffline import OfflineMPCLearner, load_dataset, nominal_mpc
from mpcoffline.cli.main import app
from mpcoffline.datasets import TransitionTable

PENDULUM = "mpcoffline/PendulumSwingUp-v0"
DATA = "mpcoffline/pendulum/ddpg-v0"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a learner that has learned little, and its policy."""
    folder = tmp_path_factory.mktemp("learned")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        table = TransitionTable.from_minari(load_dataset(DATA))
    mpc = nominal_mpc(PENDULUM, alpha=1.0, seed=0).replace(horizon=5)
    learner = OfflineMPCLearner(mpc, preset="paper", value_n_steps=20, hidden=(8,), fit_n_steps=2, refit_rows=300)
    learner.fit(table, show_progress=False)
    learner.save(folder / "learner.zip")
    learner.policy.save(folder / "policy.zip")
    return folder


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "minari").mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.chdir(tmp_path)


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.slow
def test_plot_writes_every_figure_and_the_film(files: Path) -> None:
    pytest.importorskip("pygame")
    result = call("plot", files / "learner.zip", "--out", "figures", "--animate", "film.gif", "--json")
    assert result.exit_code == 0, result.output
    written = [Path(name) for name in json.loads(result.stdout)["files"]]
    figures = {f"{name}.{suffix}" for name in ("training", "cost", "closed_loop", "phase_portrait")
               for suffix in ("pdf", "png")}  # fmt: skip
    assert {path.name for path in written} == figures | {"film.gif"}
    assert all(path.stat().st_size > 5_000 for path in written)


def test_plot_refuses_before_it_works(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learner = files / "learner.zip"
    assert ".gif or .mp4" in call("plot", learner, "--animate", "film.avi").stderr
    wrong = call("plot", learner, "--env", "mpcoffline/CartPoleSwingUp-v0")
    assert wrong.exit_code == 1
    assert "in the environment that its MPC models" in wrong.stderr
    monkeypatch.setitem(sys.modules, "pygame", None)
    missing = call("plot", learner, "--animate", "film.gif")
    assert missing.exit_code == 1
    assert 'pip install "mpcoffline[render]"' in missing.stderr
    assert not Path("figures").exists()


@pytest.mark.parametrize("command", [["plot"], ["diagnose", "--dataset", DATA]])
def test_a_policy_is_not_a_learner(files: Path, command: list[str]) -> None:
    result = call(*command, files / "policy.zip")
    assert result.exit_code == 1
    assert "expected a learner, got a policy" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_missing_file_shows_usage() -> None:
    result = call("plot", "nothing.zip")
    assert result.exit_code == 2
    assert "nothing.zip" in result.stderr


class MadeUpReport:
    """Stands for a report, whose content is tested with the diagnostics."""

    verdict = "recommend"

    def __str__(self) -> str:
        return "Verdict: recommend [of a learner]"

    def to_json(self) -> str:
        return '{"verdict": "recommend"}'

    def figure(self, path: Path) -> list[Path]:
        path.write_bytes(b"a figure")
        return [path]

    def html(self, path: Path) -> Path:
        path.write_text("a page")
        return path


@pytest.mark.usefixtures("shipped")
def test_diagnose_prints_the_report_or_its_json(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mpcoffline.diagnostics.diagnose", lambda *_, **__: MadeUpReport())
    arguments = ("diagnose", files / "learner.zip", "--dataset", DATA, "--out", "report.png")
    text = call(*arguments)
    assert text.exit_code == 0, text.output
    assert text.stdout.splitlines() == ["Verdict: recommend [of a learner]", "Figure: report.png"]
    document = json.loads(call(*arguments, "--json").stdout)
    assert document == {"verdict": "recommend", "files": ["report.png"]}
    both = (*arguments, "--html", "report.html")
    assert call(*both).stdout.splitlines()[1:] == ["Figure: report.png", "Page: report.html"]
    assert json.loads(call(*both, "--json").stdout)["files"] == ["report.png", "report.html"]
    Path("taken").write_text("no folder")
    refused = call(*arguments, "--html", "taken/report.html")
    assert refused.exit_code == 1
    assert "taken" in refused.stderr


@pytest.mark.parametrize(
    ("work", "command"),
    [("mpcoffline.evaluate", ["plot"]), ("mpcoffline.diagnostics.diagnose", ["diagnose", "--dataset", DATA])],
)
@pytest.mark.usefixtures("shipped")
def test_ctrl_c_leaves_no_files(files: Path, work: str, command: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work, lambda *_, **__: signal.raise_signal(signal.SIGINT))
    result = call(*command, files / "learner.zip")
    assert result.exit_code == 130
    assert result.stderr.strip().splitlines()[-1] == "Interrupted."
    assert {path.name for path in Path().iterdir()} == {"minari"}
