"""The pictures of a report's page: small panels, each readable on a phone, in the colours of the page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mpcoffline.core.text import listed
from mpcoffline.core.types import Array
from mpcoffline.plotting import STYLES, controller_label, inline_svg, line_of, new_figure, paper_style
from mpcoffline.plotting.style import BOUND, time_unit

from . import figure
from .background import Background
from .loops import Loop
from .marks import STATE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from .report import Report

_WIDTH, _HEIGHT, _LOW = 3.5, 2.35, 1.75  # inches
_MOST_QUANTITIES = 6  # of states, and of inputs, in the closed loops
_MOST_POINTS = 200  # of a curve
_TODAY = "#000000"
_SIGHT = 0.5  # of what a panel shows: a limit farther off would flatten the curves
WANTED: dict[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 0.9}
LIMIT: dict[str, Any] = {"linestyle": "-", "linewidth": 0.7}
#: The figures' colours by those of the page, which are others in the dark.
COLORS = {
    STYLES["MPC_1"].color: "var(--first)",
    STYLES["MPC_3"].color: "var(--proposal)",
    "#767676": "var(--grey)",
    "#E6E6E6": "var(--grid)",
}


@dataclass(frozen=True)
class Picture:
    """A figure in a page.

    Attributes:
        svg: The element; empty where there is nothing to draw.
        caption: What stands below it, or why there is none.
    """

    svg: str
    caption: str


def panels(report: Report) -> dict[str, Picture]:
    """The pictures of the figures in a report, by name."""
    judgement, trials, traces = report.judgement, report.trials, report.traces
    choice = report.choice or trials
    drawn: dict[str, tuple[Callable[[Axes], None], str]] = {
        "costs": (
            lambda axes: figure.draw_costs(axes, judgement, trials),
            "Cost of an episode: the mean that models and log let expect, from its lowest to its highest.",
        ),
        "candidates": (
            lambda axes: figure.draw_candidates(axes, judgement, choice),
            "Cost minus that of MPC_1, less is better: a dot for each model that predicts the log, and the median"
            " model's with two standard errors.",
        ),
        "agreement": (
            lambda axes: figure.draw_agreement(axes, judgement, trials),
            "Each start: what the log cost from there, and what a clone of its controller costs on the models (median,"
            " and from the tenth to the ninetieth percentile). On the line, they agree.",
        ),
        "distances": (
            lambda axes: figure.draw_distances(axes, traces),
            f"Distance to {'where the loops end' if traces.goal is None else 'the goal'} on the identified model, over"
            " all starts: median and quartiles.",
        ),
        "value": (
            lambda axes: figure.draw_value(axes, report.value, traces),
            "V against the discounted cost that was measured from the same states of the last episodes.",
        ),
        "fit": (
            lambda axes: figure.draw_fit(axes, report.fit),
            "Regression error of (FIT), before and after, in all data and by quarters of V.",
        ),
    }
    return {name: _picture(f"f-{name}", draw, caption) for name, (draw, caption) in drawn.items()}


def loop_panels(loop: Loop, k: int, background: Background) -> Iterator[Picture]:
    """The closed loops from one start: a picture for each of the quantities that tell the controllers apart.

    Args:
        loop: What happens.
        k: Its number, for the ids.
        background: Names and sampling time.
    """
    names = background.names
    rows = [(names.states, loop.states, loop.states_on, False), (names.inputs, loop.actions, loop.actions_on, True)]
    marks = loop.marks
    for kind, (called, logged, on, held) in enumerate(rows):
        for i in _telling(logged, list(on.values())):
            curves = {name: values[..., i] for name, values in on.items()}
            wanted = marks.wanted.get(i) if kind == STATE else None
            panel = _Panel(
                called[i], logged[:, i], curves, background.dt, held, wanted, marks.limits.get((kind, i), ())
            )
            yield _picture(f"l{k}-{kind}-{i}", panel, f"{called[i]}: {panel.in_words}.", _LOW)
    for i in sorted(marks.outside)[:_MOST_QUANTITIES]:
        course = marks.outside[i]
        ends = f"from {course[0]:.3g} to {course[-1]:.3g}, between {course.min():.3g} and {course.max():.3g}"
        panel = _Panel(names.states[i], course, {}, background.dt, held=True)
        yield _picture(f"l{k}-2-{i}", panel, f"{names.states[i]}, from outside: {ends}.", _LOW)


@dataclass(frozen=True)
class _Panel:
    """One quantity over time: the log's, and each controller's median model in the band of all models.

    Beside them what it is to follow, and those limits that are in sight of the curves; or a signal alone.
    """

    name: str
    logged: Array
    curves: dict[str, Array]
    dt: float
    held: bool
    wanted: Array | None = None
    limits: tuple[Array, ...] = ()

    def __call__(self, axes: Axes) -> None:
        n = len(self.logged)
        step = max(1, n // _MOST_POINTS)
        unit, name_of_unit = time_unit(self.dt * n)
        times = self.dt / unit * np.arange(n)[::step]
        shape: Literal["post"] | None = "post" if self.held else None
        drawn = "steps-post" if self.held else "default"
        for k, (name, values) in enumerate(self.curves.items()):
            style = STYLES["MPC_1" if k == 0 else "MPC_3"]
            low, middle, high = (of(values, axis=0)[::step] for of in (np.min, np.median, np.max))
            axes.fill_between(times, low, high, step=shape, color=style.color, alpha=0.2, linewidth=0)
            axes.plot(times, middle, drawstyle=drawn, label=controller_label(name), **line_of(style))
        if np.isfinite(self.logged).any():
            line = ":" if self.curves else "-"  # a signal is the same for the log and in the loops
            axes.plot(times, self.logged[::step], line, drawstyle=drawn, color=_TODAY, linewidth=1.2)
        if self.wanted is not None:
            wanted = self.wanted[:n:step]
            axes.plot(times, wanted, drawstyle="steps-post", color=_TODAY, zorder=2, **WANTED)
        low, high = axes.get_ylim()
        for limit in self.limits:
            if limit.min() < high + _SIGHT * (high - low) and limit.max() > low - _SIGHT * (high - low):
                axes.plot(times, limit[:n:step], drawstyle="steps-post", color=BOUND, zorder=1.5, **LIMIT)
        axes.set_title(self.name if self.name.startswith("$") else self.name.replace("$", r"\$"), loc="left")
        axes.set_xlabel(f"time [{name_of_unit}]")
        axes.margins(x=0.0)

    @property
    def in_words(self) -> str:
        """For those who do not see the curves: where each ends, and what was wanted there."""
        parts = [f"{name} ends at {np.median(values[:, -1]):.3g}" for name, values in self.curves.items()]
        known = self.logged[np.isfinite(self.logged)]
        parts += [f"the log at {known[-1]:.3g}"] if len(known) else []
        parts += [f"wanted is {self.wanted[-1]:.3g}"] if self.wanted is not None else []
        parts += [f"limits are {listed([f'{end[-1]:.3g}' for end in self.limits])}"] if self.limits else []
        return "; ".join(parts)


def _telling(logged: Array, on: list[Array]) -> list[int]:
    """Which quantities are shown, in their order: those in which the controllers differ most, in spreads."""
    everything = np.concatenate([values.reshape(-1, values.shape[-1]) for values in on])
    spread = everything.std(axis=0)
    apart = sum(np.abs(values.mean(axis=0) - on[0].mean(axis=0)).mean(axis=0) for values in on)
    order = np.argsort(-np.divide(apart, spread, out=np.zeros_like(spread), where=spread > 0.0), kind="stable")
    return sorted(order[:_MOST_QUANTITIES].tolist())


def _picture(key: str, draw: Callable[[Axes], None], caption: str, height: float = _HEIGHT) -> Picture:
    with paper_style():
        drawn = new_figure(_WIDTH, height)
        axes = drawn.subplots()
        draw(axes)
        if not axes.axison:  # it has words alone to say
            words = " ".join(axes.texts[0].get_text().split())
            return Picture("", f"{axes.get_title(loc='left').replace('$_{1}$', '_1')}: {words}.")
        return Picture(inline_svg(drawn, key, caption, COLORS), caption)
