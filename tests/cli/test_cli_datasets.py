"""The commands around data sets, and the export of a policy."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mpcoffline.cli.main import app
from mpcoffline.datasets import dataset_from_arrays

SHIPPED = "mpcoffline/linear/ddpg-v0"


@pytest.fixture(autouse=True)
def _own_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "minari").mkdir()
    monkeypatch.delenv("MINARI_REMOTE", raising=False)


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["datasets", *arguments])
    return result.exit_code, result.output


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_show_prints_the_card_and_draws_the_coverage(tmp_path: Path) -> None:
    code, output = run("show", SHIPPED, "--figure", str(tmp_path / "coverage.png"))
    assert code == 0
    assert "50000" in output
    assert (tmp_path / "coverage.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["coverage", "coverage.xyz"])
def test_show_refuses_a_figure_that_cannot_be_written(name: str, tmp_path: Path) -> None:
    code, output = run("show", SHIPPED, "--figure", str(tmp_path / name))
    assert code == 1
    assert "--figure: expected a file ending in" in output
    assert ".png" in output


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_verify_replay_and_repair_of_intact_data() -> None:
    assert run("verify", SHIPPED)[0] == 0
    code, output = run("replay", SHIPPED, "--episodes", "3")
    assert code == 0
    assert "3 episodes, 300 steps" in " ".join(output.split())
    code, output = run("repair", SHIPPED)
    assert code == 0
    assert "intact" in output


def test_verify_says_what_is_wrong(tmp_path: Path) -> None:
    dataset_from_arrays("mine/log-v0", [(np.zeros((4, 2)), np.zeros((3, 1)), np.zeros(3))])
    metadata = tmp_path / "minari" / "mine" / "log-v0" / "data" / "metadata.json"
    content = json.loads(metadata.read_text())
    metadata.write_text(json.dumps(content | {"total_episodes": 499}))
    code, output = run("verify", "mine/log-v0")
    assert code == 1
    assert "499" in output


@pytest.mark.parametrize("command", ["show", "verify", "replay", "repair", "upload"])
def test_unknown_ids_are_refused(command: str) -> None:
    code, _ = run(command, "mpcoffline/linear/dpg-v0")
    assert code == 1


def test_downloading_without_a_remote_says_how_to_set_one() -> None:
    result = CliRunner().invoke(app, ["datasets", "download", "mine/plant/log-v0"])
    assert result.exit_code == 1
    assert "MINARI_REMOTE" in result.stderr


def test_list_as_json_is_one_document() -> None:
    result = CliRunner().invoke(app, ["datasets", "list", "--json"])
    rows = json.loads(result.stdout)
    assert {"id": SHIPPED, "where": "shipped", "episodes": 500, "steps": 50000} in rows


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_show_as_json_has_the_numbers() -> None:
    result = CliRunner().invoke(app, ["datasets", "show", SHIPPED, "--json"])
    summary = json.loads(result.stdout)
    assert summary["dataset_id"] == SHIPPED
    lengths = next(row for row in summary["statistics"] if row["name"] == "steps of an episode")
    assert lengths["mean"] == 100.0


def test_what_was_changed_on_purpose_is_accepted(tmp_path: Path) -> None:
    dataset_from_arrays("mine/log-v0", [(np.zeros((4, 2)), np.zeros((3, 1)), np.zeros(3))])
    metadata = tmp_path / "minari" / "mine" / "log-v0" / "data" / "metadata.json"
    metadata.write_text(json.dumps(json.loads(metadata.read_text()) | {"description": "mine"}))
    assert run("verify", "mine/log-v0")[0] == 1
    code, output = run("verify", "mine/log-v0", "--accept")
    assert (code, "accepted" in output) == (0, True)
    assert run("verify", "mine/log-v0")[0] == 0
