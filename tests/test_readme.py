"""What the README says is so: its code runs, its files exist, its commands are commands."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mpcoffline.cli.main import app
from mpcoffline.datasets.store.local import shipped_datasets
from mpcoffline.learner.presets import PRESETS

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.slow
def test_the_code_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "minari").mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.chdir(tmp_path)
    # Whether learning succeeds is tested elsewhere; here it is brief.
    brief = PRESETS["default"].replaced({"value_n_steps": 200, "refit_rows": 2000, "terminal": "quadratic"})
    monkeypatch.setitem(PRESETS, "default", brief)
    monkeypatch.setattr("mpcoffline.simulation.surroundings._MOST_STEPS", 20)
    monkeypatch.setattr(import_module("mpcoffline.learning.known_cost"), "normed_cost", lambda *_: None)
    names: dict[str, object] = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    assert (tmp_path / "policy.zip").exists()
    assert names["history"]


def test_the_quick_start_has_the_same_code() -> None:
    assert blocks("python")[0] in (ROOT / "docs" / "quickstart.md").read_text(encoding="utf-8")


def test_the_code_is_short() -> None:
    lines = [line for line in blocks("python")[0].splitlines() if line and not line.startswith(("import", "from"))]
    assert len(lines) <= 16


def test_links_lead_to_files() -> None:
    links = [link.split("#")[0] for link in re.findall(r"\]\(([^)]+)\)", TEXT) if "://" not in link]
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_every_command_line_parses() -> None:
    commands = [line.split("#")[0].split()[1:] for line in "".join(blocks("console")).splitlines()]
    assert len(commands) >= 7
    for program, *arguments in commands:
        if program.startswith("scripts/"):
            assert (ROOT / program).stat().st_mode & 0o100
        else:
            command = arguments if arguments[0] == "datasets" else arguments[:1]
            known = CliRunner().invoke(app, [*command, "--help"], env={"COLUMNS": "200"})
            assert known.exit_code == 0
            assert all(argument in known.output for argument in arguments if argument.startswith("--"))


def test_every_shipped_data_set_is_named() -> None:
    assert all(f"`{name}`" in TEXT for name in shipped_datasets())
