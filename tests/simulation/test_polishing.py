"""Weights moved by closed loops, on a linear plant whose best controller is known."""

from __future__ import annotations

import sys
from typing import Any

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


def on_the_log(mpc: MPC, seed: int = 0, **more: Any) -> tuple[Polished, Surroundings]:
    models = LogModels.of(BEST, LOG, identify_one_step(BEST, LOG), n_perturbed=1, n_residual=0)
    rows = LOG.episodes.firsts[:14]
    around = Surroundings(models, LoggedCost(LOG), LOG, rows, 30, BEST.layout)
    return polished(mpc, around, seed, **more), around


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


def gain(mpc: MPC) -> lq_plant.Array:
    """K of u = K x, ``(1, 2)``."""
    return np.asarray(MPCPolicy(mpc).solver.solve(1e-2 * np.eye(2)).u0).T / 1e-2


def test_the_gain_comes_near_that_of_riccati() -> None:
    """The weights are not unique, the gain is: u = -(R + B'PB)^-1 B'PA x, with P by iteration from the end's."""
    A, B, W, R, P = lq_plant.A, lq_plant.B, lq_plant.W, lq_plant.R, np.asarray(lq_plant.BEST.P)
    for _ in range(30):
        K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = W + A.T @ P @ (A + B @ K)
    np.testing.assert_allclose(gain(BEST), K, rtol=1e-6)
    wrong = BEST.replace(stage_cost=QuadraticCost(lq_plant.W, 8.0 * np.asarray(lq_plant.R)))
    found, _ = on_the_log(wrong)
    assert np.linalg.norm(gain(found.mpc) - K) < 0.3 * np.linalg.norm(gain(wrong) - K)


def test_an_interrupted_search_goes_on_and_ends_as_without() -> None:
    wrong = BEST.replace(stage_cost=QuadraticCost(lq_plant.W, 8.0 * np.asarray(lq_plant.R)))
    whole, _ = on_the_log(wrong)
    kept: dict[str, lq_plant.Array] = {}

    def stop(done: int, *_: Any) -> None:
        if done == 32:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        on_the_log(wrong, tell=stop, kept=kept)
    ((name, gains),) = kept.items()
    assert gains.shape == (4, 8)
    kept[name] = np.concatenate([gains[:3], -gains[3:]])  # is believed: it is not tried again
    changed, _ = on_the_log(wrong, kept=dict(kept))
    assert not np.array_equal(changed.mpc.theta, whole.mpc.theta)
    kept[name] = gains
    again, _ = on_the_log(wrong, kept=kept)
    np.testing.assert_array_equal(again.mpc.theta, whole.mpc.theta)
    assert (again.gain, again.error, again.evaluations) == (whole.gain, whole.error, whole.evaluations)
    other, _ = on_the_log(wrong, seed=1, kept={name: gains - 1e9})  # of another search
    assert other.taken


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
