"""Figures: what is drawn, that equal figures give equal files, and that colours are not the only difference."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes

from mpcoffline import plotting
from mpcoffline.plotting import Signal


@pytest.fixture
def axes() -> Axes:
    with plotting.paper_style():
        return plotting.new_figure(3.0, 2.0).subplots()


def test_files_are_written_beside_each_other_and_are_reproducible(tmp_path: Path) -> None:
    contents = []
    for name in ("first.v1", "second"):  # a dot in the name is no suffix
        with plotting.paper_style():
            figure = plotting.new_figure(3.0, 2.0)
            plotting.draw_bars(figure.subplots(), {"MPC_1": {"J": 1.2}, "MPC_3": {"J": 0.9}})
            files = plotting.save_figure(figure, tmp_path / name)
        assert [file.name for file in files] == [f"{name}.pdf", f"{name}.png"]
        contents.append([file.read_bytes() for file in files])
    assert contents[0] == contents[1]
    assert contents[0][0].startswith(b"%PDF")
    assert b"/Type3" not in contents[0][0], "publishers refuse Type 3 fonts"


def test_the_style_ends_with_its_block() -> None:
    before = mpl.rcParams["font.size"], mpl.rcParams["axes.grid"]
    with plotting.paper_style():
        assert mpl.rcParams["axes.grid"] is True
    assert (mpl.rcParams["font.size"], mpl.rcParams["axes.grid"]) == before


def test_controllers_differ_by_more_than_colour() -> None:
    styles = [*plotting.STYLES.values(), plotting.OTHER]
    assert len({str(style.dashes) for style in styles}) == len(styles) or len({s.width for s in styles}) > 1
    assert len({style.color for style in styles}) == len(styles)


def test_an_angle_is_drawn_without_jumps_from_its_first_turn(axes: Axes) -> None:
    angle = np.array([-3.0, -3.1, 3.1, 3.0])  # falls through the hanging position
    plotting.draw_signal(axes, Signal("phi", {"MPC_3": angle}, target=0.0, angle=True, band=0.3), dt=0.05)
    curve = axes.lines[0].get_ydata()
    np.testing.assert_allclose(curve, np.array([-3.0, -3.1, 3.1 - 2 * np.pi, 3.0 - 2 * np.pi]) + 2 * np.pi)


def test_ticks_of_an_angle_are_half_turns(axes: Axes) -> None:
    plotting.draw_signal(axes, Signal("phi", {"MPC_3": np.linspace(7.0, -4.0, 50)}, target=0.0, angle=True), dt=0.1)
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["$-3\\pi$", "$-2\\pi$", "$-\\pi$", "0"]


def test_bounds_in_reach_are_drawn_and_distant_ones_are_named(axes: Axes) -> None:
    plotting.draw_signal(axes, Signal("u", {"MPC_1": np.array([1.9, -2.0])}, bounds=(-2.0, 2.0), held=True), dt=0.1)
    low, high = axes.get_ylim()
    assert low < -2.0
    assert high > 2.0
    assert not axes.texts
    with plotting.paper_style():
        distant = plotting.new_figure(3.0, 2.0).subplots()
    plotting.draw_signal(distant, Signal("u", {"MPC_1": np.array([0.1, 0.2])}, bounds=(-10.0, 10.0), held=True), dt=0.1)
    assert [text.get_text() for text in distant.texts] == ["bounds $\\pm$10"]
    assert distant.get_ylim()[1] < 1.0


def test_bars_carry_their_values_and_fit_the_frame(axes: Axes) -> None:
    plotting.draw_bars(axes, {"MPC_1": {"J": 2.254, "Jd": 1.0}, "MPC_3": {"J": 0.5, "Jd": 0.98}})
    assert [text.get_text() for text in axes.texts] == ["2.25", "0.50", "1.00", "0.98"]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["MPC$_{1}$", "MPC$_{3}$"]
    assert axes.get_ylim()[0] == 0.0
    assert axes.get_ylim()[1] > 2.254


def test_labels() -> None:
    assert plotting.controller_label("MPC_12") == "MPC$_{12}$"
    assert plotting.controller_label("reference") == "reference"
    assert plotting.controller_label("td3_bc_run") == "td3_bc_run"
    assert plotting.controller_label("a$b$c") == r"a\$b\$c"
    handles, labels = plotting.legend_handles(["MPC_1", "someone else"])
    assert len(handles) == 2
    assert labels == ["MPC$_{1}$", "someone else"]
