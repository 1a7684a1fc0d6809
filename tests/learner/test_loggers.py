"""The loggers write every metric of every epoch."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import lq_plant
import pytest

from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.learner.callbacks import Callback
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.learner.loggers import CSVLogger, TensorBoardLogger


def fitted_with(logger: Callback) -> OfflineMPCLearner:
    learner = OfflineMPCLearner(lq_plant.make_mpc(), "cost", "paper", hidden=(8,), value_n_steps=40, refit_iterations=5)
    learner.fit(lq_plant.random_log(200), n_steps_per_epoch=20, callbacks=[logger], show_progress=False)
    return learner


def test_a_csv_row_a_metric(tmp_path: Path) -> None:
    learner = fitted_with(CSVLogger(tmp_path / "fit.csv"))
    with (tmp_path / "fit.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    expected = [
        (epoch, total_step, name, value)
        for (epoch, metrics), total_step in zip(learner.history, (20, 40, 41), strict=True)
        for name, value in metrics.items()
    ]
    assert [(int(r["epoch"]), int(r["total_step"]), r["metric"], float(r["value"])) for r in rows] == expected
    fitted_with(CSVLogger(tmp_path / "fit.csv"))
    lines = (tmp_path / "fit.csv").read_text(encoding="utf-8").splitlines()
    assert lines.count(",".join(CSVLogger.COLUMNS)) == 1
    assert len(lines) == 1 + 2 * len(expected)


def test_tensorboard_reads_the_scalars(tmp_path: Path) -> None:
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    learner = fitted_with(TensorBoardLogger(tmp_path))
    events = accumulator.EventAccumulator(str(tmp_path))
    events.Reload()
    assert [event.step for event in events.Scalars("fit/value_loss")] == [20, 40]
    (last,) = events.Scalars("fit/fit_loss")
    assert last.value == pytest.approx(learner.history[-1][1]["fit_loss"], rel=1e-6)


def test_without_tensorboard_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(MPCOfflineError, match=r"pip install \"mpcoffline\[tensorboard\]\""):
        TensorBoardLogger(tmp_path)
