"""Running jobs in processes of their own: one thread each, results in order, errors with the job's name."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import traceback
import weakref
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, NamedTuple, Self, TypeVar

from .checks import check_integers
from .errors import MPCOfflineError
from .registry import Registry

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


def map(
    fn: Callable[[Job], Result],
    jobs: Mapping[str, Job] | Sequence[Job],
    workers: int | None = None,
    on_done: Callable[[str], None] | None = None,
    executor: str = "processes",
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
        executor: Where several are done, a name in :data:`EXECUTORS`.

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
    chosen = EXECUTORS[executor if n_workers > 1 else "serial"]
    with chosen(fn, n_workers) as pool:
        return pool.map(named, on_done)


class _Outcome(NamedTuple):
    """What a worker answers: a result, or an error as text (exceptions do not always survive pickling)."""

    result: Any
    error: str = ""
    traceback: str = ""


@EXECUTORS.register("serial")
class Serial(Executor[Job, Result]):
    """Does the jobs here, one by one, with one thread of torch."""

    def __init__(self, fn: Callable[[Job], Result], n: int = 1) -> None:
        self._fn = fn

    def run(self, jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """See :class:`Executor`."""
        with _one_torch_thread():
            for name, job in jobs.items():
                try:
                    result = self._fn(job)
                except Exception as error:
                    raise _job_error(name, _described(error), traceback.format_exc()) from error
                yield name, result


@EXECUTORS.register("processes")
class Processes(Executor[Job, Result]):
    """Does the jobs in n processes of their own, each with one thread; they live until :meth:`close`.

    Each process unpickles ``fn`` once. Where one dies, another takes its place and its job, once for each job.
    """

    def __init__(self, fn: Callable[[Job], Result], n: int) -> None:
        self._fn, self._workers = fn, _start_workers(fn, n)
        # Also runs when the object is forgotten, and when the interpreter ends.
        self._stop = weakref.finalize(self, _end_all, self._workers, os.getpid())

    def run(self, jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """Hands each idle worker the next job; see :class:`Executor`."""
        waiting = deque(jobs.items())
        busy: dict[Connection, str] = {}
        lost: set[str] = set()
        complete = False
        try:
            for connection in self._workers:
                _hand_next(connection, waiting, busy)
            while busy:
                for ready in wait(list(busy)):
                    connection = next(c for c in busy if c is ready)
                    name = busy.pop(connection)
                    try:
                        outcome = connection.recv()
                    except (EOFError, OSError) as error:
                        process = self._workers.pop(connection)
                        connection.close()
                        process.join(_JOIN_TIMEOUT)
                        if name in lost:
                            raise _lost(name, process.exitcode) from error
                        lost.add(name)
                        waiting.appendleft((name, jobs[name]))
                        self._workers |= (another := _start_workers(self._fn, 1))
                        (connection,) = another
                    else:
                        if outcome.error:
                            raise _job_error(name, outcome.error, outcome.traceback)
                        yield name, outcome.result
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


def _lost(name: str, code: int | None) -> JobError:
    hint = "In a script, call this under `if __name__ == '__main__':`." if code == 1 else "Out of memory?"
    return _job_error(name, f"a process that ended with code {code}, as another before", hint=hint)


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
