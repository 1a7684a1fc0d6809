"""Training curves: what a fit's history says of the two regressions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.core.types import Array

from .style import PAGE_WIDTH, STYLES, new_figure, paper_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mpcoffline.learner.learner import OfflineMPCLearner

_TITLES = {
    "value_loss": "(VALUE): loss of $V_\\phi$",
    "fit_loss": "(FIT): loss of $\\theta$",
}
_DECADE = 10.0
_BEFORE_AND_AFTER = 2


def training_figure(learner: OfflineMPCLearner) -> Figure:
    """Draws each metric of a learner's history over the epochs; (FIT) with its error before learning.

    Args:
        learner: A fitted one.

    Returns:
        The figure; :func:`save_figure` writes it.

    Raises:
        MPCOfflineError: Before ``fit``.
    """
    if not learner.history:
        raise MPCOfflineError("learner", expected="a fitted learner", actual="no fit yet", hint="Call fit(dataset).")
    metrics = list(dict.fromkeys(name for _, entry in learner.history for name in entry))
    given = "value_loss" not in metrics and learner.value_function is not None
    with paper_style():
        figure = new_figure(PAGE_WIDTH * min(1.0, 0.4 * (len(metrics) + given) + 0.15), 2.3)
        panels = list(np.atleast_1d(figure.subplots(1, len(metrics) + given)))
        if given:
            _say(
                panels.pop(0),
                "value_loss",
                "V was given to this fit:\nits curve is that of the fit\nthat has learned it",
            )
        for axes, name in zip(panels, metrics, strict=True):
            epochs = [epoch for epoch, entry in learner.history if name in entry]
            values = [entry[name] for _, entry in learner.history if name in entry]
            if name == "fit_loss" and learner.result is not None:
                epochs, values = [epochs[0] - 1, *epochs], [learner.result.loss_before, *values]
            if name == "fit_loss" and len(values) == _BEFORE_AND_AFTER:
                _draw_pair(axes, np.array(values))
            else:
                _draw_curve(axes, np.array(epochs), np.array(values))
            ends = f", {values[0]:.3g} to {values[-1]:.3g}" if len(values) > 1 else ""
            axes.set_title(_TITLES.get(name, name.replace("_", " ")) + ends)
            axes.set_ylabel(name.replace("_", " "))
    return figure


def _say(axes: Axes, name: str, text: str) -> None:
    axes.set_title(_TITLES[name])
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)
    axes.set_axis_off()


def _draw_pair(axes: Axes, values: Array) -> None:
    """A regression that is solved in one go: its error before and after."""
    axes.bar([0, 1], values, 0.5, color=[STYLES["MPC_1"].color, STYLES["MPC_3"].color])
    axes.set_xticks([0, 1], ["MPC_1", "learned"])
    axes.set_xlim(-0.6, 1.6)
    axes.grid(visible=False, axis="x")


def _draw_curve(axes: Axes, epochs: Array, values: Array) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    style = STYLES["MPC_3"]
    axes.plot(epochs, values, "-o", color=style.color, linewidth=style.width, markersize=3)
    if values.min() > 0.0 and values.max() > _DECADE * values.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda number, _: f"{number:g}".replace("e-0", "e-")))
        axes.yaxis.set_minor_locator(NullLocator())
    elif values.min() >= 0.0:
        axes.set_ylim(0.0, 1.15 * float(values.max()))
    axes.set_xlim(epochs[0] - 0.5, epochs[-1] + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True))
    axes.set_xlabel("epoch")
