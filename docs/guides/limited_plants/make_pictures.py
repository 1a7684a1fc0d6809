"""Makes the pictures of the two plants with limits, each for light and for dark pages; takes about a minute.

.venv/bin/python docs/guides/limited_plants/make_pictures.py

Both plants do what their best model says, without noise, so that what a kind of limit does is all that differs.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mpcoffline import MPC, Penalty
from mpcoffline.plotting import PAGE_WIDTH, new_figure, paper_style
from mpcoffline.solvers import DDPSolver

HERE = Path(__file__).resolve().parent
KINDS: dict[str, Penalty | str | None] = {
    "no limit": None,
    "l2": Penalty(l2=2.0),
    "l1, small": Penalty(l1=1.5),
    "l1, big": Penalty(l1=60.0),
    "hard": "hard",
}
#: Text, axes, grid, what is forbidden; a colour and a line a kind.
COLORS = {
    "light": ("#1c2733", "#8492a2", "#e3e7ec", "#c9302c", ("#8492a2", "#b8860b", "#0072b2", "#009e73", "#1c2733")),
    "dark": ("#e8edf3", "#7c8a99", "#2c333b", "#ff7b72", ("#7c8a99", "#f0c75e", "#56b4e9", "#3fd6a8", "#e8edf3")),
}
LINES = {"no limit": (1.2, "-"), "l2": (1.5, "-"), "l1, small": (1.5, "-"), "l1, big": (3.2, "-"), "hard": (1.0, "--")}


def plant_file(name: str) -> ModuleType:
    """A plant file beside this one."""
    spec = importlib.util.spec_from_file_location(name, HERE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def under(mpc: MPC, kind: Penalty | str | None, names: tuple[str, ...]) -> MPC:
    """The MPC with the limits of these names of a kind, others as they are."""
    limits: Any = mpc.constraints
    soft = None if isinstance(kind, str) else kind
    changed = [replace(limit, soft=soft) if limit.name in names else limit for limit in limits]
    return mpc.replace(constraints=[limit for limit in changed if kind is not None or limit.name not in names] or None)


def loop(mpc: MPC, start: list[float], steps: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """States ``(steps + 1, nx)`` and inputs ``(steps, nu)`` of the MPC on its own model."""
    solver, plan, x, states, inputs = DDPSolver(mpc), None, np.array(start), [np.array(start)], []
    for _ in range(steps):
        solution = solver.solve(x[None], warm_start=plan)
        plan, u = solution.plan.shifted(), solution.u0[0]
        x = np.asarray(mpc.model(x, u), dtype=np.float64)
        states.append(x)
        inputs.append(u)
    return np.array(states), np.array(inputs)


@contextmanager
def themed(theme: str) -> Iterator[None]:
    """The style of all figures in the colours of a page, which shines through."""
    import matplotlib as mpl

    ink, line, grid, *_ = COLORS[theme]
    colored = ("text.color", "axes.labelcolor", "axes.titlecolor", "xtick.labelcolor", "ytick.labelcolor")
    settings: dict[str, Any] = dict.fromkeys(colored, ink) | {
        "axes.edgecolor": line, "xtick.color": line, "ytick.color": line, "grid.color": grid, "font.size": 8.5,
        "figure.facecolor": "none", "axes.facecolor": "none", "savefig.facecolor": "none", "legend.facecolor": "none",
    }  # fmt: skip
    rc_context: Any = mpl.rc_context
    with paper_style(), rc_context(settings):
        yield


def tanks(found: dict[str, Any], module: ModuleType, theme: str) -> Figure:
    """Levels and pump of the two tanks under each kind of limit."""
    *_, forbidden, colors = COLORS[theme]
    figure = new_figure(PAGE_WIDTH, 2.7)
    axes = figure.subplots(1, 3)
    for (kind, (states, inputs)), color in zip(found.items(), colors, strict=True):
        width, style = LINES[kind]
        t = module.DT * np.arange(len(states))
        for place, values in ((axes[0], states[:, 0]), (axes[1], states[:, 1]), (axes[2], inputs[:, 0])):
            place.plot(t[: len(values)], values, style, color=color, lw=width, label=kind)
    for place, top, name in (
        (axes[0], module.FULL[0], "upper level (cm)"),
        (axes[1], module.FULL[1], "lower level (cm)"),
    ):
        place.axhspan(top, 2.0 * top, color=forbidden, alpha=0.18, lw=0)
        highest = max(1.1 * top, 1.05 * max(line.get_ydata().max() for line in place.get_lines()))
        place.set(ylim=(3.0, highest), ylabel=name, xlabel="time (s)")
    axes[2].set(ylabel="pump (V)", xlabel="time (s)")
    axes[2].legend(frameon=False)
    return figure


def crane(found: dict[str, Any], module: ModuleType, theme: str) -> Figure:
    """The load's way over the containers under each kind of limit, and how far it swings."""
    ink, *_, forbidden, colors = COLORS[theme]
    figure = new_figure(PAGE_WIDTH, 2.9)
    left, right = figure.subplots(1, 2, width_ratios=[3, 2])
    place = np.linspace(-0.2, 3.4, 200)
    left.fill_between(
        place, -module.TOP - module.STEEP * (place - module.MIDDLE) ** 2, -2.1, color=forbidden, alpha=0.18, lw=0
    )
    for (kind, (states, _)), color in zip(found.items(), colors, strict=True):
        width, style = LINES[kind]
        load = states[:, 0] + states[:, 4] * np.sin(states[:, 2]), -states[:, 4] * np.cos(states[:, 2])
        left.plot(*load, style, color=color, lw=width, label=kind)
        right.plot(module.DT * np.arange(len(states)), states[:, 2], style, color=color, lw=width)
    left.set(ylim=(-2.0, -0.7), xlim=(-0.2, 3.4), xlabel="place of the load (m)", ylabel="below the drum (m)")
    left.text(module.MIDDLE, -1.7, "containers", ha="center", color=ink)
    left.legend(frameon=False, loc="upper left", ncols=2)
    for side in (1.0, -1.0):
        right.axhspan(side * module.SWING, side * 0.35, color=forbidden, alpha=0.18, lw=0)
    right.set(ylim=(-0.35, 0.35), xlabel="time (s)", ylabel="swing (rad)")
    return figure


def main() -> None:
    """Runs the loops and draws them."""
    tank_levels, a_crane = plant_file("tank_levels"), plant_file("crane")
    of_tanks, of_crane = {}, {}
    for kind, limit in KINDS.items():
        of_tanks[kind] = loop(under(tank_levels.truth(), limit, ("levels",)), [4.0, 5.0], 60)
        scaled = Penalty(2.0 * limit.l1, 8.0 * limit.l2) if isinstance(limit, Penalty) else limit
        of_crane[kind] = loop(under(a_crane.truth(), scaled, ("containers", "swing")), [0.0, 0.0, 0.0, 0.0, 1.5], 40)
    for theme in COLORS:
        with themed(theme):
            for name, draw, found, module in (
                ("tank_levels", tanks, of_tanks, tank_levels),
                ("crane", crane, of_crane, a_crane),
            ):
                figure = draw(found, module, theme)
                figure.savefig(HERE / f"{name}_{theme}.png", dpi=150, metadata={"Software": None})


if __name__ == "__main__":
    main()
