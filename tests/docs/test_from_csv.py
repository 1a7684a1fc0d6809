"""The walk from a CSV runs as the page says it."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from types import SimpleNamespace
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
    assert len(blocks) == 7
    given: list[tuple[Any, ...]] = []  # both have tests of their own, of a minute

    def stand_in(*arguments: Any) -> Any:
        given.append(arguments)
        band = SimpleNamespace(inside=True, off=0.3)
        return SimpleNamespace(policy="policy.zip", calibration=band)

    for name in ("tune", "retune"):
        inspect.signature(getattr(tune_module, name)).bind(*(["given"] * (3 if name == "tune" else 2)))
        monkeypatch.setattr(tune_module, name, stand_in)
    for block in blocks:
        exec(block, names)
    assert given == [(names["plant"], names["table"], "tuned"), ("tuned", "trial.csv")]
    assert names["stats"].periods + names["stats"].skipped == 5
    assert len(Path("served.csv").read_text().splitlines()) == 1 + names["stats"].periods
    assert len(Path("tried.csv").read_text().splitlines()) == 1 + 3 * 40
    tried = names["plant"].read("tried.csv", where={"decided_by": "policy"})
    assert tried.n_episodes == 3  # of the plant's time: no interval is an average
    assert "resampled" not in str(tried.report)
    assert names["learner"].rows == 59
    assert names["env"].spec.id == "plants/TwoTanks-v0"
