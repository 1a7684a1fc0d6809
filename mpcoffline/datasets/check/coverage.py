"""What states and actions a data set covers, as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.envs import Input, Plant, State

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Axis:
    """One quantity of a coverage panel.

    Attributes:
        label: With its unit.
        source: ``"state"`` or ``"action"``.
        index: Coordinate.
        angle: Whether it is an angle in rad that wraps.
    """

    label: str
    source: str
    index: int
    angle: bool = False

    @classmethod
    def of(cls, coordinate: State | Input) -> Axis:
        """The axis of a plant's coordinate."""
        if isinstance(coordinate, Input):
            return cls(coordinate.label, "action", coordinate.index)
        return cls(coordinate.label, "state", coordinate.index, coordinate.angle)


def panels_of(plant: Plant) -> list[tuple[Axis, Axis]]:
    """The coverage panels of a plant's data."""
    return [(Axis.of(plant.coordinate(x)), Axis.of(plant.coordinate(y))) for x, y in plant.coverage]


def coverage_figure(
    panels: Sequence[tuple[Axis, Axis]], states: NDArray[np.float64], actions: NDArray[np.float64]
) -> Figure:
    """Where the data lie: two-dimensional histograms of states and actions, logarithmic colours.

    Args:
        panels: Horizontal and vertical axis of each histogram, e.g. those of :func:`panels_of`.
        states: Visited states s, ``(n, nx)``.
        actions: The actions taken there, ``(n, nu)``.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.1 * len(panels) + 0.5, 2.9), layout="constrained")
    norm = LogNorm(1, max(2.0, len(states) / 20))
    image: Any = None
    axes_list: list[Axes] = []
    for i, (horizontal, vertical) in enumerate(panels):
        axes = figure.add_subplot(1, len(panels), i + 1)
        axes_list.append(axes)
        ranges, data = [], []
        for axis in (horizontal, vertical):
            values = (states if axis.source == "state" else actions)[:, axis.index]
            data.append(values)
            ranges.append(_shown_range(axis, values))
        *_, image = axes.hist2d(data[0], data[1], bins=60, range=ranges, norm=norm, cmap="viridis")
        image.set_rasterized(True)
        axes.set_xlabel(horizontal.label)
        axes.set_ylabel(vertical.label)
        inside = np.logical_and.reduce([(v >= low) & (v <= high) for v, (low, high) in zip(data, ranges, strict=True)])
        if inside.mean() < 0.9995:
            axes.set_title(f"{100 * (1 - inside.mean()):.1f} % outside the frame", fontsize=8, color="0.35")
    figure.colorbar(image, ax=axes_list, label="transitions", pad=0.02)
    return figure


def _shown_range(axis: Axis, values: NDArray[np.float64]) -> tuple[float, float]:
    if axis.angle:
        return -np.pi, np.pi
    if axis.source == "action":
        limit = float(np.abs(values).max())
        return (0.0 if values.min() >= 0.0 else -limit), limit
    limit = float(np.percentile(np.abs(values), 98.0))
    return -1.1 * limit, 1.1 * limit
