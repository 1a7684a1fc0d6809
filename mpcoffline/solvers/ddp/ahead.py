"""Compiling solvers beside other work, before they are asked for."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Self

import torch

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC

from . import build
from .codegen import source


class Ahead:
    """Compiles the solvers of MPCs in the background; whoever makes one of them meanwhile waits for it.

    A compiler is a process of its own and takes seconds for a large model: as long as other things are to be done on
    one core, another can compile. What is made is the same, and is found in the cache as any other.

    Args:
        workers: How many compilers at a time; 0 compiles nothing ahead. By default as many as torch has threads, and
            none where it has one: one core has none to spare.
    """

    def __init__(self, workers: int | None = None) -> None:
        if workers is None:
            threads = torch.get_num_threads()
            workers = threads if threads > 1 else 0
        self._pool = ThreadPoolExecutor(workers) if workers > 0 else None
        self._begun: list[str] = []

    @property
    def works(self) -> bool:
        """Whether anything is compiled ahead."""
        return self._pool is not None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Begins none any more; compilers that run come to their end."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
        for text in self._begun:
            build.underway.pop(text, None)

    def start(self, mpcs: Iterable[MPC]) -> None:
        """Has their solvers compiled, in this order; those that ``"ddp"`` does not take are left out."""
        if self._pool is None:
            return
        for mpc in mpcs:
            try:
                text = source(mpc)
            except InvalidArgumentError:
                continue
            if text not in build.underway:
                build.underway[text] = self._pool.submit(build.compiled_here, text)
                self._begun.append(text)
