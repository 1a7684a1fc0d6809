"""Figures: one style for all of them, readable in print and for the colour-blind, as vector PDF and PNG."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

COLUMN_WIDTH = 3.5
PAGE_WIDTH = 7.16
_PNG_DPI = 200


@dataclass(frozen=True)
class LineStyle:
    """How one curve is told from the others: by colour (Okabe-Ito), and in black and white by its dashes.

    Attributes:
        color: Colour.
        dashes: Matplotlib line style.
        width: Line width in points.
    """

    color: str
    dashes: Any = "-"
    width: float = 1.4


#: The controllers of the study in every figure; other names get :data:`OTHER`.
STYLES: dict[str, LineStyle] = {
    "MPC_1": LineStyle("#D55E00", (0, (5, 1.6))),
    "MPC_2": LineStyle("#009E73", (0, (4, 1.2, 1, 1.2))),
    "MPC_3": LineStyle("#0072B2", "-", 1.7),
    "reference": LineStyle("#000000", (0, (1, 1.2)), 1.2),
}
OTHER = LineStyle("#CC79A7", (0, (1, 1)))
_BOUND = "#767676"


@contextmanager
def paper_style() -> Iterator[None]:
    """The style of all figures: small sans-serif text, thin axes, embedded fonts."""
    import matplotlib as mpl

    settings: dict[str, Any] = {
        "font.size": 8.0,
        "axes.titlesize": 8.0,
        "axes.labelsize": 8.0,
        "xtick.labelsize": 7.0,
        "ytick.labelsize": 7.0,
        "legend.fontsize": 8.0,
        "axes.linewidth": 0.6,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "xtick.major.size": 2.5,
        "ytick.major.size": 2.5,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": "#E6E6E6",
        "grid.linewidth": 0.5,
        "legend.frameon": False,
        "mathtext.fontset": "dejavusans",
        "pdf.fonttype": 42,  # TrueType: publishers refuse Type 3
        "hatch.linewidth": 0.5,
    }
    rc_context: Any = mpl.rc_context  # its stubs name every key
    with rc_context(settings):
        yield


def new_figure(width: float, height: float) -> Figure:
    """An empty figure in inches that no window and no global state knows of; make it inside :func:`paper_style`."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, stem: Path) -> list[Path]:
    """Writes a figure as vector PDF and as PNG; equal figures give equal files.

    Args:
        figure: The figure.
        stem: Path without suffix.

    Returns:
        The two files.
    """
    pdf, png = stem.with_name(f"{stem.name}.pdf"), stem.with_name(f"{stem.name}.png")
    figure.savefig(pdf, metadata={"CreationDate": None, "Creator": None, "Producer": None})
    figure.savefig(png, dpi=_PNG_DPI, metadata={"Software": None})
    return [pdf, png]


@dataclass(frozen=True)
class Signal:
    """One quantity of a closed loop over time.

    Attributes:
        label: Name and unit for the axis.
        values: One curve a controller, each ``(T,)``.
        bounds: Lower and upper limit that the quantity must keep; drawn as shaded edges.
        target: Value that it should reach; drawn as a thin line.
        held: Whether it is constant between samples (an input).
        angle: Whether it is an angle in rad; it is drawn without jumps, with the target at every full turn.
        band: Half-width around the target that counts as success; shaded.
    """

    label: str
    values: Mapping[str, Array]
    bounds: tuple[float, float] | None = None
    target: float | None = None
    held: bool = False
    angle: bool = False
    band: float | None = None


def draw_signal(axes: Axes, signal: Signal, dt: float) -> None:
    """Draws one quantity over time.

    Args:
        axes: Where.
        signal: What.
        dt: Sampling time in s.
    """
    if signal.target is not None and not signal.angle:
        _draw_target(axes, signal.target, signal.band)
    for name, values in signal.values.items():
        style = STYLES.get(name, OTHER)
        times = dt * np.arange(len(values), dtype=np.float64)
        if signal.held:
            axes.stairs(values, dt * np.arange(len(values) + 1), baseline=None, **_line(style), zorder=3)
        else:
            axes.plot(times, _unwrapped(values) if signal.angle else values, **_line(style), zorder=3)
    if signal.bounds is not None:
        _draw_bounds(axes, *signal.bounds)
    if signal.angle:
        _draw_turns(axes, signal)
    axes.set_ylabel(signal.label)


def draw_bars(axes: Axes, groups: Mapping[str, Mapping[str, float]], unit: float | None = 1.0) -> None:
    """Draws groups of bars with their values written above: one group a controller, one bar a measure.

    Args:
        axes: Where.
        groups: ``{controller: {measure: value}}``; the same measures for all.
        unit: Where to draw the line of the reference.
    """
    names, measures = list(groups), list(next(iter(groups.values())))
    width = 0.8 / len(measures)
    top = max(value for group in groups.values() for value in group.values())
    for j, measure in enumerate(measures):
        for i, name in enumerate(names):
            value = groups[name][measure]
            style = STYLES.get(name, OTHER)
            position = i + (j - 0.5 * (len(measures) - 1)) * width
            face = style.color if j == 0 else "white"
            axes.bar(
                position, value, 0.92 * width, facecolor=face, edgecolor=style.color, hatch="" if j == 0 else "////"
            )
            axes.annotate(
                f"{value:.2f}",
                (position, value),
                (0, 1.5),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=6.5,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.4},
                zorder=5,
            )
    if unit is not None:
        axes.axhline(unit, color="black", linewidth=0.8, linestyle=(0, (1, 1.2)), zorder=4)
    axes.set_xticks(range(len(names)), [controller_label(name) for name in names])
    axes.tick_params(axis="x", length=0)
    axes.grid(visible=False, axis="x")
    axes.set_ylim(0.0, 1.14 * max(top, unit or 0.0))


def controller_label(name: str) -> str:
    """The name of a controller as it is set in a figure: ``MPC_1`` with its index lowered."""
    stem, _, index = name.partition("_")
    return f"{stem}$_{{{index}}}$" if index else stem


def legend_handles(names: Sequence[str]) -> tuple[list[Any], list[str]]:
    """Handles and labels of a legend for controllers."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], **_line(STYLES.get(name, OTHER))) for name in names]
    return handles, [controller_label(name) for name in names]


def _line(style: LineStyle) -> dict[str, Any]:
    return {"color": style.color, "linestyle": style.dashes, "linewidth": style.width}


def _draw_turns(axes: Axes, signal: Signal) -> None:
    """Ticks at half turns, and target and band at every full turn that is in sight."""
    low, high = axes.get_ylim()
    ticks = range(int(np.ceil(low / np.pi)), int(np.floor(high / np.pi)) + 1)
    axes.set_yticks([np.pi * k for k in ticks], [_in_pi(k) for k in ticks])
    if signal.target is None:
        return
    margin = signal.band or 0.0
    for k in range(round((low - signal.target) / (2 * np.pi)), round((high - signal.target) / (2 * np.pi)) + 1):
        target = signal.target + 2 * np.pi * k
        if low - margin < target < high + margin:
            _draw_target(axes, target, signal.band)
    axes.set_ylim(low, high)


def _unwrapped(angle: Array) -> Array:
    """The angle without jumps, starting in [0, 2 pi)."""
    curve = np.unwrap(angle)
    return np.asarray(curve - 2 * np.pi * np.floor(curve[0] / (2 * np.pi)))


def _in_pi(k: int) -> str:
    if k == 0:
        return "0"
    return f"${'-' if k < 0 else ''}{'' if abs(k) == 1 else abs(k)}\\pi$"


def _draw_target(axes: Axes, target: float, band: float | None) -> None:
    axes.axhline(target, color=_BOUND, linewidth=0.6, zorder=1)
    if band is not None:
        axes.axhspan(target - band, target + band, color="#EAEAEA", linewidth=0, zorder=0)


def _draw_bounds(axes: Axes, low: float, high: float) -> None:
    values = np.array(axes.dataLim.intervaly)
    if (values > 0.5 * low).all() and (values < 0.5 * high).all():  # far from both: they would flatten the curves
        text = f"bounds $\\pm${high:g}" if low == -high else f"bounds {low:g}, {high:g}"
        axes.annotate(text, (1.0, 0.96), xycoords="axes fraction", ha="right", va="top", fontsize=7, color="#595959")
        return
    margin = 0.12 * (high - low)
    for bound, side in ((low, -1.0), (high, 1.0)):
        axes.axhline(bound, color=_BOUND, linewidth=0.8, zorder=2)
        axes.axhspan(
            bound, bound + side * margin, facecolor="#EDEDED", hatch="////", edgecolor="#C4C4C4", linewidth=0, zorder=1
        )
    axes.set_ylim(low - margin, high + margin)
