"""The page and the figure, from lines of results by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mpcoffline.studies import lines
from mpcoffline.studies.field import page, picture
from mpcoffline.studies.field.jobs import Outcome
from mpcoffline.studies.field.page import Results


def row(algorithm: str, size: int, cost: float, seed: int = 0, arena: str = "tank", **more: float | str) -> Outcome:
    return Outcome(arena, algorithm, size, seed, 30, 0, cost=cost, cost_error=0.5, **more)  # type: ignore[arg-type]


@pytest.fixture
def results(tmp_path: Path) -> list[Outcome]:
    """A plant where ours loses from the small log and wins from the large one; another whose costs are negative."""
    rows = [row("truth", 0, 10.0), row("behaviour", 0, 40.0), row("truth", 0, 10.0, seed=1)]
    times = {"train_s": 6.0, "regressions_s": 2.0, "verdict_s": 2.0, "pass_s": 0.01}
    rows += [
        row("default", 1_000, 15.0, verdict="recommend", **times),
        row("default", 1_000, 17.0, 1, verdict="keep MPC_1"),
    ]
    rows += [row("bc", 1_000, 12.0), row("default", 5_000, 10.1, verdict="recommend"), row("bc", 5_000, 10.0)]
    rows += [row("mpcrl", 1_000, np.nan, rows=1_000, train_s=24.0, said="from 2.00% of the log")]
    rows += [row("iql", 5_000, np.nan, error="no luck")]
    rows += [row("truth", 0, -20.0, arena="battery"), row("bc", 1_000, -15.0, arena="battery")]
    for each in rows:
        lines.append(tmp_path / "field.csv", each)
    return lines.read(tmp_path / "field.csv", Outcome)


def test_excess_knows_no_sign(results: list[Outcome]) -> None:
    found = Results(results)
    ours, battery = found.cell("tank", "default", 1_000), found.cell("battery", "bc", 1_000)
    assert ours is not None
    assert battery is not None
    assert ours.cost == pytest.approx(16.0)
    assert ours.error == pytest.approx(1.0)  # sqrt(2) / sqrt(2)
    assert ours.excess == pytest.approx(1.6)
    assert battery.excess == pytest.approx(1.25)
    assert found.cell("tank", "iql", 5_000) is None


def test_the_page_says_what_is_there_and_leaves_the_rest_blank(results: list[Outcome]) -> None:
    text = page.report(results)
    assert "| 1,000 | mpcoffline, default | 16 +- 1 |" in text.replace("\\", "")
    assert "1 recommend; 1 keep MPC" in text.replace("\\", "")
    assert "| 5,000 | behaviour cloning | 10 +- 0.5 |" in text
    blank = [line for line in text.splitlines() if line.startswith("| 5,000 | IQL |")]
    assert not blank  # nothing of IQL came out anywhere
    assert "* Not run on any log:" in text
    assert "IQL" in text.partition("* Not run on any log:")[2].splitlines()[0]
    assert "* Failed: tank, 5,000, seed 0, iql: no luck" in text
    timed = "| tank | 1,000 | 0 | 24 | 2.00% of the log | 24 | 0.01 (2,400 x) | 2 (12 x) | 8 (3 x) |"
    assert timed in text.replace("\\", "")
    lost = text.partition("## What we lose")[2].partition("\n## ")[0]
    # Of the seeds that both have: 15 against 12; 10.1 is as good as 10.
    assert "* tank, 1,000 transitions: behaviour cloning (12 against 15)" in lost
    assert "tank, 5,000" not in lost
    assert "battery" not in lost


def test_the_figure_is_drawn_for_both_kinds_of_page(results: list[Outcome], tmp_path: Path) -> None:
    files = picture.write(results, tmp_path)
    assert [file.name for file in files] == ["field_light.png", "field_dark.png"]
    light, dark = (file.read_bytes() for file in files)
    assert light != dark
    with picture.themed("light"):
        figure = picture.drawn(Results(results), "light")
    assert [axes.get_title("left") for axes in figure.axes if axes.axison] == ["tank", "battery"]
