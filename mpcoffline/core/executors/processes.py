"""Jobs in processes of their own, on this machine."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import traceback
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any

from .protocol import (
    EXECUTORS,
    THREAD_VARIABLES,
    Executor,
    Job,
    JobError,
    Outcome,
    Result,
    at_work,
    described,
    job_error,
    outcome_of,
    result_of,
)

_JOIN_TIMEOUT = 5.0


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
                        yield name, result_of(name, outcome)
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
    return job_error(name, f"a process that ended with code {code}, as another before", hint=hint)


def _work(fn: Callable[[Any], Any], connection: Connection) -> None:
    """The life of a worker: answers jobs until None or the end of the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # see _environment_of_workers; for systems without signal masks
    with suppress(EOFError, OSError), at_work():
        while (message := connection.recv()) is not None:
            outcome = outcome_of(fn, message[0])
            try:
                connection.send(outcome)
            except (pickle.PicklingError, TypeError, AttributeError, ValueError) as error:  # cannot be pickled
                connection.send(Outcome(None, described(error), traceback.format_exc()))


def _stop(processes: Iterable[multiprocessing.context.SpawnProcess]) -> None:
    for process in processes:
        if process.is_alive():
            process.terminate()
    for process in processes:
        process.join(_JOIN_TIMEOUT)
        if process.is_alive():
            process.kill()


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Children that start inside load their numerical libraries with one thread, and never see Ctrl-C.

    Ctrl-C reaches the whole process group, and the parent ends its workers in good order; a blocked signal stays
    blocked in a child from its first instruction on, also while it imports.
    """
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
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
