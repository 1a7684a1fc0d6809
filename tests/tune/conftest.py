"""What the tests of a tuned folder share."""

from __future__ import annotations

import pytest
from planted_logs import QUICK, heater, short_episodes

from mpcoffline.tune import Tuned, tune


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Tuned:
    """A heater that is tuned once; tests leave its folder as it is."""
    pytest.importorskip("polars")
    plant = heater()
    return tune(plant, plant.read(short_episodes(21)), tmp_path_factory.mktemp("once") / "tuned", **QUICK)


@pytest.fixture
def unpainted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures of pages are drawn, but not made SVG, which takes as long as a fit: ``once`` has them."""
    monkeypatch.setattr("mpcoffline.diagnostics.page_figures.inline_svg", lambda *_: "<svg></svg>")
