"""Jobs in processes: order, threads, errors that name the job, dead workers, Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from mpcoffline.core import parallel
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError


# Spawned workers import functions by module name; this module is not importable there, so jobs are built-ins.
def test_results_come_in_the_order_of_the_jobs_whatever_the_number_of_workers() -> None:
    jobs = list(range(9))
    assert parallel.map(abs, jobs, workers=1) == parallel.map(abs, jobs, workers=3) == jobs


def test_slow_first_job_stays_first() -> None:
    assert parallel.map(time.sleep, {"slow": 0.4, "fast": 0.0}, workers=2) == [None, None]


def test_no_jobs() -> None:
    assert parallel.map(abs, []) == []


def test_none_is_a_job_like_any_other() -> None:
    assert parallel.map(repr, [None, 1], workers=2) == ["None", "1"]


@pytest.mark.parametrize("workers", [1, 2])
def test_done_jobs_are_announced_by_name(workers: int) -> None:
    seen: list[str] = []
    parallel.map(abs, {"a": -1, "b": -2, "c": -3}, workers=workers, on_done=seen.append)
    assert sorted(seen) == ["a", "b", "c"]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_names_the_job_and_carries_the_traceback(workers: int) -> None:
    with pytest.raises(parallel.JobError, match=r"job 'bad'.*ValueError: invalid literal") as caught:
        parallel.map(int, {"good": "1", "bad": "x", "later": "2"}, workers=workers)
    assert "Traceback" in caught.value.traceback


def test_a_process_that_dies_names_its_job() -> None:
    with pytest.raises(parallel.JobError, match=r"job '(dies|too)'.*ended with code 3, as another before"):
        parallel.map(os._exit, {"dies": 3, "too": 3}, workers=2)


def test_a_job_whose_process_dies_is_done_again(tmp_path: Path) -> None:
    """The first process that finds no mark leaves one and dies."""
    mark = tmp_path / "mark"
    once = (
        f"__import__('os').path.exists({str(mark)!r}) or (open({str(mark)!r}, 'w').close(), __import__('os')._exit(9))"
    )
    assert parallel.map(eval, {"a": "1", "dies once": once, "b": "2"}, workers=2) == [1, True, 2]


def test_other_executors_are_unknown() -> None:
    with pytest.raises(UnknownIdError, match="executor: expected one of joblib, processes, ray, serial"):
        parallel.map(abs, [1, 2], workers=2, executor="cluster")


def test_a_result_that_cannot_be_pickled_is_an_error_of_its_job() -> None:
    with pytest.raises(parallel.JobError, match=r"job '[ab]'.*PicklingError"):  # whichever comes first
        parallel.map(eval, {"a": "lambda: 0", "b": "lambda: 0"}, workers=2)


def test_workers_have_one_thread_and_the_parent_keeps_its_own() -> None:
    before = dict(os.environ)
    assert parallel.map(os.getenv, ["OMP_NUM_THREADS", "MKL_NUM_THREADS"], workers=2) == ["1", "1"]
    assert dict(os.environ) == before


@pytest.mark.parametrize("workers", [0, -1])
def test_a_number_of_workers_below_one_is_refused(workers: int) -> None:
    with pytest.raises(InvalidArgumentError, match="workers: expected a positive integer"):
        parallel.map(abs, [1], workers=workers)


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
def test_ctrl_c_ends_all_processes_and_shows_one_traceback(tmp_path: Path) -> None:
    script = tmp_path / "main.py"
    script.write_text(
        textwrap.dedent("""
        import signal
        from mpcoffline.core import parallel
        if __name__ == "__main__":
            # A shell that starts tests in the background leaves them deaf to Ctrl-C.
            signal.signal(signal.SIGINT, signal.default_int_handler)
            # One write a line: print may take two, between which that of the other process comes.
            job = r"[__import__('os').write(1, b'started\\n'), __import__('time').sleep(60.0)]"
            parallel.map(eval, [job, job], workers=2)
        """)
    )
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert [process.stdout.readline() for _ in range(2)] == ["started\n"] * 2
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)  # the pipe closes when the last worker is gone
    assert errors.count("Traceback") == 1
    assert "KeyboardInterrupt" in errors
