"""What stands first on each page of results is what the page says: figures of a summary, tables of a picture."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
_SPEC = importlib.util.spec_from_file_location("results_pages", DOCS / "_ext" / "results_pages.py")
assert _SPEC is not None
assert _SPEC.loader is not None
results_pages = importlib.util.module_from_spec(_SPEC)
sys.modules["results_pages"] = results_pages
pytest.importorskip("sphinx")
_SPEC.loader.exec_module(results_pages)
PAGES = sorted(path.stem for path in (DOCS / "results").glob("*.md") if path.stem != "index")


def test_every_page_has_both() -> None:
    assert sorted(results_pages.glances()) == PAGES


@pytest.mark.parametrize("page", PAGES)
def test_each_figure_of_a_summary_stands_on_its_page(page: str) -> None:
    text = (DOCS / "results" / f"{page}.md").read_text(encoding="utf-8")
    summary = results_pages.glances()[page]["summary"].replace("MPC_", "")
    for number in re.findall(r"(?<![\w.])\d[\d,.]*\d|(?<![\w.])\d", summary):
        assert re.search(rf"(?<![\d.]){re.escape(number)}(?![\d])", text), number


@pytest.mark.parametrize("page", PAGES)
def test_each_picture_is_of_a_table_with_numbers(page: str) -> None:
    text = (DOCS / "results" / f"{page}.md").read_text(encoding="utf-8")
    series, rows = results_pages.rows_of(text, results_pages.glances()[page])
    assert len(rows) >= 2
    assert all(len(row) == len(series) for row in rows.values())


def test_numbers_are_those_of_the_table() -> None:
    rows = (
        "| a | J | K |",
        "| --- | --: | --: |",
        "| x/1 | 1,200 ± 3 | 4 ms |",
        "| x/2 | **800** | 6 ms |",
        "| y | -2 | - |",
    )
    text = "\n".join(["# T", "", *rows, "", "end", ""])
    wanted = {"label": "a", "values": ["J"]}
    assert results_pages.rows_of(text, wanted)[1] == {"x/1": [1200.0], "x/2": [800.0], "y": [2.0]}
    assert results_pages.rows_of(text, wanted | {"sum": True, "values": ["J", "K"]})[1] == {"x": [2000.0, 10.0]}
