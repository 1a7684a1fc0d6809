"""The choice among MPCs: where they act changes no number."""

from __future__ import annotations

import lq_plant
import numpy as np
import pytest
from lq_episodes import episodes

from mpcoffline.core.parallel import SETTING
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.mpc import MPC, QuadraticCost
from mpcoffline.simulation.choice import FIRST, choose
from mpcoffline.simulation.logged_cost import LoggedCost
from mpcoffline.simulation.models import LogModels
from mpcoffline.simulation.trials import Surroundings

LOG = episodes()
BEST = lq_plant.make_mpc((lq_plant.A, lq_plant.B)).replace(discount=1.0, horizon=20)


@pytest.fixture(scope="module")
def around() -> Surroundings:
    models = LogModels.of(BEST, LOG, identify_one_step(BEST, LOG), n_perturbed=2, n_residual=1)
    return Surroundings(models, LoggedCost(LOG), LOG, LOG.episodes.firsts[:16], 20, BEST.layout)


def mpcs() -> dict[str, MPC]:
    factors = {FIRST: 30.0, "a": 8.0, "b": 4.0, "c": 2.0, "best": 1.0, "low": 0.2}
    return {
        name: BEST.replace(stage_cost=QuadraticCost(lq_plant.W, f * np.asarray(lq_plant.R)))
        for name, f in factors.items()
    }


def test_an_executor_gives_the_same_trials(around: Surroundings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(SETTING, raising=False)
    here, name = choose(mpcs(), around)
    told: list[tuple[int, int, str]] = []
    monkeypatch.setenv(SETTING, "processes")
    there, other = choose(mpcs(), around, tell=lambda *what: told.append(what))
    assert name == other != FIRST
    assert here.names == there.names
    for key, array in here.to_arrays().items():
        np.testing.assert_array_equal(array, there.to_arrays()[key])
    assert told[0] == (0, 16, "MPC_1, a, b, c; best, low")
    assert told[-1] == (16, 16, "")
