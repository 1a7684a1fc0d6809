"""Data that say nothing, or more than numbers can: a clear word instead of a library's error."""

from __future__ import annotations

from typing import Any

import lq_plant
import numpy as np
import pytest

from mpcoffline import OfflineMPCLearner, TransitionTable, nominal_mpc
from mpcoffline.core.errors import InvalidDataError
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.mpc.scaling import cost_spread

QUICK: dict[str, Any] = {
    "value_n_steps": 50,
    "fit_n_steps": 5,
    "hidden": (16,),
    "refit_iterations": 20,
    "n_restarts": 0,
}
N = 200


def table(state: float | None = None, cost: float | None = None) -> TransitionTable:
    log = lq_plant.random_log(N)
    s, a, costs, s_next, ends = (np.asarray(part, np.float64) for part in log.values())
    if state is not None:
        s[:], s_next[:], a[:] = state, state, 0.1
    if cost is not None:
        costs[:] = cost
    return TransitionTable.from_arrays(s, a, costs, s_next, ends, log.episode_ids)


def fitted(data: TransitionTable, preset: str = "fast") -> OfflineMPCLearner:
    learner = OfflineMPCLearner(lq_plant.make_mpc(), preset=preset, seed=0, **QUICK)
    learner.fit(data, show_progress=False)
    return learner


@pytest.mark.parametrize(("state", "cost"), [(0.5, 2.0), (0.0, 0.0), (0.1, 0.7)])
def test_constant_data_give_a_constant_terminal_cost(
    state: float, cost: float, caplog: pytest.LogCaptureFixture
) -> None:
    learner = fitted(table(state, cost))
    assert np.isfinite(learner.theta).all()
    assert f"the logged cost is {cost:g} in every transition" in caplog.text


@pytest.mark.parametrize("cost", [1e-30, 1.0, float(np.finfo(np.float32).max)])
def test_the_error_of_a_constant_cost_is_in_its_own_unit(cost: float) -> None:
    learner = fitted(table(cost=cost), "paper")
    assert learner.result is not None
    assert learner.result.loss_after < 10.0
    assert cost_spread(np.full(7, np.float32(cost))) == pytest.approx(float(np.float32(cost)), rel=1e-6)


def test_the_unit_of_other_costs_is_their_spread() -> None:
    costs = np.random.default_rng(0).uniform(size=50)
    assert cost_spread(costs) == costs.std()
    assert cost_spread(np.zeros(3)) == 1.0


def test_what_overflows_is_called_that() -> None:
    rng = np.random.default_rng(0)
    s = 1e30 * rng.normal(size=(N + 1, 3))
    a, costs = rng.uniform(-2.0, 2.0, (N, 1)), rng.uniform(size=N)
    data = TransitionTable.from_arrays(s[:-1], a, costs, s[1:], np.zeros(N))
    with pytest.raises(InvalidDataError, match=r"identification: .*states up to .*e\+30 .* units"):
        identify_one_step(nominal_mpc("mpcoffline/PendulumSwingUp-v0", alpha=1.0, seed=0), data)
