"""The comparison runs every controller, shares what can be shared, and keeps the conditions apart."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest
import torch

from mpcoffline.learner.presets import PRESETS
from mpcoffline.plants.nominal import nominal_mpc
from mpcoffline.studies.comparison import CaseGroup, Row, groups, run_group, without

BRIEF = {
    "value_n_steps": 200,
    "hidden": (32,),
    "fit_n_steps": 10,
    "refit_rows": 2_000,
    "refit_iterations": 30,
}


@pytest.fixture(autouse=True)
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Presets that learn little, and fast."""
    torch.set_num_threads(1)
    # No cost here is a distance, which takes a while to find.
    monkeypatch.setattr(import_module("mpcoffline.learning.known_cost"), "normed_cost", lambda *_: None)
    for name, config in list(PRESETS.items()):
        changes = {"terminal": "quadratic"} if "terminal" in config.options else {}
        monkeypatch.setitem(PRESETS, name, config.replaced(BRIEF | changes))


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_every_controller_has_a_row_in_every_case() -> None:
    group = CaseGroup("pendulum", 0, "clean", ((1.5, 0), (0.5, 1)))
    rows = run_group(group, n_episodes=2)
    cases = {(row.alpha, row.seed) for row in rows}
    assert cases == {(1.5, 0), (0.5, 1)}
    names = [row.controller for row in rows if row.seed == 1]
    assert names[:3] == ["MPC_1", "MPC_2 (paper)", "MPC_3 (paper)"]
    assert names[-3:] == ["default", "fast", "best"]
    assert all(np.isfinite([row.cost, row.discounted_cost]).all() for row in rows)
    (best,) = [row for row in rows if row.controller == "best known"]
    assert best.cost <= min(row.cost for row in rows if row.seed == 0) + 1e-9
    # From alpha = 0.5 or 1.5 identification finds the same plant.
    default: dict[int, Row] = {row.seed: row for row in rows if row.controller == "default"}
    assert default[0].discounted_cost == pytest.approx(default[1].discounted_cost, rel=0.02)


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_the_linear_task_is_compared_with_its_optimum() -> None:
    rows = {row.controller: row for row in run_group(CaseGroup("linear", 0, "clean", ((1.0, 0),)), n_episodes=3)}
    assert min(rows.values(), key=lambda row: row.discounted_cost).controller == "optimal"


def test_a_parameter_can_be_taken_out_of_the_model() -> None:
    mpc = nominal_mpc("mpcoffline/CartPoleSwingUp-v0", alpha=1.0, seed=3)
    reduced = without(mpc, "mu", 0.0)
    assert {name for name in mpc.values if name not in reduced.values} == {"model.mu"}
    x, u, values = np.array([0.1, 0.5, 0.6, 0.8, 1.0]), np.array([0.7]), mpc.values
    frictionless = [values["model.m_c"], 0.0, values["model.m_p"], values["model.l"]]
    np.testing.assert_allclose(reduced.model(x, u), mpc.model.function(x, u, frictionless).full().ravel(), rtol=1e-12)


def test_the_groups_hold_enough_seeds() -> None:
    every = groups()
    assert len({group.name for group in every}) == len(every)
    for task in ("pendulum", "cartpole"):
        clean = [group for group in every if group.task == task and group.condition == "clean"]
        assert len({group.data_seed for group in clean}) >= 3
        assert all(len({seed for alpha, seed in group.cases if alpha == 1.5}) >= 5 for group in clean)
    assert {group.cases[0][0] for group in every if group.task == "linear"} == {0.0, 0.5, 1.0, 1.5, 2.0}
