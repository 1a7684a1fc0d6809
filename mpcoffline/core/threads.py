"""How many threads numpy's matrices get, and work that several threads share."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

_TO_BEGIN = 1e-3  # s that the begin and the end of other threads take
_WORTH = 3e-3  # s of work, for which one more thread is begun

T = TypeVar("T")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """One thread for numpy's BLAS, in the whole process, until the block ends; also as a decorator.

    Matrices are small here and products of them many: on two cores, threads that wait for each other took twice as long
    as one. Solvers have threads of their own, and so has torch.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """One thread in torch, where torch is loaded, until the block ends; also as a decorator.

    For jobs beside others, and for steps of a millisecond or two: a second thread gains a seventh of them, and where
    another process has its core, as a compiler, each step waits for it: ten times as long was seen.
    """
    torch = sys.modules.get("torch")
    if torch is None:  # the environment variables see to it
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def at_leisure(jobs: Sequence[Callable[[], T]]) -> Iterator[T]:
    """What some jobs give, one after the other, of which the later ones may not be asked for.

    With one thread (of torch), each is done when it is asked for; with several, :func:`side_by_side`. Either way a job
    has one.
    """
    import torch

    if min(torch.get_num_threads(), len(jobs)) > 1:
        yield from side_by_side(jobs)
    else:
        for job in jobs:
            yield one_torch_thread()(job)()


def side_by_side(jobs: Sequence[Callable[[], T]], workers: int | None = None) -> list[T]:
    """What some jobs give, in their order, done by several threads, of which the one that asks is one.

    For what waits for numpy's matrices or for C, which let other threads run. Jobs share nothing that one of them
    changes. Were all done by new threads while this one waits, two of them would often end up on one core: the kernel
    places new threads where there is room, and this one's core has none yet.

    Args:
        jobs: What to do; whoever is free takes the next one.
        workers: How many threads; by default as many as torch has, which then has one in each.

    Returns:
        One a job. What a job raises is raised, once all threads have come to their end.
    """
    if workers is None:
        import torch

        workers = torch.get_num_threads()
        with one_torch_thread():
            return side_by_side(jobs, workers)
    workers = min(workers, len(jobs))
    if workers < 2:
        return [job() for job in jobs]
    waiting, done = iter(range(len(jobs))), dict[int, T]()

    def work() -> None:
        for i in waiting:  # a range's iterator is C: no two threads are given the same
            done[i] = jobs[i]()

    with ThreadPoolExecutor(workers - 1) as pool:
        others = [pool.submit(work) for _ in range(workers - 1)]
        work()
        for other in others:
            other.result()
    return [done[i] for i in range(len(jobs))]


class Crew:
    """Threads that share batches of like problems: as many as pay, by how long a problem of the last batch took."""

    def __init__(self) -> None:
        self._pace = math.inf  # s of a thread for a problem

    def share(self, work: Callable[[int, int], T], n_problems: int, most: int) -> list[T]:
        """What each thread gives.

        Args:
            work: Does one of so many shares: is given its number and how many there are.
            n_problems: Their number, at least 1.
            most: Threads at most.
        """
        crew, begun = int(min(most, 1.0 + self._pace * n_problems / _WORTH)), time.perf_counter()
        found = side_by_side([partial(work, first, crew) for first in range(crew)], crew)
        lasted = time.perf_counter() - begun - (_TO_BEGIN if crew > 1 else 0.0)
        self._pace = max(lasted, 0.0) * crew / n_problems
        return found
