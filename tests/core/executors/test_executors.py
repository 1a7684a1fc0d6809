"""Every executor on this machine: the same results, errors that name the job, workers that die, consumers that stop."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpcoffline.core import parallel
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError
from mpcoffline.core.executors import EXECUTORS, is_at_work

KINDS = [
    "processes",
    pytest.param("joblib", marks=pytest.mark.skipif(find_spec("joblib") is None, reason="needs joblib")),
    pytest.param("ray", marks=pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")),
]


@pytest.fixture(scope="module", params=KINDS)
def kind(request: pytest.FixtureRequest) -> Iterator[str]:
    """The name of an executor; for Ray, beside a cluster of two CPUs here."""
    name = str(request.param)
    if name == "ray":
        ray = pytest.importorskip("ray")
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield name
    if name == "ray":
        ray.shutdown()


# What travels is pickled by name, and this module is not importable there: functions are built-ins or numpy's.
def test_results_are_those_of_one_process_to_the_bit(kind: str) -> None:
    rng = np.random.default_rng(0)
    jobs = [a @ a.T for a in rng.normal(size=(5, 30, 30))]
    found = parallel.map(np.linalg.cholesky, jobs, workers=2, executor=kind)
    for one, other in zip(found, parallel.map(np.linalg.cholesky, jobs, workers=1), strict=True):
        np.testing.assert_array_equal(one, other)


def test_order_names_and_errors(kind: str) -> None:
    seen: list[str] = []
    jobs = {"a": -1, "b": -2, "c": -3}
    assert parallel.map(abs, jobs, 2, on_done=seen.append, executor=kind) == [1, 2, 3]
    assert sorted(seen) == ["a", "b", "c"]
    with pytest.raises(parallel.JobError, match=r"job 'bad'.*ValueError: invalid literal") as caught:
        parallel.map(int, {"good": "1", "bad": "x"}, 2, executor=kind)
    assert "Traceback" in caught.value.traceback


def test_a_lost_worker_costs_no_job_and_a_deadly_job_is_named(kind: str, tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    once = (
        f"__import__('os').path.exists({str(mark)!r}) or (open({str(mark)!r}, 'w').close(), __import__('os')._exit(9))"
    )
    assert parallel.map(eval, {"a": "1", "dies once": once, "b": "2"}, 2, executor=kind) == [1, True, 2]
    with pytest.raises(parallel.JobError, match=r"job '(dies|too)'.*as another before"):
        parallel.map(os._exit, {"dies": 3, "too": 3}, 2, executor=kind)


def test_a_worker_that_dies_while_jobs_are_handed_out_costs_no_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Joblib tells of a worker that the first job has lost where it hands out the second: that waits for it here."""
    joblib = pytest.importorskip("joblib")
    submit, calls = joblib.parallel.LokyBackend.submit, []

    def late(self: Any, *args: Any, **kwargs: Any) -> Any:
        calls.append(self)
        until = time.monotonic() + 30.0
        while len(calls) == 2 and self._workers._flags.broken is None and time.monotonic() < until:
            time.sleep(0.01)
        return submit(self, *args, **kwargs)

    mark = str(tmp_path / "mark")
    once = f"__import__('os').path.exists({mark!r}) or (open({mark!r}, 'w').close(), __import__('os')._exit(9))"
    monkeypatch.setattr(joblib.parallel.LokyBackend, "submit", late)
    assert parallel.map(eval, {"dies once": once, "b": "2", "c": "3"}, 2, executor="joblib") == [True, 2, 3]
    assert len(calls) == 5


def test_workers_have_one_thread_and_no_workers(kind: str) -> None:
    assert parallel.map(os.getenv, ["OMP_NUM_THREADS", "MKL_NUM_THREADS"], 2, executor=kind) == ["1", "1"]
    asked = "__import__('mpcoffline.core.executors', fromlist=['_']).is_at_work()"
    assert parallel.map(eval, [asked, asked], 2, executor=kind) == [True, True]
    nested = "__import__('mpcoffline.core.parallel', fromlist=['_']).map(abs, [-1, -2], 2)"
    assert parallel.map(eval, [nested, nested], 2, executor=kind) == [[1, 2], [1, 2]]
    assert not is_at_work()


def test_a_consumer_that_stops_ends_all_work(kind: str, tmp_path: Path) -> None:
    """The second job of each worker would leave a mark."""
    job = f"__import__('time').sleep(1.0) or open({str(tmp_path)!r} + '/' + str({{}}), 'w').close()"
    jobs = {"first": "1"} | {str(i): job.format(i) for i in range(4)}
    with EXECUTORS[kind](eval, 2) as pool:
        running = pool.run(jobs)
        next(running)
        running.close()  # type: ignore[attr-defined]
    time.sleep(2.5)
    assert len(list(tmp_path.iterdir())) <= 1


def test_functions_and_what_they_keep_live_as_long_as_the_executor(kind: str) -> None:
    with EXECUTORS[kind](partial(pow, 2), 2) as pool:
        assert pool.map({"a": 1, "b": 2}) == [2, 4]
        assert pool.map({"c": 3}) == [8]


def test_the_setting_says_where(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[str] = []

    class Told(EXECUTORS[kind]):  # type: ignore[misc]
        def __init__(self, fn: Any, n: int) -> None:
            used.append(kind)
            super().__init__(fn, n)

    monkeypatch.setattr(EXECUTORS, "_things", dict(EXECUTORS.items()) | {"told": Told})
    monkeypatch.setenv(parallel.SETTING, "told")
    assert parallel.map(abs, [-1, -2], 2) == [1, 2]
    assert used == [kind]
    assert parallel.map(abs, [-1], 2, executor="processes") == [1]
    assert used == [kind]
    monkeypatch.setenv(parallel.SETTING, "tolt")
    with pytest.raises(UnknownIdError, match="Did you mean 'told'"):
        parallel.map(abs, [-1, -2], 2)


@pytest.mark.parametrize("name", ["joblib", "ray"])
def test_without_the_package_it_says_what_to_install(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, name, None)
    with pytest.raises(InvalidArgumentError, match=rf"mpcoffline\[{name}\]"):
        parallel.map(abs, [-1, -2], 2, executor=name)
