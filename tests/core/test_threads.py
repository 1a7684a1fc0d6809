"""BLAS has one thread inside, and what it had before outside; jobs side by side give what they give in turns."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from mpcoffline.core.threads import Crew, at_leisure, one_blas_thread, one_torch_thread, side_by_side


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def blas_threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


def test_one_inside_and_as_before_outside() -> None:
    _ = np.eye(2) @ np.eye(2)
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        with one_blas_thread():
            assert blas_threads() <= {1}
        assert blas_threads() == before

        @one_blas_thread()
        def inside() -> set[int]:
            return blas_threads()

        assert inside() <= {1}
        assert blas_threads() == before


@pytest.mark.usefixtures("two_threads")
def test_two_jobs_are_at_work_at_once_and_answer_in_their_order() -> None:
    both = threading.Barrier(2, timeout=30.0)  # which one job alone would wait for in vain

    def job(number: int) -> int:
        both.wait()
        return number

    assert side_by_side([partial(job, number) for number in range(4)]) == [0, 1, 2, 3]
    assert side_by_side([]) == []


@pytest.mark.usefixtures("two_threads")
def test_what_a_job_raises_is_raised() -> None:
    def broken() -> int:
        raise ValueError("of the job")

    with pytest.raises(ValueError, match="of the job"):
        side_by_side([lambda: 1, broken])


def test_whoever_asks_takes_part() -> None:
    """Were it to wait, the kernel would find one core free for two threads."""
    both = threading.Barrier(2, timeout=30.0)

    def job() -> int:
        both.wait()
        return threading.get_ident()

    done = side_by_side([job] * 4, workers=2)
    assert threading.get_ident() in done
    assert len(set(done)) == 2
    assert set(side_by_side([threading.get_ident] * 3, workers=1)) == {threading.get_ident()}


@pytest.mark.usefixtures("two_threads")
def test_torch_has_one_thread_inside_and_as_many_as_before_outside() -> None:
    with one_torch_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2
    assert side_by_side([torch.get_num_threads] * 3) == [1, 1, 1]
    assert list(at_leisure([torch.get_num_threads] * 3)) == [1, 1, 1]
    assert list(at_leisure([torch.get_num_threads])) == [1]
    assert torch.get_num_threads() == 2


def test_a_crew_is_as_large_as_the_last_batch_was_work(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("mpcoffline.core.threads.time.perf_counter", lambda: now[0])
    crew = Crew()

    def shares(problem_takes: float, n_problems: int) -> int:
        def work(number: int, count: int) -> tuple[int, int]:
            if number == 0:  # all are at work at the same time
                now[0] += problem_takes * n_problems / count
            return number, count

        done = crew.share(work, n_problems, most=4)
        assert done == [(number, len(done)) for number in range(len(done))]
        return len(done)

    assert shares(1.0, 100) == 4  # nothing is known yet
    assert shares(1e-6, 100) == 4  # as the last one took long
    assert [shares(1e-6, 100), shares(1e-6, 100)] == [1, 1]
    assert shares(1e-6, 5_000) == 2  # 5 ms
    assert shares(1e-6, 1_000_000) == 4
