"""The style of all figures, readable in print and for the colour-blind, and how they become files."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpcoffline.core.outputs import write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMN_WIDTH = 3.5
PAGE_WIDTH = 7.16
_PNG_DPI = 200
_TIMES = ((1.0, "s", 600.0), (60.0, "min", 6 * 3600.0), (3600.0, "h", float("inf")))  # and to which length each
_INDEXED = re.compile(r"([A-Za-z]+)_(\d+)")


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
#: What is no controller.
OTHERS: dict[str, LineStyle] = {
    "set-point, disturbance": LineStyle("#000000", "-", 0.9),
    "limit": LineStyle("#767676", (0, (2, 1.5)), 0.9),
}
OTHER = LineStyle("#CC79A7", (0, (1, 1)))
BOUND = "#767676"
COURSE = "#000000"  # of set-points and what else comes from outside


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
        stem: Path without suffix, or with one of these two.

    Returns:
        The two files.

    Raises:
        StorageError: If what is there is no file, or the disk or the file system refuses.
    """
    files = figure_files(stem)
    for file, metadata in zip(files, (("CreationDate", "Creator", "Producer"), ("Software",)), strict=True):
        content = io.BytesIO()
        figure.savefig(content, format=file.suffix[1:], dpi=_PNG_DPI, metadata=dict.fromkeys(metadata))
        write_file(file, content.getvalue())
    return files


def figure_files(stem: Path) -> list[Path]:
    """The files that :func:`save_figure` writes."""
    bare = stem.with_suffix("") if stem.suffix.lower() in (".pdf", ".png") else stem
    return [bare.with_name(f"{bare.name}.{suffix}") for suffix in ("pdf", "png")]


def stem_and_index(name: str) -> tuple[str, str]:
    """The parts of a controller's name, ``("MPC", "1")`` of ``MPC_1``; another name has no index."""
    parts = _INDEXED.fullmatch(name)
    return (parts[1], parts[2]) if parts else (name, "")


def controller_label(name: str) -> str:
    """The name of a controller as it is set in a figure: ``MPC_1`` with its index lowered, others as they are."""
    stem, index = stem_and_index(name)
    return stem.replace("$", r"\$") + (f"$_{{{index}}}$" if index else "")


def legend_handles(names: Sequence[str]) -> tuple[list[Any], list[str]]:
    """Handles and labels of a legend for controllers, and for what else there are styles of."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], **line_of((STYLES | OTHERS).get(name, OTHER))) for name in names]
    return handles, [controller_label(name) for name in names]


def time_unit(seconds: float) -> tuple[float, str]:
    """In which unit a stretch of time is drawn: how many seconds it has, and its name."""
    return next((unit, name) for unit, name, most in _TIMES if seconds <= most)


def line_of(style: LineStyle) -> dict[str, Any]:
    """The style as keyword arguments of Matplotlib's lines."""
    return {"color": style.color, "linestyle": style.dashes, "linewidth": style.width}
