"""What notebooks show: names, units and numbers, escaped."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
from invented_report import GOOD, report_of
from two_tanks import two_tanks

from mpcoffline import OfflineMPCLearner, TransitionTable
from mpcoffline.core.notebook import html_of
from mpcoffline.core.tables import Table


def words(html: str) -> str:
    """The text of a piece of well-formed HTML."""
    return " ".join(" ".join(ET.fromstring(f"<div>{html}</div>").itertext()).split())


def test_text_is_escaped_and_long_tables_are_cut() -> None:
    table = Table(("a<b", "n"), [("<script>", str(k)) for k in range(50)], align="lr")
    html = html_of("x & y", [("k", "<v>")], [table], ["1 < 2"])
    assert "<script>" not in html
    assert "and 10 more" in html
    assert words(html).startswith("x & y 1 < 2 k <v> a<b n <script> 0")


def test_an_mpc_shows_names_units_and_bounds() -> None:
    text = words(two_tanks().mpc()._repr_html_())
    for each in ("h1 [cm], h2 [cm], set_point [cm]", "pump [V], 0 to 6", "overflow", "model.k cm/s/V 0.07"):
        assert each in text
    learner = OfflineMPCLearner(two_tanks().mpc())
    assert "not fitted" in words(learner._repr_html_())


def test_a_table_shows_what_its_columns_range_over() -> None:
    s = np.arange(12.0).reshape(6, 2)
    table = TransitionTable.from_arrays(s, np.full((6, 1), 7.0), np.arange(6.0), s + 2, np.zeros(6))
    text = words(table._repr_html_())
    assert "6 transitions in 1 episode " in text
    assert "observation 1 1 6 11" in text
    assert "action 0 7 7 7 0" in text
    assert "cost 0 2.5 5" in text


def test_a_report_shows_its_verdict() -> None:
    report = report_of(GOOD)
    text = words(report._repr_html_())
    assert text.startswith(f"Verdict: {report.verdict}")
    assert report.reasons[0] in text
