"""Weights moved by closed loops, on a linear plant whose best controller is known."""

from __future__ import annotations

import sys

import lq_plant
import numpy as np
import pytest
from lq_episodes import episodes

from mpcoffline import MPCPolicy, nominal_mpc
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.mpc import MPC, NetworkCost, QuadraticCost
from mpcoffline.simulation.logged_cost import LoggedCost
from mpcoffline.simulation.models import LogModels
from mpcoffline.simulation.polishing import Polished, polished, scaled_together
from mpcoffline.simulation.trials import Surroundings

LOG = episodes()
BEST = lq_plant.make_mpc((lq_plant.A, lq_plant.B)).replace(discount=1.0, horizon=30)  # of a sum over 30 steps


def on_the_log(mpc: MPC, seed: int = 0) -> tuple[Polished, Surroundings]:
    models = LogModels.of(BEST, LOG, identify_one_step(BEST, LOG), n_perturbed=1, n_residual=0)
    rows = LOG.episodes.firsts[:14]
    around = Surroundings(models, LoggedCost(LOG), LOG, rows, 30, BEST.layout)
    return polished(mpc, around, seed), around


def cost(mpc: MPC, around: Surroundings) -> float:
    return float(around.act([MPCPolicy(mpc)])[0].cost[0].mean())


def test_wrong_weights_are_mended_as_far_as_the_models_tell() -> None:
    wrong = BEST.replace(stage_cost=QuadraticCost(lq_plant.W, 8.0 * np.asarray(lq_plant.R)))
    found, around = on_the_log(wrong)
    assert found.taken, found.reason
    best, before, after = (cost(mpc, around) for mpc in (BEST, wrong, found.mpc))
    assert best <= after + 1e-9 < before
    assert before - after > 0.5 * (before - best)
    assert found.reason.startswith("polished: ")
    np.testing.assert_array_equal(found.mpc.model.space.theta, wrong.model.space.theta)
    again, _ = on_the_log(wrong)
    np.testing.assert_array_equal(again.mpc.theta, found.mpc.theta)


def test_the_best_controller_stays() -> None:
    found, _ = on_the_log(BEST)
    assert not found.taken
    assert found.reason.startswith("not polished: ")


def test_gains_too_large_to_be_true_are_refused() -> None:
    absurd = BEST.replace(stage_cost=QuadraticCost(lq_plant.W, 300.0 * np.asarray(lq_plant.R)))
    found, _ = on_the_log(absurd)
    assert not found.taken
    assert "too much to be true" in found.reason


def test_weights_are_scaled_row_by_row_and_networks_stay() -> None:
    mpc = nominal_mpc("mpcoffline/PendulumSwingUp-v0", alpha=1.0, seed=0)
    names = np.array(mpc.space.names)
    assert [list(names[places]) for places in scaled_together(mpc)] == [
        ["stage_cost.W[0,0]"],
        ["stage_cost.W[1,0]", "stage_cost.W[1,1]"],
        ["stage_cost.W[2,0]", "stage_cost.W[2,1]", "stage_cost.W[2,2]"],
        ["stage_cost.R[0,0]"],
    ]
    learned = mpc.replace(terminal_cost=NetworkCost.random(3, seed=0))
    assert len(scaled_together(learned)) == 4


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(InvalidArgumentError, match=r"mpcoffline\[polish\]"):
        on_the_log(BEST)
