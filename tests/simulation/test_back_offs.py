"""Limits made tighter until closed loops on the models of a log keep the given ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lq_plant
import numpy as np
import pytest
from numpy.typing import NDArray

from mpcoffline import OfflineMPCLearner, TransitionTable
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.mpc import MPC, Constraint, Penalty, QuadraticCost, StateBounds
from mpcoffline.simulation.back_offs import BackOffs, backed_off
from mpcoffline.simulation.logged_cost import LoggedCost
from mpcoffline.simulation.models import LogModels
from mpcoffline.simulation.quick import quick_policy
from mpcoffline.simulation.trials import Surroundings

Array = NDArray[np.float64]

MOST = 0.3


def disturbed(n: int = 40, steps: int = 30) -> TransitionTable:
    """The plant about its goal at x = (0.5, 0), pushed at random."""
    rng, rows = np.random.default_rng(0), []
    x = rng.uniform(-0.3, 0.5, (n, 2))
    goal = np.array([0.5, 0.0])
    for _ in range(steps):
        u = (x - goal) @ lq_plant.GAIN.T + rng.uniform(-1.0, 1.0, (n, 1))
        reached = x @ lq_plant.A.T + u @ lq_plant.B.T + 0.02 * rng.standard_normal((n, 2))
        rows.append((x, u, reached))
        x = reached
    s, a, after = (np.stack(part, axis=1).reshape(n * steps, -1) for part in zip(*rows, strict=True))
    cost = lq_plant.quadratic(lq_plant.W, s - goal) + lq_plant.quadratic(lq_plant.R, a)
    return TransitionTable.from_arrays(s, a, cost, after, np.zeros(n * steps), np.repeat(np.arange(n), steps))


LOG = disturbed()
SOFT = Penalty(50.0)


def limited(limit: Any) -> MPC:
    """Its goal lies beyond the limit, so that it stays at that."""
    cost = QuadraticCost(lq_plant.W, lq_plant.R, x_ref=[0.5, 0.0])
    changes = {"stage_cost": cost, "terminal_cost": QuadraticCost(np.eye(2), x_ref=[0.5, 0.0]), "constraints": limit}
    return lq_plant.make_mpc((lq_plant.A, lq_plant.B), **changes)


def place(mpc: MPC, priced: MPC | None = None) -> Surroundings:
    models = LogModels.of(mpc, LOG, identify_one_step(mpc, LOG), n_perturbed=1, n_residual=0)
    rows = np.flatnonzero(LOG.observations[:, 0] < 0.1)[:12]
    return Surroundings(models, LoggedCost(LOG, seen=mpc.ny, mpc=priced), LOG, rows, 25, mpc.layout)


def kept(mpc: MPC, around: Surroundings) -> float:
    """The share of the steps with x0 <= MOST, but for a thousandth of how far it moves."""
    (done,) = around.act([quick_policy(mpc)], kept=len(around.rows))
    x = done.states_kept[around.models.votes][:, :, :-1, 0]
    return float(np.mean(x <= MOST + 1e-3 * np.ptp(x)))


def test_limits_are_kept_in_the_share_that_was_asked_for() -> None:
    given = limited([StateBounds([-0.9, -np.inf], [MOST, np.inf], "level", SOFT)])
    around = place(given)
    found = backed_off(given, around, 0.95)
    assert found.before["level"] == pytest.approx(kept(given, around))
    assert found.before["level"] < 0.93
    assert found.after["level"] == pytest.approx(kept(found.mpc, around))
    assert found.after["level"] >= 0.95
    above, below = found.amounts["level"]
    assert 0.01 < above < 0.1  # of pushes of 0.02 a step
    assert below == 0.0
    (bounds,) = found.mpc.state_bounds
    np.testing.assert_allclose(np.asarray(bounds.high)[0], MOST - above)
    assert bounds.soft == SOFT
    assert f"'level' by {above:.3g}, 0 (kept in {found.before['level']:.1%}" in str(found)


def test_no_unit_matters_and_hard_ones_are_tightened_too() -> None:
    plain, scaled = (
        backed_off(mpc := limited(Constraint(lambda x, u, p, f=f: f * (x[0] - MOST), "level")), place(mpc), 0.95)
        for f in (1.0, 1e3)
    )
    assert plain.after["level"] >= 0.95
    np.testing.assert_allclose(scaled.amounts["level"], 1e3 * plain.amounts["level"], rtol=1e-2)


def test_what_is_kept_stays() -> None:
    given = limited([StateBounds([-0.9, -np.inf], [0.9, np.inf], "level")])
    found = backed_off(given, place(given), 0.95)
    assert found.mpc is given
    assert str(found) == "Limits not tightened; kept: 'level' in 100.0% of the steps."
    again = BackOffs.from_json(given, found.to_json())
    assert str(again) == str(found)
    with pytest.raises(FileFormatError, match="back-offs"):
        BackOffs.from_json(limited(None), found.to_json())


def test_a_learner_hands_them_out(tmp_path: Path) -> None:
    quick: dict[str, Any] = {"value_n_steps": 60, "fit_n_steps": 20, "hidden": (16,), "terminal": "given"}
    given = limited([StateBounds([-0.9, -np.inf], [MOST, np.inf], "level", SOFT)])
    learner = OfflineMPCLearner(given, "cost", keep_limits=0.95, seed=0, **quick)
    learner.fit(LOG, show_progress=False)
    assert learner.candidates is not None
    assert learner.candidates.chosen.endswith(", backed off")
    assert np.asarray(learner.mpc.state_bounds[0].high)[0] < MOST
    assert "Limits tightened: 'level' by" in learner.findings[-1]
    assert learner.candidates.back_offs is not None
    assert learner.candidates.back_offs.after["level"] >= 0.95
    learner.save(tmp_path / "l.zip")
    again = OfflineMPCLearner.load(tmp_path / "l.zip")
    assert again.keep_limits == 0.95
    assert again.findings == learner.findings
    with pytest.raises(InvalidArgumentError, match="candidate"):
        OfflineMPCLearner(given, keep_limits=0.95, candidate="full")


def test_as_far_as_that_pays() -> None:
    """Of a dear limit, as pushes make the plant violate it; not of one that costs next to nothing, nor of a hard."""

    def found(price: Penalty | None) -> tuple[MPC, BackOffs, Surroundings]:
        given = limited([StateBounds([-0.9, -np.inf], [MOST, np.inf], "level", price)])
        around = place(given, given)
        return given, backed_off(given, around, None), around

    given, dear, around = found(Penalty(500.0))
    assert dear.amounts["level"][0] > 0.0
    before, after = around.act([quick_policy(given), quick_policy(dear.mpc)])
    votes = around.models.votes
    assert after.cost[votes].mean() < before.cost[votes].mean()
    for price in (Penalty(1e-6), None):
        given, cheap, _ = found(price)
        assert cheap.mpc is given


def test_a_learner_takes_what_pays() -> None:
    quick: dict[str, Any] = {"value_n_steps": 60, "fit_n_steps": 20, "hidden": (16,), "terminal": "given"}
    given = limited([StateBounds([-0.9, -np.inf], [MOST, np.inf], "level", Penalty(500.0))])
    learner = OfflineMPCLearner(given, "cost", seed=0, **quick)
    learner.fit(LOG, show_progress=False)
    assert learner.candidates is not None
    trials, chosen = learner.candidates.trials, learner.candidates.chosen
    assert trials is not None
    assert chosen.endswith(", backed off")
    assert trials.improves(chosen, chosen.removesuffix(", backed off"))
