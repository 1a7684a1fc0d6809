"""Makes the figures of "How it works" that show something learned, each for light and for dark pages.

.venv/bin/python docs/figures/make_learned.py [--learner learner.zip]    # about two minutes; or draws a saved learner

The pendulum from the shipped log by ``preset="paper"``, cost and model learned, model error alpha = 1. The numbers that
the page quotes are printed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mpcoffline import MPC, OfflineMPCLearner, TransitionTable, make_solver, nominal_mpc
from mpcoffline.learning.bellman.equation import BellmanProblem
from mpcoffline.plotting import PAGE_WIDTH, STYLES, new_figure, paper_style
from mpcoffline.plotting.panels import on_plane, plane_of, task_of

Array = NDArray[np.float64]

HERE = Path(__file__).resolve().parent
PENDULUM, LOG = "mpcoffline/PendulumSwingUp-v0", "mpcoffline/pendulum/ddpg-v0"
SHOWN = 1_500  # transitions
SPEED = 7.0  # rad/s; beyond are less than 1 % of the log
#: Text, axes and grid; MPC_1 and MPC_3.
COLORS = {
    "light": ("#1c2733", "#8492a2", "#e3e7ec", STYLES["MPC_1"].color, STYLES["MPC_3"].color),
    "dark": ("#e8edf3", "#7c8a99", "#2c333b", "#ff9a57", "#56b4e9"),
}


@contextmanager
def themed(theme: str) -> Iterator[None]:
    """The style of all figures in the colours of a page, which shines through."""
    import matplotlib as mpl

    ink, line, grid, *_ = COLORS[theme]
    colored = ("text.color", "axes.labelcolor", "axes.titlecolor", "xtick.labelcolor", "ytick.labelcolor")
    settings: dict[str, Any] = dict.fromkeys(colored, ink) | {
        "axes.edgecolor": line, "xtick.color": line, "ytick.color": line, "grid.color": grid, "font.size": 8.5,
        "figure.facecolor": "none", "axes.facecolor": "none", "savefig.facecolor": "none",
    }  # fmt: skip
    rc_context: Any = mpl.rc_context
    with paper_style(), rc_context(settings):
        yield


def log_and_value(table: TransitionTable, learner: OfflineMPCLearner) -> Figure:
    """What is in the log, and what (VALUE) makes of it: costs of single steps, and V."""
    task, plant = task_of(PENDULUM)
    y, cost = table.observations.astype(np.float64), table.costs.astype(np.float64)
    angle, speed = np.mod(np.arctan2(y[:, 1], y[:, 0]), 2 * np.pi), y[:, 2]
    assert learner.value_function is not None
    horizontal, vertical, value = on_plane(task, plane_of(plant), learner.value_function.predict, 241)
    figure = new_figure(PAGE_WIDTH, 2.75)
    left, right = figure.subplots(1, 2, sharey=True)
    dots = left.scatter(angle, speed, 3.0, np.maximum(cost, 0.02), cmap="cividis", norm=LogNorm(0.02, 20.0), lw=0)
    figure.colorbar(
        dots, ax=left, pad=0.02, aspect=25, extend="both", label="cost $L$ of one step"
    ).outline.set_linewidth(0.5)
    left.set_title(f"The log: {len(table):,} of 50,000 transitions")
    shades = right.contourf(horizontal, vertical, value, np.arange(0.0, 91.0, 5.0), cmap="cividis", extend="both")
    shades.set_rasterized(True)
    figure.colorbar(shades, ax=right, pad=0.02, aspect=25, label="$V$: all costs to come").outline.set_linewidth(0.5)
    right.set_title("(VALUE): what each state is worth")
    for axes in (left, right):
        axes.set(xlim=(0.0, 2 * np.pi), ylim=(-SPEED, SPEED), xlabel="angle $\\varphi$")
        axes.set_xticks([0.0, np.pi, 2 * np.pi], ["0 upright", "π hanging", "2π upright"])
        axes.grid(visible=False)
    left.set_ylabel("speed $\\dot\\varphi$ (rad/s)")
    return figure


def fit_and_values(table: TransitionTable, learner: OfflineMPCLearner, before: str, after: str) -> Figure:
    """What (FIT) fits, and what the MPC then makes of it: before and after learning, each a point a transition."""
    value = learner.value_function
    assert value is not None
    figure = new_figure(PAGE_WIDTH, 3.0)
    left, right = figure.subplots(1, 2)
    V = value.predict(table.observations)
    for name, mpc, color in (("MPC_1", learner.nominal_mpc, before), ("MPC_3", learner.mpc, after)):
        asked, stage = regression(mpc, learner, table)
        left.plot(stage, asked, "o", color=color, markersize=1.8, alpha=0.45, markeredgewidth=0)
        theirs = make_solver(mpc).value(table.observations.astype(np.float64))
        right.plot(V, theirs, "o", color=color, markersize=1.8, alpha=0.45, markeredgewidth=0)
        known = np.isfinite(theirs)
        gap = np.sqrt(np.mean((theirs - V)[known] ** 2)) / V.std()
        share = np.mean((asked - stage) ** 2) / np.var(asked)
        figures = f"{share:.1%} of the variance is left by (FIT), V_theta - V is {gap:.1%} of the spread of V"
        print(f"{name}: {figures}, {(~known).sum()} MPCs were not solved")
    diagonal(left, 13.0)
    left.set(title="(FIT): one dot a transition", xlabel="stage cost $\\hat L_\\theta(s,a)$")
    left.set_ylabel("$L + \\gamma V(s_+) - \\gamma V(f_\\theta(s,a))$")
    diagonal(right, 90.0)
    right.set(title="Not fitted, but it follows: the MPC's value", xlabel="learned $V(s)$", ylabel="$V_\\theta(s)$")
    for axes in (left, right):
        for text, color, place in (("before: MPC$_1$", before, 0.94), ("after: MPC$_3$", after, 0.86)):
            axes.text(0.04, place, text, color=color, transform=axes.transAxes, va="top", fontweight="bold")
    return figure


def diagonal(axes: Axes, end: float) -> None:
    """Square limits, and the line on which all dots would lie."""
    axes.plot([0.0, end], [0.0, end], color=axes.xaxis.label.get_color(), lw=0.7, alpha=0.6, zorder=1)
    axes.set(xlim=(-0.02 * end, end), ylim=(-0.02 * end, end), aspect="equal")


def regression(mpc: MPC, learner: OfflineMPCLearner, table: TransitionTable) -> tuple[Array, Array]:
    """Of (FIT): what the stage cost is asked to be, and what it is, each ``(n,)``."""
    assert learner.value_function is not None
    problem = BellmanProblem(mpc.replace(discount=learner.mpc.discount), learner.value_function, 1.0)
    columns, theta = table.columns(torch.from_numpy(np.array(table.rows))), torch.from_numpy(mpc.theta)
    with torch.no_grad():
        asked = problem.target(columns) - problem.predicted_value(columns, theta)
        return asked.numpy(), problem.stage_cost(columns, theta).numpy()


def main() -> None:
    """Learns, or loads, and draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--learner", type=Path, help="a learner that was saved")
    saved = parser.parse_args().learner
    table = TransitionTable.from_minari(LOG)
    if saved is None:
        learner = OfflineMPCLearner(nominal_mpc(PENDULUM, alpha=1.0, seed=0), preset="paper", seed=0)
        learner.fit(table)
    else:
        learner = OfflineMPCLearner.load(saved)
    for name, mpc in (("theta_0", learner.nominal_mpc), ("theta", learner.mpc)):
        print(name, {key: np.round(array, 3).tolist() for key, array in mpc.values.items()})
    seen, learned_from = table.sample(SHOWN, 0), table.trim(learner.method.trim).sample(SHOWN, 0)
    for theme, (*_, before, after) in COLORS.items():
        with themed(theme):
            for name, figure in (
                ("log_and_value", log_and_value(seen, learner)),
                ("fit_and_values", fit_and_values(learned_from, learner, before, after)),
            ):
                figure.savefig(HERE / f"{name}_{theme}.png", dpi=170, metadata={"Software": None})


if __name__ == "__main__":
    main()
