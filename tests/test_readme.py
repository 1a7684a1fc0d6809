"""What the README says is so: its code runs, its files exist, its commands are commands."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mpcoffline.cli import app
from mpcoffline.datasets.minari_store import shipped_datasets
from mpcoffline.presets import PRESETS

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
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-2, 2, (2000, 2)), rng.uniform(-2, 2, (2000, 1))
    names: dict[str, object] = {  # what the README calls "your log": a sledge of another mass
        "observations": x,
        "actions": u,
        "costs": x[:, 0] ** 2 + 0.1 * x[:, 1] ** 2 + 0.01 * u[:, 0] ** 2,
        "next_observations": x + 0.05 * np.c_[x[:, 1], u[:, 0] / 1.3],
        "terminations": np.zeros(2000, dtype=bool),
    }
    for block in blocks("python"):
        # An agent that has hardly begun to learn shows as well that its run is recorded.
        exec(compile(block.replace("50_000", "500"), "README.md", "exec"), names)
    result, own = names["result"], names["learner"]
    assert len(result.cost) == 20  # type: ignore[attr-defined]
    assert names["dataset"].total_steps == 500  # type: ignore[attr-defined]
    assert own.result.loss_after < own.result.loss_before  # type: ignore[attr-defined]


def test_the_code_is_short() -> None:
    lines = [line for line in blocks("python")[0].splitlines() if line and not line.startswith(("import", "from"))]
    assert len(lines) <= 16


def test_links_lead_to_files() -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", TEXT) if "://" not in link]
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
