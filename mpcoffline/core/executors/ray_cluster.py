"""Jobs on a Ray cluster: the one that ``RAY_ADDRESS`` names, or one on this machine for as long as it takes."""

from __future__ import annotations

import logging
import os
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any

from mpcoffline.core.errors import InvalidArgumentError

from .carried import Carried, done_with
from .protocol import EXECUTORS, THREAD_VARIABLES, Executor, Job, Outcome, Result, job_error, lost, missing, result_of


@EXECUTORS.register("ray")
class Ray(Executor[Job, Result]):
    """Does the jobs in n Ray actors, each with one thread and one of the cluster's CPUs; they live until :meth:`close`.

    Where one is lost, with its process or its whole machine, another takes its place and its job, once for each job.
    The machines of a cluster need this package, as a job file's ``runtime_env`` or an image can bring it.
    """

    def __init__(self, fn: Callable[[Job], Result], n: int) -> None:
        try:
            import ray
        except ImportError as error:
            raise missing("ray", "ray", error) from error
        self._ray: Any = ray
        started = not ray.is_initialized()
        if started:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            local = {} if os.environ.get("RAY_ADDRESS") else {"num_cpus": n, "include_dashboard": False}
            try:
                ray.init(log_to_driver=False, logging_level=logging.ERROR, **local)
            except Exception as error:  # which it raises of many kinds, some of none of its own
                where = os.environ.get("RAY_ADDRESS") or "one on this machine"
                raise InvalidArgumentError(
                    "executor",
                    expected=f"a Ray cluster: {where}",
                    actual=f"{type(error).__name__}: {error}"[:500],
                    hint="`ray status` says whether there is one; RAY_ADDRESS names it.",
                ) from error
        carried = Carried(fn, ray.cloudpickle.dumps)
        self._key, self._content = carried.key, ray.put(carried.content)
        self._kind = ray.remote(_Worker).options(
            num_cpus=1, runtime_env={"env_vars": dict.fromkeys(THREAD_VARIABLES, "1")}
        )
        self._actors = [self._actor() for _ in range(n)]
        self._stop = weakref.finalize(self, _end_all, ray, self._actors, started)

    def run(self, jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """Hands each idle actor the next job; see :class:`~mpcoffline.core.executors.Executor`."""
        ray, waiting = self._ray, deque(jobs.items())
        idle, busy = list(self._actors), dict[Any, tuple[str, Any]]()
        again: set[str] = set()
        complete = False
        try:
            while waiting or busy:
                while waiting and idle:
                    name, job = waiting.popleft()
                    actor = idle.pop()
                    busy[actor.work.remote(job)] = name, actor
                (ready, *_), _ = ray.wait(list(busy), num_returns=1)
                name, actor = busy.pop(ready)
                try:
                    outcome = ray.get(ready)
                except ray.exceptions.RayActorError as error:
                    if name in again:
                        raise lost(name, "a Ray actor that died, as another before") from error
                    again.add(name)
                    waiting.appendleft((name, jobs[name]))
                    self._actors.remove(actor)
                    self._actors.append(actor := self._actor())
                except ray.exceptions.RayError as error:
                    hint = "Is the cluster still there? What was done before is kept by whoever asked for it."
                    raise job_error(name, f"{type(error).__name__}: {error}"[:500], hint=hint) from error
                else:
                    yield name, result_of(name, outcome)
                idle.append(actor)
            complete = True
        finally:
            if not complete:
                self.close()

    def close(self) -> None:
        """Ends the actors, and the cluster if it was started for them."""
        self._stop()

    def _actor(self) -> Any:
        return self._kind.remote(self._key, self._content)


class _Worker:
    """What an actor is."""

    def __init__(self, key: str, content: bytes) -> None:
        self._key, self._content = key, content

    def work(self, job: Any) -> Outcome:
        """What comes of a job."""
        return done_with(self._key, self._content, job)


def _end_all(ray: Any, actors: list[Any], started: bool) -> None:
    if ray.is_initialized():
        for actor in actors:
            with suppress(Exception):  # it may have died, and its cluster, too
                ray.kill(actor)
        if started:
            ray.shutdown()
