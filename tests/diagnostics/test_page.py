"""A report as a page: whole, by itself, escaped, and readable without eyes."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bs4 import BeautifulSoup
from invented_report import GOOD, background, report_of
from invented_trials import trials

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.diagnostics import Names
from mpcoffline.diagnostics.limits import LimitCheck
from mpcoffline.diagnostics.loops import _chosen
from mpcoffline.diagnostics.marks import Marks
from mpcoffline.diagnostics.measures import ValueCheck
from mpcoffline.diagnostics.page import number, page_of, pair, prose

ODD = '<script>alert("1")</script>&amp;'


@pytest.fixture(scope="module")
def page() -> str:
    report = replace(report_of(GOOD), background=background(odd=ODD), notes=(f"A note on {ODD}.",))
    return page_of(
        replace(report, limits=(LimitCheck(ODD, "hard", (0.1, 0.0, 0.25), (2.0, 0.0, 0.5), True),)), title=ODD
    )


@pytest.fixture(scope="module")
def soup(page: str) -> BeautifulSoup:
    return BeautifulSoup(page, "html.parser")


def test_the_page_holds_verdict_reasons_candidates_parameters_and_hashes(soup: BeautifulSoup) -> None:
    report, text = report_of(GOOD), " ".join(soup.get_text(" ").split())
    assert soup.find(id="verdict").get_text() == "Verdict: recommend"
    for reason in report.reasons:
        assert prose(reason) in text
    for name in ("full fit", "identified + V", "identified + nominal cost", "today (clone)"):
        assert soup.find("th", string=name, scope="row")
    rows = {row.th.get_text(): [cell.get_text() for cell in row("td")] for row in soup("tr") if row.th and row.td}
    assert rows["model.area"] == ["0.3", "0.4123 ± 0.004", "0.4", "cm2"]
    assert rows[f"model.{ODD}"][1].startswith("not determined")
    assert rows["stage_cost.W[0,0]"] == ["1", "1.25·10⁻⁷", ""]
    assert rows["stage_cost.new"][0] == "–"
    assert rows["today, as logged"][1] == "140"
    assert rows["SHA-256 of the learned theta"] == ["0123456789abcdef" * 4]
    limit = rows[f"{ODD} (hard)"]
    assert limit == ["10 % of the steps, by up to 2", "kept", "25 % of the steps, by up to 0.5"]
    assert "in EUR" in text
    assert f"A note on {ODD}." in text


def test_it_is_one_small_file_that_asks_for_nothing_else(page: str, soup: BeautifulSoup) -> None:
    assert len(page.encode()) < 3e6
    assert not soup(["script", "link", "img", "iframe", "image", "object"])
    links = [tag[name] for tag in soup(True) for name in ("href", "src", "xlink:href") if tag.has_attr(name)]
    assert all(link.startswith("#") or (link.startswith("https://arxiv.org/")) for link in links)
    assert not re.search(r"url\((?!#)|@import", page)
    assert not [name for tag in soup(True) for name in tag.attrs if name.startswith("on")]


def test_it_is_a_document_whose_references_hold(page: str, soup: BeautifulSoup) -> None:
    assert page.startswith("<!DOCTYPE html>\n<html lang=")
    ids = [tag["id"] for tag in soup(True) if tag.has_attr("id")]
    assert len(ids) == len(set(ids))
    wanted = set(re.findall(r"url\(#([^)]+)\)", page)) | {a["href"][1:] for a in soup("a", href=re.compile("^#"))}
    wanted |= {tag["href"][1:] for tag in soup("use")} | {tag["aria-labelledby"] for tag in soup("section")}
    assert wanted <= set(ids)
    assert str(soup).count("</") == page.count("</")  # what is opened is closed: the parser added nothing


def test_headings_pictures_and_tables_can_be_heard(soup: BeautifulSoup) -> None:
    levels = [int(tag.name[1]) for tag in soup(re.compile("^h[1-6]$"))]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    pictures = soup("svg")
    assert len(pictures) == 6 + 3
    assert all(svg["role"] == "img" and len(svg["aria-label"]) > 20 for svg in pictures)
    assert all(tag["scope"] in ("row", "col") for tag in soup("th"))


def test_names_from_files_stay_text(page: str, soup: BeautifulSoup) -> None:
    assert "<script" not in page
    assert soup.h1.get_text() == ODD
    assert f"model.{ODD}" in [tag.get_text() for tag in soup("th")]


@pytest.mark.parametrize(
    ("tried", "name"),
    [
        (GOOD, "MPC_1"),
        (trials({"full fit": [1.0]}, n_starts=1), "full fit"),
        (trials({"full fit": [1.0, 2.0]}, votes=[False, False], today=50.0), "full fit"),
        (replace(GOOD, cost=np.full_like(GOOD.cost, np.nan), second=np.full_like(GOOD.cost, np.inf)), "full fit"),
    ],
)
def test_whatever_came_of_the_trials_there_is_a_page(tried: object, name: str) -> None:
    page = page_of(report_of(tried, name))
    assert "Verdict: keep MPC_1" in page
    assert "nan" not in re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL).lower()


def test_other_names_take_the_place_of_numbers(tmp_path: Path) -> None:
    report = replace(report_of(GOOD), background=background())
    path = report.html(tmp_path / "new" / "report.html", names=Names(("a", "b"), ("c",), plant="Tank"))
    text = path.read_text(encoding="utf-8")
    assert "<h1>Tank</h1>" in text
    assert report.html(tmp_path / "again.html", names=Names(("a", "b"), ("c",), plant="Tank")).read_text() == text
    with pytest.raises(InvalidArgumentError, match=r"names.states: expected 2 names, got 1"):
        report.html(path, names=Names(("a",), ("c",)))


def test_what_has_nothing_to_show_is_a_sentence_and_no_empty_picture() -> None:
    """As where episodes are too short for V to be compared with what it cost."""
    report = replace(report_of(GOOD), value=ValueCheck(0, np.nan, np.nan, np.nan, np.nan))
    found = BeautifulSoup(page_of(replace(report, background=background())), "html.parser")
    pictures = {svg["aria-label"].split()[0] for svg in found("svg")}
    assert len(found("svg")) == 5 + 3
    assert "V" not in pictures
    said = "V of the last episodes: no episode is long enough for a measured return."
    assert said in [" ".join(tag.get_text().split()) for tag in found("p")]
    assert all(svg("path") and svg("use") for svg in found("svg"))


def test_set_points_limits_and_signals_stand_beside_the_loops() -> None:
    course = np.linspace(0.2, 0.4, 51)
    marks = Marks({0: course}, {(0, 0): (np.full(51, 0.9), np.full(51, 70.0))}, {1: 2.0 * course})
    plain = background()
    marked = replace(plain, loops=(replace(plain.loops[0], marks=marks),))
    before, after = (
        BeautifulSoup(page_of(replace(report_of(GOOD), background=each)), "html.parser") for each in (plain, marked)
    )
    key, bare = (" ".join(each.find(class_="key").get_text(" ").split()) for each in (after, before))
    assert key.endswith("today (log) set-point limit from outside")
    assert bare.endswith("today (log)")
    level, flow, _, outside = (panel.svg for panel in after(class_="panel"))
    assert level["aria-label"].endswith("wanted is 0.4; limits are 0.9, 70.")
    assert outside["aria-label"] == "flow [l/s], from outside: from 0.4 to 0.8, between 0.4 and 0.8."
    assert "wanted" not in flow["aria-label"]
    was = before.find(class_="panel").svg
    # One dashed line more for the set-point, and one for the limit in sight; that at 70 would flatten the curves.
    assert len(lines_of(level)) == len(lines_of(was)) + 2
    assert len(after(class_="panel")) == len(before(class_="panel")) + 1


def lines_of(svg: Any) -> list[Any]:
    """Curves, without the grid and the axes' lines."""
    axes = svg.find(id=re.compile(r"axes_1$"))
    return list(axes(id=re.compile(r"line2d_\d+$"), recursive=False))


def test_numbers_are_written_for_readers() -> None:
    assert [number(v) for v in (1.23456, -0.5, 1.5e-7, 2e11, np.nan, np.inf)] == [
        "1.235", "−0.5", "1.5·10⁻⁷", "2·10¹¹", "unknown", "∞",
    ]  # fmt: skip
    assert pair(12.3456, 0.21) == "12.35 ± 0.21"
    assert pair(-50.123, 1.2, sign=True) == "−50.1 ± 1.2"
    assert pair(0.001, 5.0) == "0.001 ± 5"
    assert prose("a +- 2 of -3 (1 -> -2), 10-step x[-1]") == "a ± 2 of −3 (1 → −2), 10-step x[−1]"
    assert pair(3.0, np.inf) == "3 (doubt unknown)"


def test_the_starts_that_are_shown_are_the_usual_one_and_the_extremes() -> None:
    gains = trials({"full fit": [5.0, 5.0, 5.0]}, n_starts=9)
    cost = gains.cost.copy()
    cost[1] = cost[0] + np.array([0.0, 3.0, -7.0, 1.0, 2.0, -1.0, -2.0, 9.0, np.nan])
    assert list(_chosen(replace(gains, cost=cost), "full fit", 9)) == [3, 2, 7]
    assert list(_chosen(replace(gains, cost=cost), "full fit", 2)) == [1, 0]
