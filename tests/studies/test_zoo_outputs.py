"""Plants of which half of the states are hidden: what is measured, with which noise, and what comes of it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mpcoffline import MPC, Model, OfflineMPCLearner, QuadraticCost, TransitionTable
from mpcoffline.studies import zoo_outputs
from mpcoffline.studies.plant_files import PlantFile
from mpcoffline.studies.zoo_outputs import Case, Outcome, report, shown_states, with_outputs

QUICK: dict[str, Any] = {"value_n_steps": 20, "hidden": (8,), "preset": "fast"}
TEXT = """
import casadi as ca
import numpy as np
from mpcoffline import MPC, Model, Parameter, QuadraticCost

DT, STEPS, DISCOUNT, N_EPISODES, WHY = 0.1, 20, 0.95, 12, "a test"


class Plant:
    def reset(self, rng):
        self.x = rng.uniform(-1, 1, 2)
        return self.x.copy()

    def step(self, u):
        cost = float(self.x[0] ** 2 + 0.1 * u[0] ** 2)
        self.x = self.x + 0.1 * np.array([self.x[1], float(np.clip(u[0], -2, 2)) - 0.5 * self.x[1]])
        return self.x.copy(), cost, False

    def success(self):
        return abs(self.x[0]) < 0.2


def behaviour(rng):
    return lambda y, k: np.clip([-y[0] - y[1] + rng.normal()], -2, 2)


def _mpc(gain):
    def step(x, u, p):
        return x + 0.1 * ca.vertcat(x[1], p["gain"] * u[0] - 0.5 * x[1])

    cost = QuadraticCost(W=np.diag([1.0, 0.0]), R=[[0.1]])
    model = Model(step, nx=2, nu=1, dt=DT, discrete=True, parameters={"gain": Parameter(gain, low=0.1, high=10.0)})
    return MPC(model, cost, cost, horizon=15, discount=DISCOUNT, action_low=[-2], action_high=[2])


def mpc(seed):
    return _mpc(0.5)


def truth():
    return _mpc(1.0)
"""


@pytest.fixture
def mass(tmp_path: Path) -> str:
    path = tmp_path / "mass.py"
    path.write_text(TEXT)
    return str(path)


def test_what_tells_most_of_the_rest_is_measured() -> None:
    """Of two masses in a row, of which the first one moves the second, not both states of the first."""

    def step(x: Any, u: Any, _: Any) -> Any:
        return x + 0.1 * ca.vertcat(x[1], u[0] - x[0], x[3], x[0] - x[2])

    cost = QuadraticCost(np.eye(4), [[1.0]])
    mpc = MPC(Model(step, 4, 1, 0.1, discrete=True), cost, QuadraticCost(np.eye(4)), 5, 0.9, [-1.0], [1.0])
    rng = np.random.default_rng(0)
    s, u = rng.normal(size=(200, 4)), rng.uniform(-1.0, 1.0, (200, 1))
    log = TransitionTable.from_arrays(s, u, np.zeros(200), s, np.zeros(200), np.zeros(200, int))
    places = shown_states(mpc, log)
    assert len(places) == 2
    assert 2 in places or 3 in places  # the second mass says of the first one what that does not say of it


def test_an_output_has_one_value_at_each_instant(mass: str) -> None:
    log = PlantFile.load(Path(mass)).log(0)
    seen = with_outputs(log, [0], 2, np.array([0.1]), seed=1).values()
    plain, ids = log.values(), np.asarray(log.episode_ids)
    same = np.flatnonzero(ids[1:] == ids[:-1])
    np.testing.assert_array_equal(seen.next_observations[same], seen.observations[same + 1])
    noise = seen.observations[:, 0] - plain.observations[:, 0]
    assert noise.std() == pytest.approx(0.1, rel=0.2)
    np.testing.assert_array_equal(seen.actions, plain.actions)


def test_a_case_is_learned_from_a_place_alone(mass: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zoo_outputs, "OfflineMPCLearner", partial(OfflineMPCLearner, **QUICK))
    told: list[str] = []
    done = zoo_outputs.run_case(Case(mass, "mass", 0, 6), told.append)
    assert done.error == ""
    assert done.shown == "0 of 2"
    assert done.near
    assert not done.worse
    assert done.gain == pytest.approx(done.learned - done.mpc_1)
    assert done.verdict in ("recommend", "try with care", "keep MPC_1")
    assert told[0] == "log"
    page = report([done, Outcome("other", 1, 6, error="ValueError: no")])
    assert "**1 of 1**" in page
    assert "* Failed: other 1: ValueError: no" in page
    assert "| mass | 0 | 0 of 2 |" in page
