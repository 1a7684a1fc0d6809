"""``soften="auto"``: whatever a learner hands out has exact penalties in place of hard limits, and says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lq_plant
import numpy as np
import pytest
from lq_episodes import episodes

from mpcoffline import OfflineMPCLearner, make_solver
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.diagnostics.limits import limit_checks
from mpcoffline.learner.candidates import FULL
from mpcoffline.mpc import MPC, StateBounds
from mpcoffline.simulation.choice import FIRST
from mpcoffline.simulation.episodes import Episodes

QUICK: dict[str, Any] = {"value_n_steps": 60, "fit_n_steps": 20, "hidden": (16,), "terminal": "quadratic", "seed": 0}
LOG = episodes(n=40, steps=30)
ROOM = StateBounds([-0.6, -np.inf], [0.6, np.inf], "room")
LIMITED = lq_plant.make_mpc((0.3 * lq_plant.A, lq_plant.B)).replace(constraints=ROOM)


def fitted(mpc: MPC = LIMITED, **options: Any) -> OfflineMPCLearner:
    learner = OfflineMPCLearner(mpc, **(QUICK | options))
    learner.fit(LOG, show_progress=False)
    return learner


def price(mpc: MPC) -> float:
    (limit,) = mpc.state_bounds
    return 0.0 if limit.soft is None else limit.soft.l1


def test_all_candidates_are_softened_and_the_report_says_so(tmp_path: Path) -> None:
    learner = fitted(soften="auto", stage_cost="fitted")
    assert learner.candidates is not None
    assert all(price(mpc) > 0.0 for mpc in learner.candidates.values())
    assert price(learner.nominal_mpc) == 0.0  # as given
    (told,) = [each for each in learner.findings if each.startswith("Limits softened")]
    assert f"'room' at l1 = {price(learner.mpc):.3g}" in told
    nothing = np.zeros((1, 2))
    still = np.zeros((2, 4, 2))
    loop = Episodes(
        nothing, nothing, nothing > 0.0, still, still[:, 1:, :1], still[None], still[None, :, 1:, :1], np.zeros(1)
    )
    (check,) = limit_checks(LIMITED, LOG, loop, loop, learner.mpc)
    assert check.kind == f"hard, handed out with l1 = {price(learner.mpc):.3g}"
    learner.save(tmp_path / "l.zip")
    again = OfflineMPCLearner.load(tmp_path / "l.zip")
    assert again.soften == "auto"
    assert again.findings == learner.findings


def test_prices_follow_the_unit_of_the_cost() -> None:
    """Candidates in the unit of a log whose costs are a hundred times the MPC's have prices a hundred times as high."""
    columns = LOG.values()
    dear = type(LOG).from_arrays(
        columns.observations, columns.actions, 100.0 * columns.costs, columns.next_observations, columns.terminations
    )
    learner = OfflineMPCLearner(LIMITED, soften="auto", stage_cost="fitted", prior=1e3, **QUICK)
    learner.fit(dear, show_progress=False)
    found = learner.candidates
    assert found is not None
    assert price(found[FULL]) == pytest.approx(100.0 * price(found[FIRST]), rel=0.3)


def test_what_is_handed_out_solves_what_cannot_be_kept() -> None:
    start = [3.0, 0.0]  # from which no input of 1 leads to .6 in a step
    hard, soft = (fitted(candidate="full", soften=how) for how in (None, "auto"))
    assert price(hard.mpc) == 0.0
    assert not [each for each in hard.findings if "softened" in each]
    assert make_solver(hard.mpc, "ddp").solve(start).status == ["infeasible"]
    assert make_solver(soft.mpc, "ddp").solve(start).success


def test_nothing_hard_stays_as_it_is_and_other_words_are_refused() -> None:
    free = LIMITED.replace(constraints=None)
    assert fitted(free, candidate="full", soften="auto").mpc.to_json() == fitted(free, candidate="full").mpc.to_json()
    with pytest.raises(InvalidArgumentError, match="soften"):
        OfflineMPCLearner(LIMITED, soften="all")  # type: ignore[arg-type]
