"""BLAS has one thread inside, and what it had before outside."""

from __future__ import annotations

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from mpcoffline.core.threads import one_blas_thread


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
