"""What a fit hands out: the best of its candidates on models of the log, MPC_1 where none is better."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lq_plant
import numpy as np
import pytest
from lq_episodes import episodes

from mpcoffline import MPCPolicy, OfflineMPCLearner
from mpcoffline.core.archive import read_archive
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, UnknownIdError
from mpcoffline.learner.candidates import FULL, compiling_ahead
from mpcoffline.learner.effort import Effort
from mpcoffline.mpc import MPC
from mpcoffline.simulation import polishing
from mpcoffline.simulation.choice import FIRST
from mpcoffline.simulation.polishing import Polished
from mpcoffline.simulation.trials import Trials
from mpcoffline.solvers.ddp import Ahead
from mpcoffline.solvers.ddp.codegen import source

QUICK: dict[str, Any] = {"value_n_steps": 60, "fit_n_steps": 20, "hidden": (16,), "terminal": "quadratic", "seed": 0}
LOG = episodes(n=40, steps=30)
WRONG = lq_plant.make_mpc((0.3 * lq_plant.A, lq_plant.B))


def fitted(mpc: MPC = WRONG, **options: Any) -> OfflineMPCLearner:
    learner = OfflineMPCLearner(mpc, **(QUICK | options))
    learner.fit(LOG, show_progress=False)
    return learner


@pytest.fixture(scope="module")
def plain() -> OfflineMPCLearner:
    """One fit, for whoever only looks at it."""
    return fitted()


def true_cost(mpc: MPC) -> float:
    """Of 40 steps from four states, by the plant's own matrices."""
    policy, state, total = MPCPolicy(mpc), None, 0.0
    x = np.array([[1.0, 0.0], [0.0, 1.0], [-0.7, 0.7], [0.5, 0.5]])
    for _ in range(40):
        u, state = policy.predict(x, state=state)
        total += float(np.sum(lq_plant.quadratic(lq_plant.W, x) + lq_plant.quadratic(lq_plant.R, u)))
        x = x @ lq_plant.A.T + u @ lq_plant.B.T
    return total


def test_the_best_one_is_handed_out(plain: OfflineMPCLearner) -> None:
    learner = plain
    found = learner.candidates
    assert found is not None
    assert next(iter(found)) == FIRST
    assert {FULL, "identified"} <= set(found)
    assert found.chosen != FIRST
    assert learner.mpc is found.mpc is learner.policy.mpc
    assert true_cost(learner.mpc) < 0.9 * true_cost(WRONG)
    assert true_cost(learner.mpc) <= min(true_cost(found[FULL]), true_cost(found["identified"])) * 1.02
    assert f"* {found.chosen}" in str(found)
    assert learner.findings[-1].startswith(f"Handed out: {found.chosen!r}, the best of ")
    with pytest.raises(UnknownIdError, match="identified"):
        found["identifed"]


def test_mpc_1_is_handed_out_where_nothing_is_better(caplog: pytest.LogCaptureFixture) -> None:
    """It is the optimum already."""
    exact = lq_plant.make_mpc((lq_plant.A, lq_plant.B))
    learner = fitted(exact, horizon=2, discount=0.3)
    assert learner.candidates is not None
    assert learner.candidates.chosen == FIRST
    assert learner.mpc.to_json() == exact.to_json()
    assert "Handed out: MPC_1" in caplog.text
    assert learner.result is not None  # of the whole fit
    np.testing.assert_array_equal(learner.result.theta, learner.candidates[FULL].theta)


def test_one_is_taken_by_name_and_nothing_is_tried() -> None:
    full, named = fitted(candidate=FULL), fitted(candidate="identified")
    assert full.candidates is None
    assert named.candidates is not None
    assert named.candidates.trials is None
    assert named.mpc.stage_cost.to_json() == WRONG.stage_cost.to_json()
    np.testing.assert_allclose(named.mpc.values["model.A"], lq_plant.A, atol=1e-3)
    with pytest.raises(UnknownIdError, match="identified, farther"):
        fitted(candidate="best")
    assert fitted(candidate="full, undiscounted").mpc.to_json() == full.mpc.replace(discount=1.0).to_json()


def test_the_published_recipe_never_chooses() -> None:
    learner = OfflineMPCLearner(WRONG, preset="paper", hidden=(16,), value_n_steps=40, fit_n_steps=10, seed=0)
    learner.fit(LOG, show_progress=False)
    assert learner.candidates is None


def test_what_is_asked_for_limits_the_candidates() -> None:
    far = fitted(horizon=17).candidates
    assert far is not None
    assert {mpc.horizon for name, mpc in far.items() if name != FIRST} == {17}
    given = fitted(discount=0.9).candidates
    assert given is not None
    assert {mpc.discount for name, mpc in given.items() if name != FIRST} == {0.9}
    fixed = fitted(learn="cost").candidates
    assert fixed is not None
    for mpc in fixed.values():
        np.testing.assert_array_equal(mpc.values["model.A"], WRONG.values["model.A"])
    learned = fitted(stage_cost="fitted").candidates
    assert learned is not None
    assert {name.removesuffix(", undiscounted") for name in learned} == {FIRST, "fitted cost", FULL}


def test_the_same_seed_chooses_the_same(plain: OfflineMPCLearner) -> None:
    first, second = plain.candidates, fitted().candidates
    assert first is not None
    assert second is not None
    assert first.trials is not None
    assert second.trials is not None
    assert first.chosen == second.chosen
    np.testing.assert_array_equal(first.trials.cost, second.trials.cost)


def test_the_best_one_may_be_polished(
    plain: OfflineMPCLearner, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """The search itself has its own tests."""
    mpcs: list[MPC] = []

    def search(mpc: MPC, *_: Any) -> Polished:
        mpcs.append(mpc)
        return Polished(mpc.replace(horizon=mpc.horizon + 1), len(mpcs) == 1, 0.1, 0.01, 8, "not polished: why")

    monkeypatch.setattr("mpcoffline.learner.candidates.polished", search)
    learner = fitted(polish=True)
    assert learner.candidates is not None
    assert learner.candidates.chosen == f"{plain.candidates.chosen}, polished"  # type: ignore[union-attr]
    assert learner.mpc.horizon == mpcs[0].horizon + 1
    learner.save(tmp_path / "l.zip")
    assert OfflineMPCLearner.load(tmp_path / "l.zip").polish
    again = fitted(polish=True)
    assert again.candidates is not None
    assert again.candidates.chosen == plain.candidates.chosen  # type: ignore[union-attr]
    assert "not polished: why" in caplog.text


def test_polishing_needs_a_choice_and_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """The package is asked for before anything is learned."""
    with pytest.raises(InvalidArgumentError, match="'auto' with polish"):
        OfflineMPCLearner(WRONG, candidate=FULL, polish=True)
    monkeypatch.setitem(sys.modules, "cma", None)
    learner = OfflineMPCLearner(WRONG, **QUICK, polish=True)
    with pytest.raises(InvalidArgumentError, match=r"mpcoffline\[polish\]"):
        learner.fit(LOG, show_progress=False)
    assert not learner.history


def test_a_fit_interrupted_while_it_is_polished_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = fitted(polish=True)
    moved, real = [0], polishing._moved

    def until(most: int) -> Any:
        def move(*what: Any) -> MPC:
            moved[0] += 1
            if moved[0] > most:
                raise KeyboardInterrupt
            return real(*what)

        return move

    monkeypatch.setattr(polishing, "_moved", until(20))
    path, again = tmp_path / "fit.ckpt", OfflineMPCLearner(WRONG, **QUICK, polish=True)
    with pytest.raises(KeyboardInterrupt):
        again.fit(LOG, show_progress=False, checkpoint=path)
    _, arrays = read_archive(path, "checkpoint")
    assert [array.shape for name, array in arrays.items() if name.startswith("kept/polish-")] == [(2, 8)]
    monkeypatch.setattr(polishing, "_moved", until(10_000))
    again = OfflineMPCLearner(WRONG, **QUICK, polish=True)
    again.fit(LOG, show_progress=False, checkpoint=path)
    assert again.candidates is not None
    assert whole.candidates is not None
    assert again.candidates.chosen == whole.candidates.chosen
    np.testing.assert_array_equal(again.theta, whole.theta)
    assert again.history == whole.history


def test_regressions_and_simulation_are_told_side_by_side(plain: OfflineMPCLearner) -> None:
    trials = Trials(
        ("MPC_1", "full", "better", "best"), ("a", "b", "c"), np.array([True, True, False]),
        np.array([[[9.0, 8.0]] * 3, [[5.0, np.nan]] * 3, [[3.0, 2.0]] * 3, [[2.0, 2.0], [2.0, 2.0], [-99.0, 0.0]]]),
        np.zeros((4, 3, 2)), np.zeros((4, 3, 2), dtype=bool), np.arange(2), np.zeros(2), np.ones(2, dtype=bool),
        np.ones(2, dtype=bool), 10,
    )  # fmt: skip
    effort = Effort.of(trials, {"learn": 2.0, "choose": 4.0, "polish": 10.0}, ("MPC_1", "full", "better", "best"))
    assert effort.shares == (("learn", 2.0, 4.0), ("choose", 4.0, 2.0), ("polish", 10.0, 0.5))
    assert [row[3] for row in effort.table.rows] == ["2", "0.5", "0.05"]
    assert plain.candidates is not None
    assert plain.candidates.effort is not None
    learning, choice = plain.candidates.effort.shares
    assert min(learning.seconds, choice.seconds) > 0.0
    assert learning.gain > 0.0  # of a model that was far off


def test_a_fit_that_a_callback_ends_chooses_too() -> None:
    learner = OfflineMPCLearner(WRONG, **QUICK)
    learner.fit(LOG, callbacks=[lambda found, *_: found.result is None], show_progress=False)
    assert learner.candidates is not None
    assert learner.candidates.chosen != FIRST


def test_candidates_and_trials_come_back_from_a_file(plain: OfflineMPCLearner, tmp_path: Path) -> None:
    learner = plain
    learner.save(tmp_path / "l.zip")
    again = OfflineMPCLearner.load(tmp_path / "l.zip")
    assert str(again) == str(learner)
    assert str(again.candidates) == str(learner.candidates)
    np.testing.assert_array_equal(again.theta, learner.theta)
    assert again.candidate == "auto"


def test_a_file_whose_candidates_do_not_fit_is_refused(
    plain: OfflineMPCLearner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = plain
    monkeypatch.setitem(vars(learner.candidates), "chosen", "another")
    learner.save(tmp_path / "l.zip")
    with pytest.raises(FileFormatError, match="candidates"):
        OfflineMPCLearner.load(tmp_path / "l.zip")


def test_further_candidates_take_part() -> None:
    best = lq_plant.make_mpc((lq_plant.A, lq_plant.B))
    learner = OfflineMPCLearner(WRONG, **QUICK)
    learner.fit(LOG, show_progress=False, also={"running": best})
    assert learner.candidates is not None
    assert learner.candidates["running"] is best
    for also, message in (({FULL: best}, "other names than"), ({"a\n": best}, "candidate")):
        with pytest.raises(InvalidArgumentError, match=message):
            learner.fit(LOG, also=also)


@pytest.mark.parametrize("terminal", ["network", "auto", "given"])
def test_solvers_are_compiled_ahead_of_the_numbers(monkeypatch: pytest.MonkeyPatch, terminal: str) -> None:
    """What is compiled before the first step is the code of what is tried at the end."""
    foreseen: list[str] = []

    class Noting(Ahead):
        def start(self, mpcs: Iterable[MPC]) -> None:
            foreseen.extend(map(source, mpcs))

    compiling = compiling_ahead

    @contextmanager
    def noting(learner: OfflineMPCLearner) -> Iterator[Callable[[list[MPC]], None]]:
        with monkeypatch.context() as patch:
            patch.setattr("mpcoffline.learner.candidates.Ahead", Noting)
            with compiling(learner) as start:
                yield start

    monkeypatch.setattr("mpcoffline.learner.learner.compiling_ahead", noting)
    learner = fitted(terminal=terminal, learn="cost+model")
    assert learner.candidates is not None
    assert {source(learner.candidates[name]) for name in (FIRST, FULL)} <= set(foreseen)
