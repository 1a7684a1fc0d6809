"""The whole study: every task once, on one page; an interrupted one goes on."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from mpcoffline.studies import TaskResult, reproduce, reproduction, run_task

BRIEF = {"value_n_steps": 20, "fit_n_steps": 5, "refit_rows": 500}


@pytest.fixture(autouse=True)
def brief(shipped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reproduction, "run_task", partial(run_task, **BRIEF))


@pytest.mark.slow
def test_an_interrupted_study_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = tmp_path / "paper"
    study = reproduce(output, n_episodes=3, progress=False)
    first = next(study)
    study.close()  # interrupted after the first task
    assert (output / "results.md").read_text().count("| MPC_3 |") == 1
    before = (output / "linear" / "results.json").stat().st_mtime_ns

    again = list(reproduce(output, n_episodes=3, progress=False))
    assert [result.task for result in again] == ["linear", "pendulum", "cartpole"]
    assert again[0] == first
    assert (output / "linear" / "results.json").stat().st_mtime_ns == before
    page = (output / "results.md").read_text()
    assert page.count("| MPC_3 |") == 3
    for result in again:
        assert TaskResult.load(output / result.task / "results.json") == result
        assert f"]({result.task}/figure.png)" in page
        assert (output / result.task / "figure.png").stat().st_size > 10_000

    # Other arguments are another study, and so is a damaged file.
    asked: list[str] = []

    def refusing(task: str, **_: object) -> TaskResult:
        asked.append(task)
        raise KeyboardInterrupt

    monkeypatch.setattr(reproduction, "run_task", refusing)
    with pytest.raises(KeyboardInterrupt):
        next(reproduce(output, n_episodes=3, seed=1, progress=False))
    (output / "linear" / "results.json").write_text("{}")
    with pytest.raises(KeyboardInterrupt):
        next(reproduce(output, n_episodes=3, progress=False))
    assert asked == ["linear", "linear"]
