"""The figure of the main job, for each task."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mpcoffline.envs import PLANTS
from mpcoffline.plotting import save_figure
from mpcoffline.studies import ControllerResult, TaskResult
from mpcoffline.studies.figure import main_job_figure


def made_up(task: str) -> TaskResult:
    plant = PLANTS[task]
    nx, nu = len(plant.states), len(plant.inputs)
    rng = np.random.default_rng(0)

    def controller(name: str, cost: float) -> ControllerResult:
        states, actions = rng.normal(size=(101, nx)), rng.uniform(-2, 2, (100, nu))
        return ControllerResult(
            name, name, [cost], [cost], [True], states=states.tolist(), actions=actions.tolist(), n_solves=100
        )

    names = ("MPC_1", "MPC_2", "MPC_3", "reference")
    controllers = [controller(name, cost) for name, cost in zip(names, (4.0, 3.0, 1.5, 2.0), strict=True)]
    behaviour = ControllerResult("behaviour", "", [1.0], [1.0], None)
    return TaskResult(task, 1.0, 0, plant.id, "x/y-v0", "td", 0.9, plant.dt, ["broad"], 0, {}, controllers, behaviour)


@pytest.mark.parametrize("task", PLANTS)
def test_panels_curves_and_bars(task: str, tmp_path: Path) -> None:
    figure = main_job_figure(made_up(task))
    left, right = figure.subfigs
    assert len(left.axes) == len(PLANTS[task].shown) + len(PLANTS[task].inputs)
    assert all("(" in axes.get_ylabel() for axes in left.axes), "every axis names its unit"
    assert left.axes[-1].get_xlabel() == "time (s)"
    (bars,) = right.axes
    assert [text.get_text() for text in bars.texts] == ["2.00", "1.50", "0.75"] * 2
    assert all(file.stat().st_size > 10_000 for file in save_figure(figure, tmp_path / "figure"))
