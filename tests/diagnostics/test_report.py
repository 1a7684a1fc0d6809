"""A report with invented numbers: its text, its JSON form, its picture."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from invented_report import GAINS, GOOD, report_of
from invented_trials import trials

from mpcoffline.simulation.trials import Trials


def test_the_text_has_the_table_the_candidates_and_how_far_models_and_log_agree() -> None:
    text = str(report_of(GOOD))
    lines = text.splitlines()
    assert lines[0] == "Verdict: recommend"
    table = lines[lines.index("Cost of an episode of 50 steps, 64 starts") + 1 :]
    assert [line.split()[0] for line in table[1:4]] == ["today", "MPC_1", "full"]
    assert "8 of 8 models predict the log well enough to be asked" in " ".join(text.split())
    tried = lines[lines.index("Candidates, by these episodes (* is judged)") + 1 :]
    assert tried[1].split()[:3] == ["full", "fit", "*"]
    assert "7 of 8" in tried[1]
    assert tried[4].split()[:2] == ["today", "(clone)"]
    assert "model.a[2] and 37 more" in text
    assert all(len(line) < 100 for line in lines)


def test_the_json_form_says_the_same() -> None:
    found = report_of(GOOD)
    data = json.loads(found.to_json())
    assert data["verdict"] == "recommend"
    assert data["proposal"] == "full fit"
    assert data["reasons"] == list(found.reasons)
    assert data["costs"]["today"][1] == pytest.approx(140.0)
    assert data["candidates"][0]["name"] == "full fit"
    assert data["candidates"][0]["agree"] == 7
    assert len(data["difference"]["mean"]) == 8
    assert data["today"]["logged"] == pytest.approx(140.0)
    assert data["trials"]["cost"]["MPC_1"][0] == pytest.approx(GOOD.cost[0, 0].mean())
    assert data["value"]["correlation"] == 0.9
    assert data["theorem"]["eigenvalues"] == [0.9, 0.5]
    assert "traces" not in data


def test_candidates_are_those_of_the_choice() -> None:
    found = report_of(trials({"identified": GAINS["identified + V"]}), "identified", GOOD)
    text = str(found)
    assert "Candidates, by the choice of the fit (* is judged)" in text
    assert "full fit" in text
    assert len(json.loads(found.to_json())["candidates"]) == 4
    kept = report_of(trials({"identified": [-1.0, -2.0]}), "MPC_1", GOOD)
    assert "The choice kept MPC_1. Of 3 candidates, full fit costs 50.2" in kept.reasons[0]
    assert "candidate='full fit' hands it out" in kept.reasons[0]


@pytest.mark.parametrize(
    ("tried", "name"),
    [
        (GOOD, "MPC_1"),
        (trials({"full fit": [1.0]}, n_starts=1), "full fit"),
        (trials({"full fit": [1.0, 2.0]}, votes=[False, False], today=50.0), "full fit"),
        (replace(GOOD, cost=np.full_like(GOOD.cost, np.nan), second=np.full_like(GOOD.cost, np.inf)), "full fit"),
    ],
)
def test_whatever_came_of_the_trials_there_is_a_report(tried: Trials, name: str) -> None:
    found = report_of(tried, name)
    assert str(found).startswith("Verdict: ")
    data: dict[str, Any] = json.loads(found.to_json())
    assert data["verdict"] == "keep MPC_1"
    assert data["reasons"]
    assert len(found.plot().axes) == 6


def test_the_figure_is_written(tmp_path: Path) -> None:
    files = report_of(GOOD).figure(tmp_path / "report.png")
    assert [file.name for file in files] == ["report.pdf", "report.png"]
    assert all(file.stat().st_size > 10_000 for file in files)
