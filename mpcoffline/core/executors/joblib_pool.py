"""Jobs through joblib: its own processes, or whatever its active backend is (Dask, Spark, a scheduler)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from .carried import Carried, done_with
from .protocol import EXECUTORS, Executor, Job, Outcome, Result, lost, missing, result_of

_TRIES = 2


@EXECUTORS.register("joblib")
class Joblib(Executor[Job, Result]):
    """Does the jobs in joblib's workers; inside ``joblib.parallel_config(backend=...)`` in those of that backend.

    By default these are processes with one thread each, which joblib keeps for what comes next. Where one dies, joblib
    gives up all of them; what was not done is then done once more by new ones.
    """

    def __init__(self, fn: Callable[[Job], Result], n: int) -> None:
        try:
            import joblib

            try:
                import cloudpickle
            except ImportError:  # joblib before 1.6 has its own
                from joblib.externals import cloudpickle
        except ImportError as error:
            raise missing("joblib", "joblib", error) from error
        self._joblib: Any = joblib
        self._carried, self._n = Carried(fn, cloudpickle.dumps), n

    def run(self, jobs: Mapping[str, Job]) -> Iterator[tuple[str, Result]]:
        """See :class:`~mpcoffline.core.executors.Executor`."""
        from joblib.externals.loky.process_executor import BrokenProcessPool

        waiting, tries = dict(jobs), 0
        while waiting:
            try:
                with self._answers(waiting) as answers:  # the first jobs are handed out in here: it may fail, too
                    for name, outcome in answers:
                        del waiting[name]
                        tries = 0
                        yield name, result_of(name, outcome)
            except BrokenProcessPool as error:
                tries += 1
                if tries == _TRIES:
                    how = f"a process that died, as another before ({len(waiting)} jobs are not done)"
                    raise lost(next(iter(waiting)), how) from error

    @contextmanager
    def _answers(self, jobs: Mapping[str, Job]) -> Iterator[Iterator[tuple[str, Outcome]]]:
        """Names and outcomes, in the order in which jobs end; leaving the block ends what still works."""
        joblib, key, content = self._joblib, self._carried.key, self._carried.content
        active, _ = joblib.parallel.get_active_backend()
        chosen = {}
        if type(active).__name__ == "LokyBackend":
            chosen = {"backend": joblib.parallel.LokyBackend(inner_max_num_threads=1)}
        pool = joblib.Parallel(n_jobs=self._n, return_as="generator_unordered", batch_size=1, **chosen)
        answers = pool(joblib.delayed(_answer)(name, key, content, job) for name, job in jobs.items())
        try:
            yield answers
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # that what still works is ended, as it should
                answers.close()


def _answer(name: str, key: str, content: bytes, job: Any) -> tuple[str, Outcome]:
    return name, done_with(key, content, job)
