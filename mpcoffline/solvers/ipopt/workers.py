"""Worker processes that share batches: CasADi's threads crash with ipopt."""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

from mpcoffline.core.parallel import Executor, chosen, n_cpus
from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.solvers.plan import Plan

from .program import Found, Programs

_PARTS = 4  # parts of a batch a worker, as some problems take longer than others


class _Part(NamedTuple):
    """Some problems of a batch."""

    x: Array
    theta: Array
    u0: Array | None
    warm_start: Plan


class WorkerPool:
    """Processes that each build the programs of the MPC once and keep them for all batches.

    Args:
        mpc: The problem.
        options: Of the solver.
        n_workers: Number of processes, at most; there are never more than processors or problems.

    Raises:
        InvalidArgumentError: For an MPC of more than plain arithmetic, as it travels as JSON.
    """

    def __init__(self, mpc: MPC, options: Mapping[str, Any], n_workers: int) -> None:
        self._task, self._n_workers = _Task(mpc.to_json(portable=True), dict(options)), n_workers
        self._workers: Executor[_Part, list[Found]] | None = None
        self._n_started, self._process = 0, os.getpid()

    def solve(self, x: Array, theta: Array, u0: Array | None, warm_start: Plan) -> list[Found]:
        """The solutions in the order of the problems."""
        n = len(x)
        parts = min(n, self._n_workers * _PARTS)
        edges = [n * i // parts for i in range(parts + 1)]
        jobs = {
            f"problems {low} to {high - 1}": _Part(
                x[low:high],
                theta if theta.ndim == 1 else theta[low:high],
                None if u0 is None else u0[low:high],
                Plan(warm_start.x[low:high], warm_start.u[low:high]),
            )
            for low, high in pairwise(edges)
        }
        if self._process != os.getpid():  # a fork: the workers are its parent's
            self._workers, self._process = None, os.getpid()
        wanted = min(self._n_workers, n, n_cpus())
        if self._workers is None or wanted > self._n_started:
            self.close()
            self._workers, self._n_started = chosen()(self._task, wanted), wanted
        try:
            found = self._workers.map(jobs)
        except BaseException:  # Ctrl-C, a worker that died: no process stays behind, the next batch starts new ones
            self.close()
            raise
        return [one for part in found for one in part]

    def close(self) -> None:
        """Ends the processes."""
        if self._workers is not None:
            self._workers.close()
            self._workers, self._n_started = None, 0


class _Task:
    """What a worker does with a part; unpickled once a process, it keeps its programs."""

    def __init__(self, document: dict[str, Any], options: dict[str, Any]) -> None:
        self._document, self._options = document, options
        self._programs: Programs | None = None

    def __call__(self, part: _Part) -> list[Found]:
        if self._programs is None:
            self._programs = Programs(MPC.from_json(self._document), self._options)
        return self._programs.solve(*part)
