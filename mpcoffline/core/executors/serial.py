"""Jobs one by one, in this process."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Mapping

from mpcoffline.core.threads import one_torch_thread

from .protocol import EXECUTORS, Executor, Job, Result, described, job_error


@EXECUTORS.register("serial")
class Serial(Executor[Job, Result]):
    """Does the jobs here, one by one, with one thread of torch."""

    def __init__(self, fn: Callable[[Job], Result], n: int = 1) -> None:
        self._fn = fn

    def run(self, jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """See :class:`Executor`."""
        with one_torch_thread():
            for name, job in jobs.items():
                try:
                    result = self._fn(job)
                except Exception as error:
                    raise job_error(name, described(error), traceback.format_exc()) from error
                yield name, result
