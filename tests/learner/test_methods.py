"""A learning method from another package: registered, fitted, interrupted, saved, and unknown where it is missing."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import lq_plant
import numpy as np
import pytest

from mpcoffline import OfflineMPCLearner
from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, UnknownIdError
from mpcoffline.learning import METHODS, FitResult, Known, Method, Stage, Training
from mpcoffline.learning.stages import Change


# ---------------------------------------------------------------- what an author writes
@dataclass(frozen=True)
class SearchConfig:
    n_steps: int = 40
    width: float = 0.05

    def __post_init__(self) -> None:
        check_integers(1, n_steps=self.n_steps)


class Search:
    """Random search for the model with the smallest one-step error: another family, of which no room here knows."""

    def __init__(self, known: Known, config: SearchConfig) -> None:
        self._known, self._config, self.step, self.n_steps = known, config, 0, config.n_steps
        self._theta = known.mpc.theta
        self._first = self._best = self._error(self._theta)

    def _error(self, theta: np.ndarray[Any, Any]) -> float:
        s, a, _, reached, _ = self._known.table.values()
        return float(np.mean((self._known.mpc.dynamics_function(s.T, a.T, theta).full().T - reached) ** 2))

    @property
    def done(self) -> bool:
        return self.step >= self.n_steps

    @property
    def result(self) -> FitResult:
        return FitResult(self._theta, self._first, self._best)

    def advance(self, n: int) -> dict[str, float]:
        space = self._known.mpc.space
        for _ in range(min(n, self.n_steps - self.step)):
            self.step += 1
            rng = np.random.default_rng([self._known.seed, self.step])
            moved = self._theta + self._config.width * rng.normal(size=space.size) * space.mask(("model",))
            if (error := self._error(moved)) < self._best:
                self._best, self._theta = error, moved
        return {"prediction_loss": self._best}

    def to_arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        return {"theta": self._theta, "step": np.array(self.step), "best": np.array(self._best)}

    def restore(self, arrays: dict[str, np.ndarray[Any, Any]]) -> None:
        self._theta, self.step, self._best = arrays["theta"], int(arrays["step"]), float(arrays["best"])


class SearchStage(Stage):
    phase = "searching"

    def __init__(self, config: SearchConfig) -> None:
        self._config = config

    def begin(self, known: Known) -> Training:
        return Search(known, self._config)

    def outcome(self, known: Known, training: Training) -> Known:
        return replace(known, mpc=known.mpc.with_theta(training.result.theta), result=training.result)


@dataclass(frozen=True)
class RandomSearch(Method):
    search: SearchConfig = field(default_factory=SearchConfig)

    def stages(self) -> dict[str, Stage | Change]:
        return {"search": SearchStage(self.search)}


# ---------------------------------------------------------------- what it gets
@pytest.fixture(autouse=True)
def door(monkeypatch: pytest.MonkeyPatch) -> None:
    """The method is registered, for the length of a test."""
    monkeypatch.setattr(METHODS, "_things", dict(METHODS._things))
    METHODS.add("random-search", RandomSearch)


def learner(**options: Any) -> OfflineMPCLearner:
    return OfflineMPCLearner(lq_plant.make_mpc(), method="random-search", seed=3, **options)


def test_a_method_of_ones_own_learns_and_comes_back_from_its_file(tmp_path: Path) -> None:
    table, one = lq_plant.random_log(200), learner(n_steps=30, width=0.02)
    history = one.fit(table, n_steps_per_epoch=10, show_progress=False)
    assert [set(metrics) for _, metrics in history] == [{"prediction_loss"}] * 3
    assert one.result is not None
    assert history[-1][1]["prediction_loss"] == one.result.loss_after < one.result.loss_before
    one.policy.predict(np.zeros(2))
    one.save(tmp_path / "l.zip")
    loaded = OfflineMPCLearner.load(tmp_path / "l.zip")
    assert loaded.method == one.method == RandomSearch(search=SearchConfig(30, 0.02))
    np.testing.assert_array_equal(loaded.theta, one.theta)
    loaded.fit(table, show_progress=False)
    np.testing.assert_array_equal(loaded.theta, one.theta)


def test_its_interrupted_fit_ends_at_the_same_bits(tmp_path: Path) -> None:
    table, whole, resumed = lq_plant.random_log(200), learner(), learner()
    options: dict[str, Any] = {"n_steps_per_epoch": 10, "show_progress": False}
    whole.fit(table, **options)
    learner().fit(table, checkpoint=tmp_path / "c.zip", callbacks=[lambda *at: at[1] < 2], **options)
    assert resumed.fit(table, checkpoint=tmp_path / "c.zip", **options) == whole.history
    np.testing.assert_array_equal(resumed.theta, whole.theta)


def test_where_it_is_unknown_its_files_are_refused_by_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = lq_plant.random_log(200)
    one = learner()
    one.fit(table, checkpoint=tmp_path / "c.zip", n_steps_per_epoch=20, show_progress=False)
    one.save(tmp_path / "l.zip")
    monkeypatch.delitem(METHODS._things, "random-search")
    with pytest.raises(FileFormatError, match=r"a learning method that is known here \(bellman, paper\), got 'random-"):
        OfflineMPCLearner.load(tmp_path / "l.zip")
    with pytest.raises(FileFormatError, match="import what registers that learning method first"):
        OfflineMPCLearner(lq_plant.make_mpc()).fit(table, checkpoint=tmp_path / "c.zip", show_progress=False)
    with pytest.raises(UnknownIdError, match="learning method"):
        learner()
    before = (tmp_path / "l.zip").read_bytes()
    with pytest.raises(InvalidArgumentError, match="Register it"):
        one.save(tmp_path / "l.zip")
    assert (tmp_path / "l.zip").read_bytes() == before


def test_an_object_will_do_where_a_name_does() -> None:
    table = lq_plant.random_log(100)
    named, given = learner(n_steps=5), OfflineMPCLearner(lq_plant.make_mpc(), method=RandomSearch(), seed=3, n_steps=5)
    named.fit(table, show_progress=False)
    given.fit(table, show_progress=False)
    np.testing.assert_array_equal(named.theta, given.theta)
    with pytest.raises(UnknownIdError, match=r"option of the learning method RandomSearch: .*'prior'"):
        learner(prior=1.0)
    with pytest.raises(InvalidArgumentError, match="n_steps"):
        learner(n_steps=0)


def test_the_paper_is_a_method_and_the_default_one_without_its_additions() -> None:
    brief: dict[str, Any] = {"value_n_steps": 30, "hidden": (8,), "fit_n_steps": 10, "refit_iterations": 10}
    fits = [OfflineMPCLearner(lq_plant.make_mpc(), method=name, **brief) for name in ("paper", "bellman")]
    fits.append(OfflineMPCLearner(lq_plant.make_mpc(), preset="paper", **brief))
    for one in fits:
        one.fit(lq_plant.random_log(200), show_progress=False)
        np.testing.assert_array_equal(one.theta, fits[0].theta)
        assert one.history == fits[0].history
    assert [one.method.name for one in fits] == ["paper", "bellman", "bellman"]


def test_a_method_without_steps_or_result() -> None:
    @dataclass(frozen=True)
    class Quick(Method):
        loss: float | None = 1.0

        def stages(self) -> dict[str, Stage | Change]:
            return {"at": self.found}

        def found(self, known: Known) -> Known:
            return known if self.loss is None else replace(known, result=FitResult(known.mpc.theta, 1.0, self.loss))

    one = OfflineMPCLearner(lq_plant.make_mpc(), method=Quick())
    assert one.fit(lq_plant.random_log(100), show_progress=False) == [(1, {})]
    np.testing.assert_array_equal(one.theta, lq_plant.make_mpc().theta)
    with pytest.raises(InvalidArgumentError, match="stages: expected one that leaves a result"):
        OfflineMPCLearner(lq_plant.make_mpc(), method=Quick(loss=None)).fit(
            lq_plant.random_log(100), show_progress=False
        )
