"""A report with numbers that somebody chose; what it rests on is :mod:`invented_trials`."""

from __future__ import annotations

import numpy as np
from invented_trials import trials

from mpcoffline.diagnostics import Names, Report
from mpcoffline.diagnostics.background import Background, ColumnLine, ParameterLine
from mpcoffline.diagnostics.figure import Traces
from mpcoffline.diagnostics.loops import Loop
from mpcoffline.diagnostics.measures import GoalCheck, LagCheck, RegionError, ValueCheck
from mpcoffline.diagnostics.report import PredictionCheck
from mpcoffline.diagnostics.stability import TheoremCheck, WeightCheck
from mpcoffline.diagnostics.verdict import decide
from mpcoffline.estimation.smoothing import NoiseEstimate
from mpcoffline.simulation.trials import Trials

GAINS = {
    "full fit": [52.0, 50.0, 55.0, 51.0, 53.0, 49.0, 54.0, -400.0],
    "identified + V": [30.0, 28.0, 33.0, 31.0, 20.0, 29.0, 30.0, 31.0],
    "identified + nominal cost": [10.0, -3.0, 12.0, 11.0, 9.0, 9.0, 10.0, 11.0],
}


def report_of(tried: Trials, name: str = "full fit", choice: Trials | None = None) -> Report:
    """Of trials; everything else is made up."""
    rng = np.random.default_rng(0)
    states = np.cumsum(rng.normal(size=(8, 51, 2)), axis=1) * np.exp(-0.1 * np.arange(51))[:, None]
    value = np.sort(rng.normal(size=(2, 100)), axis=1)
    return Report(
        judgement=decide(tried, name, choice=choice),
        trials=tried,
        choice=choice,
        notes=("A note.",),
        cost_r2=0.998,
        value=ValueCheck(100, 0.9, -0.1, 0.05, 0.9),
        fit=tuple(RegionError(part, 0.5, 0.01) for part in ("all data", "V lowest quarter", "V highest quarter")),
        prediction=PredictionCheck(0.5, 0.01, 0.02, ()),
        theorem=TheoremCheck(0.8, 0.02, (0.9, 0.5)),
        weights=(WeightCheck("W", (0.1, 1.0), (0.2, 2.0)),),
        at_bounds=tuple(f"model.a[{i}]" for i in range(40)),
        outside_support=0.01,
        lag=LagCheck(0.01, 0.5),
        noise=NoiseEstimate(np.zeros(2), np.zeros(2), np.ones(2), "repeated"),
        goal=GoalCheck(0.1, False),
        failed_solves=(0.0, 0.001),
        findings=("Logged cost: known.",),
        n_rows=10_000,
        n_episodes=100,
        traces=Traces(states, 0.5 * states, value, np.zeros(2)),
    )


GOOD = trials(GAINS, today=140.0, clone=136.0, spread=30.0, noise=8.0)


def background(proposal: str = "full fit", odd: str = "") -> Background:
    """What a page shows besides.

    Args:
        proposal: The controller that is judged.
        odd: A name that somebody gave to a state and to a parameter.
    """
    rng, steps = np.random.default_rng(1), np.arange(51)

    def course(rate: float, n: int) -> np.ndarray:
        each = np.exp(-rate * steps[:n] * (1.0 + 0.2 * rng.random((8, 1))))
        return np.stack([each, -0.4 * each], axis=2)

    names = ("MPC_1", proposal) if proposal != "MPC_1" else ("MPC_1",)
    loop = Loop(
        row=300,
        why="A usual start",
        states=course(0.05, 51)[0],
        actions=course(0.05, 50)[0, :, :1],
        states_on={name: course(0.1 * k, 51) for k, name in enumerate(names, 1)},
        actions_on={name: course(0.1 * k, 50)[..., :1] for k, name in enumerate(names, 1)},
    )
    nan = float("nan")
    return Background(
        names=Names(("level [cm]", odd or "flow [l/s]"), ("valve [%]",), "EUR"),
        dt=0.5,
        loops=(loop,),
        parameters=(
            ParameterLine("model.area", "model", "cm2", 0.3, 0.4123, 0.002, 0.4, False),
            ParameterLine(f"model.{odd or 'leak'}", "model", "", 1.0, 1.0, 1.0, 1.1, True),
            ParameterLine("stage_cost.W[0,0]", "cost", "", 1.0, nan, nan, 1.25e-7, False),
            ParameterLine("stage_cost.new", "cost", "", nan, nan, nan, 2.0, False),
        ),
        columns=tuple(ColumnLine(0.0, 0.5, 1.0, 0.2) for _ in range(4)),
        episodes=(50, 100, 200, 3),
        made_by=(("seed of the fit", "7"), ("SHA-256 of the learned theta", "0123456789abcdef" * 4)),
    )
