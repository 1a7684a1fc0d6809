"""How many threads numpy's matrices get, and work that several threads share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

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


def side_by_side(jobs: Sequence[Callable[[], T]]) -> list[T]:
    """What some jobs give, in their order, done by as many threads as torch has.

    For what waits for numpy's matrices, which let other threads run. Jobs share nothing that one of them changes.
    """
    import torch

    workers = min(torch.get_num_threads(), len(jobs))
    if workers < 2:
        return [job() for job in jobs]
    with ThreadPoolExecutor(workers) as pool:
        return [done.result() for done in [pool.submit(job) for job in jobs]]
