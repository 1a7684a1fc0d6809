"""The figure of the field: cost over that of the MPC with the true model, against the size of the log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mpcoffline.plotting.style import PAGE_WIDTH, paper_style

from .jobs import ALGORITHMS, Outcome
from .page import OURS, Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS, _DPI = 3, 170
_MARGIN = 0.05  # of the height, below the least
_BEYOND = 6.0  # costs above so many times the best are drawn at the edge

#: Text, axes, grid of a page.
TONES = {"light": ("#1c2733", "#8492a2", "#e3e7ec"), "dark": ("#e8edf3", "#7c8a99", "#2c333b")}


class Look(NamedTuple):
    """How a controller is drawn: a colour for light pages, one for dark ones, its marker, its dashes."""

    light: str
    dark: str
    marker: str
    dashes: Any = "-"


LOOKS = {
    "default": Look("#0072B2", "#56b4e9", "o"),
    "paper": Look("#0072B2", "#56b4e9", "D", (0, (1, 1.2))),
    "identified": Look("#009E73", "#3fd6a8", "s", (0, (4, 1.2))),
    "bc": Look("#767676", "#a3adb8", "v", (0, (1, 1))),
    "td3+bc": Look("#D55E00", "#ff9a57", "^", (0, (4, 1.2, 1, 1.2))),
    "iql": Look("#B8608C", "#f19ac4", "P", (0, (5, 1.6))),
    "cql": Look("#9A7400", "#f0c75e", "X", (0, (2, 1))),
}
#: What needs no log is a level.
LEVELS = {"rough": ((0, (5, 2)), "MPC$_1$, rough model"), "behaviour": ((0, (1, 1.6)), "the log's controller")}


def write(outcomes: Sequence[Outcome], folder: Path) -> list[Path]:
    """Draws the figure for light and for dark pages.

    Args:
        outcomes: Lines of the results.
        folder: Where ``field_light.png`` and ``field_dark.png`` go.

    Returns:
        The two files.
    """
    files = []
    for tone in TONES:
        with themed(tone):
            files.append(folder / f"field_{tone}.png")
            drawn(Results(outcomes), tone).savefig(files[-1], dpi=_DPI, metadata={"Software": None})
    return files


@contextmanager
def themed(tone: str) -> Iterator[None]:
    """The style of all figures in the colours of a page, which shines through."""
    import matplotlib as mpl

    ink, line, grid = TONES[tone]
    colored = ("text.color", "axes.labelcolor", "axes.titlecolor", "xtick.labelcolor", "ytick.labelcolor")
    settings: dict[str, Any] = dict.fromkeys(colored, ink) | {"axes.edgecolor": line, "xtick.color": line}
    settings |= {"ytick.color": line, "grid.color": grid, "font.size": 8.5}
    settings |= dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none")
    rc_context: Any = mpl.rc_context
    with paper_style(), rc_context(settings):
        yield


def drawn(results: Results, tone: str) -> Figure:
    """A panel a plant; make it inside :func:`themed`."""
    from matplotlib.figure import Figure

    arenas = [arena for arena in results.arenas if results.sizes(arena)]
    n_rows = -(-len(arenas) // _COLUMNS)
    height = 1.05 + 2.15 * n_rows
    figure = Figure(figsize=(PAGE_WIDTH, height))
    figure.subplots_adjust(0.09, 0.45 / height, 0.985, 1.0 - 0.85 / height, wspace=0.24, hspace=0.34)
    panels = np.atleast_1d(figure.subplots(n_rows, min(_COLUMNS, len(arenas)), squeeze=False)).ravel()
    for axes, arena in zip(panels, arenas, strict=False):
        _panel(axes, results, arena, tone)
    for axes in panels[len(arenas) :]:
        axes.set_axis_off()
    columns = min(_COLUMNS, len(arenas))
    for axes in panels[::columns]:
        axes.set_ylabel("cost / that of the\nMPC with the true model")
    for axes in panels[max(0, len(arenas) - columns) : len(arenas)]:
        axes.set_xlabel("transitions in the log")
    handles, labels = _legend(results, tone)
    figure.legend(handles, labels, loc="upper center", ncols=4, handlelength=2.4, columnspacing=1.2, fontsize=7.5)
    return figure


def _panel(axes: Axes, results: Results, arena: str, tone: str) -> None:
    sizes = results.sizes(arena)
    top = _top(results, arena, sizes)
    ink = TONES[tone][0]
    axes.axhline(1.0, color=ink, linewidth=0.8)
    for name, (dashes, _) in LEVELS.items():
        cell = results.cell(arena, name, 0)
        if cell is not None and cell.excess <= top:  # NaN is not
            axes.axhline(cell.excess, color=ink, linewidth=0.8, linestyle=dashes, alpha=0.7)
    for k, (name, look) in enumerate(LOOKS.items()):
        shift = 1.04 ** (k - 3)  # so that equal costs stay apart
        cells = [(size, cell) for size in sizes if (cell := results.cell(arena, name, size)) is not None]
        if not cells:
            continue
        color, own = getattr(look, tone), name == OURS
        x = [shift * size for size, _ in cells]
        y = np.array([cell.excess for _, cell in cells])
        style: dict[str, Any] = {"color": color, "linewidth": 1.9 if own else 1.2, "linestyle": look.dashes}
        axes.plot(x, np.minimum(y, top), **style, zorder=3 + own)
        inside = y < top
        axes.plot(np.array(x)[inside], y[inside], look.marker, color=color, markersize=5, zorder=4 + own)
        axes.plot(np.array(x)[~inside], np.full((~inside).sum(), top), "^", color=color, markersize=6, clip_on=False)
        for o in results.done:
            if (o.arena, o.algorithm) == (arena, name) and (each := results.excess(o)) < top:
                axes.plot(shift * o.size, each, ".", color=color, markersize=3, alpha=0.6)
    axes.set_xscale("log")
    axes.set_xlim(0.6 * min(sizes), 1.7 * max(sizes))
    axes.set_xticks(sizes, [f"{size:,}" for size in sizes])
    axes.minorticks_off()
    lowest = axes.dataLim.ymin
    axes.set_ylim(lowest - _MARGIN * (top - lowest), top)  # autoscaling does not know of the top
    axes.set_title(arena.replace("_", " "), loc="left", fontweight="bold")


def _top(results: Results, arena: str, sizes: Sequence[int]) -> float:
    """The upper edge: all there is, but no more than would hide what is near the best."""
    found = [results.cell(arena, name, size) for name in (*LOOKS, *LEVELS) for size in sizes]
    known = np.array([cell.excess for cell in found if cell is not None and np.isfinite(cell.excess)])
    most = float(known.max(initial=1.0))
    return min(_BEYOND, most + 0.06 * (most - min(1.0, float(known.min(initial=1.0)))) + 0.01)


def _legend(results: Results, tone: str) -> tuple[list[Any], list[str]]:
    from matplotlib.lines import Line2D

    ink = TONES[tone][0]
    there = {o.algorithm for o in results.done}
    handles, labels = [], []
    for name, look in LOOKS.items():
        if name in there:
            width = 1.9 if name == OURS else 1.2
            style: dict[str, Any] = {"color": getattr(look, tone), "linestyle": look.dashes, "marker": look.marker}
            handles.append(Line2D([], [], linewidth=width, markersize=5, **style))
            labels.append(ALGORITHMS[name].label)
    handles.append(Line2D([], [], color=ink, linewidth=0.8))
    labels.append("MPC, true model")
    for name, (dashes, label) in LEVELS.items():
        if any(o.algorithm == name and not o.has_own_starts for o in results.done):
            handles.append(Line2D([], [], color=ink, linewidth=0.8, linestyle=dashes, alpha=0.7))
            labels.append(label)
    return handles, labels
