"""Many controllers from the same starts: closed loops spread over processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from mpcoffline import parallel
from mpcoffline.evaluation import Evaluation, evaluate
from mpcoffline.policy import MPCPolicy, SolverStats

# Episodes that step together in one job: enough for a solver that works on batches, few enough to share out.
_EPISODES_PER_JOB = 8


@dataclass(frozen=True)
class ClosedLoop:
    """A controller's episodes, and what its solver did in them."""

    evaluation: Evaluation
    solver_stats: SolverStats


class _Job(NamedTuple):
    policy: Path
    env_id: str
    env_kwargs: dict[str, Any]
    seed: int
    starts: tuple[str, ...]
    discount: float


def evaluate_all(
    policies: Mapping[str, Path],
    env_id: str,
    env_kwargs: Mapping[str, Any],
    starts: Sequence[str],
    *,
    seed: int,
    discount: float,
    workers: int | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> dict[str, ClosedLoop]:
    """Evaluates controllers from the same starts, in several processes.

    Args:
        policies: Saved policies by name.
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.
        starts: Kind of start of each episode; episode i has seed ``seed + i``.
        seed: Seed of the first episode.
        discount: gamma of the discounted cost.
        workers: Number of processes; one a CPU core by default. It does not change the results.
        on_progress: Called with ``(episodes done, episodes in all)``.

    Returns:
        Closed loops by name, in the order of ``policies``.

    Raises:
        JobError: If a closed loop fails; the message names the controller.
    """
    chunks = [range(i, min(i + _EPISODES_PER_JOB, len(starts))) for i in range(0, len(starts), _EPISODES_PER_JOB)]
    jobs = {
        f"{name}, episodes {chunk.start} to {chunk.stop - 1}": _Job(
            path, env_id, dict(env_kwargs), seed + chunk.start, tuple(starts[chunk.start : chunk.stop]), discount
        )
        for name, path in policies.items()
        for chunk in chunks
    }
    done = 0

    def count(name: str) -> None:
        nonlocal done
        done += len(jobs[name].starts)
        if on_progress is not None:
            on_progress(done, len(starts) * len(policies))

    parts = parallel.map(_run, jobs, workers, on_done=count)
    n = len(chunks)
    return {name: _joined(parts[i * n : (i + 1) * n]) for i, name in enumerate(policies)}


def _run(job: _Job) -> ClosedLoop:
    policy = _loaded(job.policy, job.policy.stat().st_mtime_ns)
    policy.solver_stats = SolverStats()
    env = gym.make(job.env_id, **job.env_kwargs)
    options = [{"start": start} for start in job.starts]
    result = evaluate(policy, env, len(options), job.seed, discount=job.discount, options=options)
    return ClosedLoop(result, policy.solver_stats)


@lru_cache(maxsize=4)
def _loaded(path: Path, version: int) -> MPCPolicy:
    """The policy with its solver, built once a process; ``version`` tells rewritten files apart."""
    return MPCPolicy.load(path)


def _joined(parts: Sequence[ClosedLoop]) -> ClosedLoop:
    evaluations, stats = [part.evaluation for part in parts], [part.solver_stats for part in parts]
    evaluation = replace(
        evaluations[0],
        cost=np.concatenate([e.cost for e in evaluations]),
        discounted_cost=np.concatenate([e.discounted_cost for e in evaluations]),
        success=np.concatenate([e.success for e in evaluations]),
        length=np.concatenate([e.length for e in evaluations]),
        states=[states for e in evaluations for states in e.states],
        actions=[actions for e in evaluations for actions in e.actions],
    )
    total = SolverStats(**{f.name: sum(getattr(s, f.name) for s in stats) for f in fields(SolverStats)})
    return ClosedLoop(evaluation, total)
