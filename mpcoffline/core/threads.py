"""How many threads numpy's matrices get."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """One thread for numpy's BLAS, in the whole process, until the block ends; also as a decorator.

    Matrices are small here and products of them many: on two cores, threads that wait for each other took twice as long
    as one. Solvers have threads of their own, and so has torch.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield
