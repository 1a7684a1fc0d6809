"""Figures: one style for all of them, readable in print and for the colour-blind, as vector PDF and PNG.

A learner's: :func:`training_figure`, :func:`cost_figure`, :func:`loop_figure`, :func:`phase_portrait`; and
:func:`animate`, which puts controllers side by side as a film. ``mpcoffline plot LEARNER`` makes them all.
"""

from __future__ import annotations

from .animation import animate, check_film
from .costs import cost_figure, draw_weights, stage_weights, weights_figure
from .loops import loop_figure
from .portrait import phase_portrait
from .signals import Signal, draw_bars, draw_signal
from .style import (
    COLUMN_WIDTH,
    OTHER,
    PAGE_WIDTH,
    STYLES,
    LineStyle,
    controller_label,
    legend_handles,
    line_of,
    new_figure,
    paper_style,
    save_figure,
)
from .svg import inline_svg
from .training import training_figure

__all__ = [
    "COLUMN_WIDTH",
    "OTHER",
    "PAGE_WIDTH",
    "STYLES",
    "LineStyle",
    "Signal",
    "animate",
    "check_film",
    "controller_label",
    "cost_figure",
    "draw_bars",
    "draw_signal",
    "draw_weights",
    "inline_svg",
    "legend_handles",
    "line_of",
    "loop_figure",
    "new_figure",
    "paper_style",
    "phase_portrait",
    "save_figure",
    "stage_weights",
    "training_figure",
    "weights_figure",
]
