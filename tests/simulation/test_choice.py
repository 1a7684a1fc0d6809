"""The choice among MPCs: where they act changes no number."""

from __future__ import annotations

import lq_plant
import numpy as np
import pytest
from lq_episodes import episodes

from mpcoffline.core.parallel import SETTING
from mpcoffline.estimation.identification import identify_one_step
from mpcoffline.mpc import MPC, QuadraticCost
from mpcoffline.simulation import choice
from mpcoffline.simulation.choice import FIRST, choose
from mpcoffline.simulation.logged_cost import LoggedCost
from mpcoffline.simulation.models import LogModels
from mpcoffline.simulation.trials import Surroundings, Trials

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


def made_up(around: Surroundings, gaps: dict[str, float], noise: float) -> Trials:
    """Trials in which each MPC costs 100 and a gap, with noise of its own at each start."""
    trials, rng = Trials.none([FIRST, *gaps], around), np.random.default_rng(0)
    level = 100.0 + 20.0 * rng.standard_normal(trials.cost.shape[1:])
    for k, gap in enumerate([0.0, *gaps.values()]):
        trials.cost[k] = trials.second[k] = level + gap + noise * rng.standard_normal(level.shape)
    return trials


def test_what_takes_much_more_of_its_solver_than_the_best_leaves(around: Surroundings) -> None:
    """Where it is not better: no difference can be seen between the first two; the third is the best for sure."""
    gaps = {"quick": -10.2, "creeping": -10.0}
    labour = {"quick": 100.0, "creeping": 500.0, "dear": 5_000.0, FIRST: 80.0}

    def left(gaps: dict[str, float], labour: dict[str, float]) -> list[str]:
        return choice._still_good(made_up(around, gaps, 0.3), list({FIRST: 0.0, **gaps}), 16, "", labour)

    assert left(gaps, dict.fromkeys(labour, 100.0)) == ["quick", "creeping"]
    assert left(gaps, labour) == ["quick"]
    assert left(gaps, {**labour, "creeping": 350.0}) == ["quick", "creeping"]
    assert left({**gaps, "dear": -20.0}, labour) == ["dear"]


@pytest.mark.parametrize("preferred", ["", "h"])
def test_ever_fewer_go_on_and_the_preferred_one(
    around: Surroundings, monkeypatch: pytest.MonkeyPatch, preferred: str
) -> None:
    """All act in the first rounds, then MPC_1 and six, then MPC_1 and four, whatever their costs say.

    The preferred one acts in all, and is taken where nothing says that another is better.
    """
    factors = dict(zip([FIRST, *"abcdefgh"], np.geomspace(30.0, 0.2, 9), strict=True))
    many = {
        name: BEST.replace(stage_cost=QuadraticCost(lq_plant.W, f * np.asarray(lq_plant.R)))
        for name, f in factors.items()
    }
    monkeypatch.setattr(choice, "_still_good", lambda trials, names, *how: [name for name in names if name != FIRST])
    monkeypatch.delenv(SETTING, raising=False)
    acted: dict[int, set[str]] = {}

    def tell(start: int, _: int, names: str) -> None:
        acted.setdefault(start, set()).update(names.split(", ") if names else ())

    rows = LOG.episodes.firsts[:16]
    stage = Surroundings(around.models, LoggedCost(LOG), LOG, rows, 20, BEST.layout, spare=4)
    _, chosen = choose(many, stage, tell=tell, preferred=preferred)
    more = bool(preferred)
    assert [len(acted[start]) for start in sorted(acted)][:4] == [9, 9, 7 + more, 5 + more]
    assert chosen == (preferred or "a")
