"""A report in a browser, as on a phone and on paper; left out where there is none."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from invented_report import GOOD, background, report_of

from mpcoffline.diagnostics.page import page_of

webdriver: Any = pytest.importorskip("selenium.webdriver")

# Cells of one short word that is written in more than one line.
BROKEN = """
const short = [...document.querySelectorAll("td, th")].filter(e => /^[^\\s]{1,12}$/.test(e.innerText.trim()));
const tall = e => { const r = document.createRange(); r.selectNodeContents(e); return r.getClientRects().length > 1; };
return [short.length, short.filter(tall).map(e => e.innerText)];
"""
# Headings whose style lets a page end behind them.
LOOSE = """
return [...document.querySelectorAll("h2, h3, h4")].filter(e => getComputedStyle(e).breakAfter !== "avoid").map(
  e => e.innerText);
"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no chromium with chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(word)
    found = webdriver.Chrome(options, webdriver.ChromeService(driver))
    yield found
    found.quit()


@pytest.fixture
def shown(browser: Any, tmp_path: Path) -> Any:
    file = tmp_path / "report.html"
    file.write_text(page_of(replace(report_of(GOOD), background=background())), encoding="utf-8")
    browser.get(file.as_uri())
    return browser


@pytest.mark.parametrize("width", [1280, 400, 360])
def test_words_of_tables_stay_whole_and_nothing_is_wider_than_the_screen(shown: Any, width: int) -> None:
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    shown.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    count, broken = shown.execute_script(BROKEN)
    assert count > 20
    assert broken == []
    assert shown.execute_script("return document.documentElement.scrollWidth") <= width


def test_on_paper_no_heading_is_left_behind(shown: Any) -> None:
    shown.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert shown.execute_script(LOOSE) == []
    shown.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
