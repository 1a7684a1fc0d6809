"""The walk from a CSV runs as the page says it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from tank_logs import simulated, text
from typer.testing import CliRunner

import mpcoffline.tune as tune_module
from mpcoffline.cli import app

pytest.importorskip("polars")
PAGE = (Path(__file__).parents[2] / "docs" / "guides" / "from_csv.md").read_text(encoding="utf-8")


def test_its_code_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "store"))
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(app, ["new", "two_tank.py"]).exit_code == 0
    Path("log.csv").write_text(text(simulated()), encoding="utf-8")

    class Learner:
        rows = 0

        def fit(self, table: Any) -> None:
            self.rows = len(table)

    names: dict[str, Any] = {"learner": Learner()}
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 3
    whole = tune_module.tune
    monkeypatch.setattr(tune_module, "tune", lambda *given: whole(*given, preset="fast", value_n_steps=60))
    for block in blocks:
        exec(block, names)
    assert names["tuned"].folder == Path("tuned")
    assert names["policy"].mpc.model.space.names == ["k", "c1", "c2"]
    assert names["learner"].rows == 59
    assert names["env"].spec.id == "plants/TwoTanks-v0"
