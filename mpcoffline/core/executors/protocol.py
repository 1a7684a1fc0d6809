"""What an executor is: a function applied to jobs, somewhere; and what all of them share."""

from __future__ import annotations

import os
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Generic, NamedTuple, Self, TypeVar

from mpcoffline.core.errors import InvalidArgumentError, MPCOfflineError
from mpcoffline.core.registry import Registry
from mpcoffline.core.threads import one_torch_thread

Job = TypeVar("Job")
Result = TypeVar("Result")

# Libraries read these when they load; several processes with several threads each only get in each other's way.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_AT_WORK: list[bool] = []  # not empty in a process that works for another one


class JobError(MPCOfflineError):
    """A job raised an error, or its process died; the message names the job.

    Attributes:
        traceback: The traceback in the process that ran the job, as text; empty if the process died.
    """

    traceback: str = ""


def n_cpus() -> int:
    """Number of CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Executor(ABC, Generic[Job, Result]):
    """Applies a function to jobs, round after round, somewhere: here, in processes, on other machines.

    Results do not depend on where. An own one subclasses this, and is registered in :data:`EXECUTORS`.

    Args:
        fn: What to do with a job; where it travels, it is pickled once, and can keep what is expensive to build.
        n: How many jobs may be worked on at a time.
    """

    @abstractmethod
    def __init__(self, fn: Callable[[Job], Result], n: int) -> None: ...

    @abstractmethod
    def run(self, jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """Yields names and results as they come.

        An error, Ctrl-C, or a consumer that stops early ends all work. A job whose worker is lost is given to another.

        Raises:
            JobError: If a job raises, or loses its workers again and again.
        """

    def map(self, jobs: Mapping[str, Job], on_done: Callable[[str], None] | None = None) -> list[Result]:
        """The results in the order of the jobs.

        Args:
            jobs: The jobs by name.
            on_done: Called here with a job's name whenever one is done.

        Raises:
            JobError: As :meth:`run`.
        """
        results: dict[str, Result] = {}
        for name, result in self.run(jobs):
            results[name] = result
            if on_done is not None:
                on_done(name)
        return [results[name] for name in jobs]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Lets go of what works."""


#: Where jobs can be done, by name.
EXECUTORS: Registry[type[Executor[Any, Any]]] = Registry("executor", Executor)


class Outcome(NamedTuple):
    """What a worker answers: a result, or an error as text (exceptions do not always survive pickling)."""

    result: Any
    error: str = ""
    traceback: str = ""


def outcome_of(fn: Callable[[Any], Any], job: Any) -> Outcome:
    """What comes of a job, done here."""
    try:
        return Outcome(fn(job))
    except Exception as error:
        return Outcome(None, described(error), traceback.format_exc())


def result_of(name: str, outcome: Outcome) -> Any:
    """The result in an answer.

    Raises:
        JobError: If it is an error.
    """
    if outcome.error:
        raise job_error(name, outcome.error, outcome.traceback)
    return outcome.result


def lost(name: str, how: str, hint: str = "Out of memory?") -> JobError:
    """The error of a job that has lost its workers."""
    return job_error(name, how, hint=hint)


def missing(package: str, extra: str, error: ImportError) -> InvalidArgumentError:
    """The error of an executor whose package is not installed."""
    hint = f'pip install "mpcoffline[{extra}]"'
    return InvalidArgumentError("executor", expected=f"the package {package}", actual=str(error), hint=hint)


def job_error(name: str, actual: str, text: str = "", hint: str = "") -> JobError:
    """The error of a job, with the traceback of where it was done."""
    error = JobError(f"job {name!r}", expected="a job without error", actual=actual.rstrip("."), hint=hint)
    error.traceback = text
    if text:
        error.add_note(text)
    return error


def described(error: Exception) -> str:
    """An error as text; one of ours says all itself."""
    return str(error) if isinstance(error, MPCOfflineError) else f"{type(error).__name__}: {error}"


@contextmanager
def at_work() -> Iterator[None]:
    """One thread, and no further processes: what a worker does is done in it alone."""
    _AT_WORK.append(True)
    try:
        with one_torch_thread():
            yield
    finally:
        _AT_WORK.pop()


def is_at_work() -> bool:
    """Whether this process works for another one."""
    return bool(_AT_WORK)
