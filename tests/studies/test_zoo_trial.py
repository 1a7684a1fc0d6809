"""What trials and polishing are worth on plant files: outcomes, counts, pages."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plant_file import TEXT

from mpcoffline import MPCPolicy, OfflineMPCLearner
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.studies import zoo, zoo_polish, zoo_trial
from mpcoffline.studies.plant_files import PlantFile

QUICK: dict[str, Any] = {"value_n_steps": 20, "fit_n_steps": 5, "hidden": (8,)}


@pytest.fixture
def cart(tmp_path: Path) -> str:
    path = tmp_path / "cart.py"
    text = TEXT.replace("0.05 * self.rng", "0.005 * self.rng")
    path.write_text(text.replace("N_EPISODES, WHY = 0.1, 12, 0.9, 6", "N_EPISODES, WHY = 0.1, 12, 0.9, 25"))
    return str(path)


def test_a_trial_is_what_the_policy_does_on_the_plant(cart: str) -> None:
    plant = PlantFile.load(Path(cart))
    policy = MPCPolicy(plant.module.truth())
    trial, again = plant.trial(policy, 3, 4), plant.trial(policy, 3, 4)
    assert trial.n_episodes == 4
    np.testing.assert_array_equal(trial.rows, again.rows)
    values = trial.values()
    decided, _ = policy.predict(values.observations)
    np.testing.assert_allclose(values.actions, decided, atol=1e-5)
    costs = values.observations[:, 0] ** 2 + 0.1 * values.actions[:, 0] ** 2
    np.testing.assert_allclose(values.costs, costs, atol=1e-6)
    starts = {float(y) for y in values.observations[trial.episodes.firsts, 0]}
    log = plant.log(3).values().observations[:, 0]
    assert starts.isdisjoint(map(float, log))


def test_a_trial_joins_the_log_and_its_controller_is_a_candidate(cart: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fits: list[tuple[int, Any, Any]] = []

    class Quick(OfflineMPCLearner):
        def fit(self, dataset: Any, **more: Any) -> Any:
            assert isinstance(dataset, TransitionTable)
            fits.append((dataset.n_episodes, more.get("also"), more.get("start")))
            return super().fit(dataset, **more)

    monkeypatch.setattr(zoo_trial, "OfflineMPCLearner", partial(Quick, **QUICK))
    told: list[str] = []
    done = zoo_trial.run_case(zoo_trial.Case(cart, "cart", 0, 6, 5), told.append)
    assert done.error == ""
    (first, none, cold), (second, also, start) = fits
    assert (first, none, cold) == (25, None, None)
    assert second == 30
    assert also == {"running": start}
    assert done.change == pytest.approx(done.after - done.before)
    assert done.short_after - done.short_before == pytest.approx(done.change)
    assert np.isfinite([done.seen, done.lowest, done.highest]).all()
    assert done.steps > 0
    assert "a trial of 5 episodes" in told
    broken = zoo_trial.run_case(zoo_trial.Case(cart + "x", "cart", 0, 6, 5))
    assert "StorageError" in broken.error


def trial(before: float, after: float, yardstick: float, seed: int = 0, **more: Any) -> zoo_trial.Outcome:
    figures = {"short_before": before - yardstick, "short_after": after - yardstick, "change": after - before}
    figures |= {"before": before, "after": after, "yardstick": yardstick, "change_error": 0.1}
    return zoo_trial.Outcome("cart", seed, 50, 5, **(figures | more))


def test_the_share_that_is_closed_knows_no_sign_of_the_cost() -> None:
    for shift in (0.0, -200.0):
        half = trial(110.0 + shift, 105.0 + shift, 100.0 + shift)
        assert half.far
        assert half.closed == pytest.approx(0.5)
        assert not half.worse
        assert trial(100.0 + shift, 103.0 + shift, 99.0 + shift).worse
        assert not trial(101.0 + shift, 99.0 + shift, 100.0 + shift).far
    assert trial(1.0, np.nan, 0.5).worse
    rows = [
        trial(110.0, 105.0, 100.0, 0, predicted=9.0, lowest=8.0, highest=11.0, seen=10.0),
        trial(120.0, 101.0, 100.0, 1, predicted=9.0, lowest=8.0, highest=11.0, seen=20.0),
        trial(120.0, 130.0, 100.0, 2),
        trial(100.0, 100.0, 100.0, 3, error="no"),
    ]
    page = zoo_trial.report(rows)
    assert "before the trial: 3 of 3; of their distance the trial closed **50%** in the median" in page
    assert "Dearer than before by more than 2 %: **1 of 3** (cart 2)" in page
    assert "within the band: **1 of 2**; the middle was off by 32.5% in the median" in page
    assert "Failed: cart 3: no" in page
    assert "no starts" in zoo_trial.report([])


def test_polishing_is_measured(cart: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zoo_polish, "OfflineMPCLearner", partial(OfflineMPCLearner, **QUICK))
    done = zoo_polish.run_case(zoo.Case(cart, "cart", 0, 6))
    assert done.error == ""
    assert "polished: " in done.why
    assert min(done.learning_s, done.choice_s, done.polish_s) > 0.0
    assert done.taken in (0.0, 1.0)
    if not done.taken:
        assert (done.gain, done.polish_gain, done.polished) == (0.0, 0.0, done.chosen)
    page = zoo_polish.report([done])
    assert f"* Taken: **{done.taken:.0f} of 1**" in page


def test_gains_of_polishing_are_counted() -> None:
    def outcome(seed: int, gain: float, taken: float = 1.0) -> zoo_polish.Outcome:
        times = {"learning_s": 10.0, "choice_s": 5.0, "polish_s": 50.0}
        gains = {"learning_gain": 20.0, "choice_gain": 1.0, "polish_gain": 0.5}
        costs = {"mpc_1": 100.0, "chosen": 50.0, "polished": 50.0 - gain}
        return zoo_polish.Outcome(
            "cart", seed, 50, gain=gain, gain_error=0.1, taken=taken, candidate="full", **costs, **times, **gains
        )

    page = zoo_polish.report([outcome(0, 0.5), outcome(1, -0.5), outcome(2, 0.1), outcome(3, 0.0, 0.0)])
    assert "Taken: **3 of 4**; of these better on the plant beyond two standard errors: **1**, worse: **1**" in page
    assert "-1 % to 1 % (median 0.1 %)" in page
    assert "regressions 2, choice 0.2, search 0.01" in page
