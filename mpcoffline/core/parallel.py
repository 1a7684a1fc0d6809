"""Running jobs in processes of their own: one thread each, results in order, errors with the job's name."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import traceback
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, NamedTuple, Self, TypeVar

from .checks import check_integers
from .errors import MPCOfflineError

Job = TypeVar("Job")
Result = TypeVar("Result")

# Libraries read these when they load; several processes with several threads each only get in each other's way.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_JOIN_TIMEOUT = 5.0


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


def map(
    fn: Callable[[Job], Result],
    jobs: Mapping[str, Job] | Sequence[Job],
    workers: int | None = None,
    on_done: Callable[[str], None] | None = None,
) -> list[Result]:
    """Applies a function to every job, several at a time, each in a process with one thread.

    The processes are spawned, not forked: nothing of this process but ``fn`` and the job reaches them (both are
    pickled, so ``fn`` must be a function of a module). The results do not depend on the number of workers. Ctrl-C
    ends all workers.

    Args:
        fn: What to do with a job.
        jobs: The jobs; those of a mapping are called by their keys in error messages, others by their numbers.
        workers: Number of processes; the number of CPU cores by default. One runs the jobs here, one by one.
        on_done: Called here with a job's name whenever one is done.

    Returns:
        The results in the order of the jobs.

    Raises:
        InvalidArgumentError: For ``workers`` below 1.
        JobError: If a job raises or its process dies; the others are stopped.
    """
    named = dict(jobs) if isinstance(jobs, Mapping) else {str(i): job for i, job in enumerate(jobs)}
    if workers is not None:
        check_integers(1, workers=workers)
    n_workers = min(n_cpus() if workers is None else workers, len(named))
    finished = _run_here(fn, named) if n_workers <= 1 else _run_in_processes(fn, named, n_workers)
    results: dict[str, Result] = {}
    for name, result in finished:
        results[name] = result
        if on_done is not None:
            on_done(name)
    return [results[name] for name in named]


class _Outcome(NamedTuple):
    """What a worker answers: a result, or an error as text (exceptions do not always survive pickling)."""

    result: Any
    error: str = ""
    traceback: str = ""


def _run_here(fn: Callable[[Job], Result], jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
    with _one_torch_thread():
        for name, job in jobs.items():
            try:
                result = fn(job)
            except Exception as error:
                raise _job_error(name, _described(error), traceback.format_exc()) from error
            yield name, result


def _run_in_processes(
    fn: Callable[[Job], Result], jobs: Mapping[str, Job], n_workers: int
) -> Iterator[tuple[str, Result]]:
    with Workers(fn, n_workers) as workers:
        yield from workers.run(jobs)


class Workers(Generic[Job, Result]):
    """Processes that apply a function to jobs, round after round; :func:`map` is one round.

    Each process unpickles ``fn`` once: a callable object can keep what is expensive to build between jobs.

    Args:
        fn: What to do with a job; it is pickled.
        n: Number of processes.
    """

    def __init__(self, fn: Callable[[Job], Result], n: int) -> None:
        self._workers = _start_workers(fn, n)
        # Also runs when the object is forgotten, and when the interpreter ends.
        self._stop = weakref.finalize(self, _end_all, self._workers, os.getpid())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self, jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """Hands each idle worker the next job; yields names and results as they come.

        An error, Ctrl-C, or a consumer that stops early ends all workers.

        Raises:
            JobError: If a job raises or its process dies.
        """
        waiting = deque(jobs.items())
        busy: dict[Connection, str] = {}
        complete = False
        try:
            for connection in self._workers:
                _hand_next(connection, waiting, busy)
            while busy:
                for ready in wait(list(busy)):
                    connection = next(c for c in busy if c is ready)
                    name = busy.pop(connection)
                    yield name, _received(name, connection, self._workers[connection])
                    _hand_next(connection, waiting, busy)
            complete = True
        finally:
            if not complete:
                _stop(self._workers.values())

    def close(self) -> None:
        """Ends the processes: idle ones in good order, others at once."""
        self._stop()


def _end_all(workers: dict[Connection, multiprocessing.context.SpawnProcess], owner: int) -> None:
    if os.getpid() != owner:  # a fork of the process that started them, and still uses them
        return
    for connection in workers:
        with suppress(OSError):  # it may have died
            connection.send(None)
    for process in workers.values():
        process.join(_JOIN_TIMEOUT)
    _stop(workers.values())
    for connection in workers:
        connection.close()


def _start_workers(fn: Callable[[Any], Any], n_workers: int) -> dict[Connection, multiprocessing.context.SpawnProcess]:
    context = multiprocessing.get_context("spawn")
    workers: dict[Connection, multiprocessing.context.SpawnProcess] = {}
    with _environment_of_workers():
        for _ in range(n_workers):
            here, there = context.Pipe()
            process = context.Process(target=_work, args=(fn, there), daemon=True)
            process.start()
            there.close()  # so that the worker's death is the end of the pipe
            workers[here] = process
    return workers


def _hand_next(connection: Connection, waiting: deque[tuple[str, Any]], busy: dict[Connection, str]) -> None:
    if waiting:
        name, job = waiting.popleft()
        busy[connection] = name
        with suppress(BrokenPipeError):  # a worker that has died is noticed when its answer is read
            connection.send((job,))


def _received(name: str, connection: Connection, process: multiprocessing.context.SpawnProcess) -> Any:
    try:
        outcome = connection.recv()
    except (EOFError, OSError) as error:
        process.join(_JOIN_TIMEOUT)
        code = process.exitcode
        raise _job_error(
            name,
            f"a process that ended with code {code}",
            hint="In a script, call this under `if __name__ == '__main__':`." if code == 1 else "Out of memory?",
        ) from error
    if outcome.error:
        raise _job_error(name, outcome.error, outcome.traceback)
    return outcome.result


def _work(fn: Callable[[Any], Any], connection: Connection) -> None:
    """The life of a worker: answers jobs until None or the end of the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # see _environment_of_workers; for systems without signal masks
    with suppress(EOFError, OSError), _one_torch_thread():
        while (message := connection.recv()) is not None:
            try:
                outcome = _Outcome(fn(message[0]))
            except Exception as error:
                outcome = _Outcome(None, _described(error), traceback.format_exc())
            try:
                connection.send(outcome)
            except (pickle.PicklingError, TypeError, AttributeError, ValueError) as error:  # cannot be pickled
                connection.send(_Outcome(None, _described(error), traceback.format_exc()))


def _stop(processes: Iterable[multiprocessing.context.SpawnProcess]) -> None:
    for process in processes:
        if process.is_alive():
            process.terminate()
    for process in processes:
        process.join(_JOIN_TIMEOUT)
        if process.is_alive():
            process.kill()


def _job_error(name: str, actual: str, text: str = "", hint: str = "") -> JobError:
    error = JobError(f"job {name!r}", expected="a job without error", actual=actual.rstrip("."), hint=hint)
    error.traceback = text
    if text:
        error.add_note(text)
    return error


def _described(error: Exception) -> str:
    return str(error) if isinstance(error, MPCOfflineError) else f"{type(error).__name__}: {error}"


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Children that start inside load their numerical libraries with one thread, and never see Ctrl-C.

    Ctrl-C reaches the whole process group, and the parent ends its workers in good order; a blocked signal stays
    blocked in a child from its first instruction on, also while it imports.
    """
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    if hasattr(signal, "pthread_sigmask"):
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """One thread in torch, where torch is loaded; the environment variables see to it where it is not yet."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
