"""Running jobs several at a time: one thread each, results in order, errors with the job's name."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from .checks import check_integers
from .executors import EXECUTORS, Executor, JobError, is_at_work, n_cpus
from .executors.protocol import Job, Result

__all__ = ["EXECUTORS", "SETTING", "Executor", "JobError", "chosen", "map", "n_cpus"]

SETTING = "MPCOFFLINE_EXECUTOR"  # an environment variable


def chosen(name: str | None = None, default: str = "processes") -> type[Executor[Any, Any]]:
    """Where jobs are done: where is asked for, else where ``$MPCOFFLINE_EXECUTOR`` says, else by default.

    What a worker does is done in it, whatever anybody asks for: workers have none of their own.

    Args:
        name: A name in :data:`EXECUTORS`.
        default: Likewise.

    Raises:
        UnknownIdError: For an unknown executor.
    """
    kind = EXECUTORS[name or os.environ.get(SETTING, "").strip() or default]
    return EXECUTORS["serial"] if is_at_work() else kind


def map(
    fn: Callable[[Job], Result],
    jobs: Mapping[str, Job] | Sequence[Job],
    workers: int | None = None,
    on_done: Callable[[str], None] | None = None,
    executor: str | None = None,
) -> list[Result]:
    """Applies a function to every job, several at a time, each in a process with one thread.

    The processes are spawned, not forked: nothing of this process but ``fn`` and the job reaches them (both are
    pickled, so ``fn`` must be a function of a module). The results do not depend on the number of workers. Ctrl-C
    ends all workers. A job whose process dies is done once more.

    Args:
        fn: What to do with a job.
        jobs: The jobs; those of a mapping are called by their keys in error messages, others by their numbers.
        workers: Number of processes; the number of CPU cores by default. One runs the jobs here, one by one.
        on_done: Called here with a job's name whenever one is done.
        executor: Where several are done, a name in :data:`EXECUTORS`; by default what :func:`chosen` says.

    Returns:
        The results in the order of the jobs.

    Raises:
        InvalidArgumentError: For ``workers`` below 1.
        UnknownIdError: For an unknown executor.
        JobError: If a job raises or its process dies twice; the others are stopped.
    """
    named = dict(jobs) if isinstance(jobs, Mapping) else {str(i): job for i, job in enumerate(jobs)}
    if workers is not None:
        check_integers(1, workers=workers)
    n_workers = min(n_cpus() if workers is None else workers, len(named))
    kind: type[Executor[Job, Result]] = chosen(executor if n_workers > 1 else "serial")
    with kind(fn, n_workers) as pool:
        return pool.map(named, on_done)
