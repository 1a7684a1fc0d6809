"""The guide to a plant of one's own: its code is run whenever the documentation is built."""

from __future__ import annotations

from pathlib import Path

PAGE = (Path(__file__).parents[2] / "docs" / "guides" / "own_plant.md").read_text(encoding="utf-8")
HIDDEN = ":tags: [remove-cell]"


def test_no_code_stands_there_that_is_not_run() -> None:
    assert "```python" not in PAGE
    assert PAGE.count(HIDDEN) == 1  # what readers do not see sets up notebooks alone
    for word in ("set-point", "NaN", "time stamp", "(from_csv.md)", "(plant_files.md)", "(time_and_signals.md"):
        assert word in PAGE
