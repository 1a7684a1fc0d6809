"""The terminal cost from V: found once for MPCs that have the same, and anew where anything of it differs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import lq_plant
import numpy as np
import pytest

from mpcoffline.learning import Known, ValueFunction
from mpcoffline.learning.bellman import stages
from mpcoffline.learning.bellman.stages import TerminalConfig, with_terminal_cost
from mpcoffline.learning.stages import KnownCost
from mpcoffline.mpc import QuadraticCost, TerminalCost

NETWORK = TerminalConfig("network", blend=0.5)


@pytest.fixture
def distilled(monkeypatch: pytest.MonkeyPatch) -> list[TerminalCost]:
    """All terminal costs that were found from V."""
    found: list[TerminalCost] = []
    fit_terminal = stages.fit_terminal

    def noted(*arguments: Any, **options: Any) -> TerminalCost:
        found.append(fit_terminal(*arguments, **options))
        return found[-1]

    monkeypatch.setattr(stages, "fit_terminal", noted)
    return found


@pytest.fixture
def known() -> Known:
    table, value = lq_plant.random_log(300), ValueFunction(2, (8,))
    value.normalise(table, lq_plant.DISCOUNT)
    return Known(lq_plant.make_mpc((lq_plant.MODEL_A, lq_plant.MODEL_B)), table, value_function=value.eval())


def test_another_model_has_the_same(distilled: list[TerminalCost], known: Known) -> None:
    first = with_terminal_cost(known, NETWORK)
    other = lq_plant.make_mpc((lq_plant.A, lq_plant.B))
    second = with_terminal_cost(replace(first, mpc=other), NETWORK)
    assert len(distilled) == 1
    np.testing.assert_array_equal(second.mpc.terminal_cost.space.theta, first.mpc.terminal_cost.space.theta)
    np.testing.assert_array_equal(second.mpc.values["model.A"], lq_plant.A)
    anew = with_terminal_cost(replace(known, mpc=other), NETWORK)
    assert len(distilled) == 2
    np.testing.assert_array_equal(anew.mpc.theta, second.mpc.theta)


def test_another_goal_and_a_cost_of_its_own_have_another(distilled: list[TerminalCost], known: Known) -> None:
    first = with_terminal_cost(known, NETWORK)
    elsewhere = first.mpc.replace(stage_cost=QuadraticCost(lq_plant.W, lq_plant.R, x_ref=[0.5, 0.0]))
    with_terminal_cost(replace(first, mpc=elsewhere), NETWORK)
    assert len(distilled) == 2
    with_terminal_cost(replace(first, cost=KnownCost(scale=2.0)), NETWORK)
    assert len(distilled) == 3
