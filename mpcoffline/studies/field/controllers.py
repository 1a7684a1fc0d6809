"""How each controller of the field comes from a log, and what is measured of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from mpcoffline.control.evaluation import Predictor
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.identifying import identify
from mpcoffline.learner.effort import core_seconds
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.learning.bellman.equation import BellmanProblem
from mpcoffline.mpc import MPC
from mpcoffline.studies.plant_files import Loops
from mpcoffline.studies.zoo import Found, noted, short_text

from .arenas import Arena, arena_of
from .jobs import ALGORITHMS, NAN, SEARCHED, Job, Outcome
from .peers import PeerError, Peers, settings_to_try, time_mpcrl, train

_TIMED = 100  # actions that are timed
_TRANSITIONS = 20  # that mpcrl is timed on
_ROWS = 4_096  # of a part of a pass over the log
_OWN = ("train_s", "regressions_s", "verdict_s", "pass_s", "file_kb", "verdict")  # of :class:`Made`


@dataclass(frozen=True)
class Made:
    """A controller.

    Attributes:
        policy: What acts.
        train_s: As in :class:`~mpcoffline.studies.field.jobs.Outcome`; so are the others.
        file_kb: Size of its file.
        verdict: What ours says of itself.
        said: What else is to be known.
    """

    policy: Predictor
    train_s: float = NAN
    file_kb: float = NAN
    verdict: str = ""
    said: str = ""
    regressions_s: float = NAN
    verdict_s: float = NAN
    pass_s: float = NAN


def run_job(job: Job, peers: Peers | None = None) -> Outcome:
    """Makes a controller from its log and lets it act; an error becomes part of what is found.

    Args:
        job: The job.
        peers: Where other packages live; needed for their algorithms alone.
    """
    found: Found = {}
    noted(found, lambda: _fill(found, job, peers))
    return Outcome(*job.key, **found)


def _fill(found: Found, job: Job, peers: Peers | None) -> None:
    """The figures of a job, each put down as soon as it is known."""
    arena = arena_of(job.arena, job.path)
    if job.algorithm == "behaviour":
        loops, found["said"] = arena.behaviour(job.seed, job.starts)
        _put(found, loops)
        return
    table = arena.log(job.size or 1, job.seed)
    if job.size:
        found["rows"] = len(table)
    if job.algorithm == "mpcrl":
        found["train_s"] = time_mpcrl(known(peers, job), arena.rough(job.seed), table, _TRANSITIONS) * len(table)
        found["said"] = f"from {min(_TRANSITIONS, len(table)) / len(table):.2%} of the log"
        return
    made = _MAKERS[SEARCHED.get(job.algorithm, job.algorithm)](arena, job, table, peers)
    if made is None:
        found["said"] = "none is known"
        return
    found.update({name: getattr(made, name) for name in _OWN}, said=short_text(made.said))
    found["latency_ms"] = latency_ms(made.policy, table)
    _put(found, arena.loops(made.policy, job.seed, job.starts))


def known(peers: Peers | None, job: Job) -> Peers:
    """Where other packages live.

    Raises:
        PeerError: If that was not said.
    """
    if peers is None:
        raise PeerError(job.algorithm, expected="an environment of the peers", actual="none")
    return peers


def _put(found: Found, loops: Loops) -> None:
    n = len(loops.cost)
    found["cost"], found["discounted"] = float(loops.cost.mean()), float(loops.discounted.mean())
    found["cost_error"] = float(loops.cost.std(ddof=1) / np.sqrt(n)) if n > 1 else NAN
    found["success"], found["violated"] = float(np.mean(loops.success)), float(np.mean(loops.violated))


def latency_ms(policy: Predictor, table: TransitionTable) -> float:
    """Median time of one action in ms, one observation at a time, along the first rows of a log."""
    observations = table.observations[:_TIMED].astype(np.float32)
    state: Any = None
    times = []
    for k, y in enumerate(observations):
        first = np.array([k == 0])
        start = time.perf_counter()
        _, state = policy.predict(y[None], state=state, episode_start=first, deterministic=True)
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times[1:] or times))


def _saved(policy: MPCPolicy) -> float:
    """Size of a policy's file in kB."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "policy.zip"
        policy.save(file)
        return file.stat().st_size / 1e3


def _mpc(arena: Arena, mpc: MPC, train_s: float = NAN) -> Made:
    policy = arena.policy(mpc)
    return Made(policy, train_s, _saved(policy))


def _truth(arena: Arena, job: Job, table: TransitionTable, peers: Peers | None) -> Made | None:
    mpc = arena.truth()
    return None if mpc is None else _mpc(arena, mpc)


def _rough(arena: Arena, job: Job, table: TransitionTable, peers: Peers | None) -> Made:
    return _mpc(arena, arena.rough(job.seed))


def _identified(arena: Arena, job: Job, table: TransitionTable, peers: Peers | None) -> Made:
    """The model by identification, all else as one would run it with a good model."""
    rough, start = arena.rough(job.seed), core_seconds()
    found = identify(rough, table, seed=job.seed)
    seconds = core_seconds() - start
    return _mpc(arena, arena.plain(rough.replace(model=found.model).with_theta(found.theta)), seconds)


def _ours(arena: Arena, job: Job, table: TransitionTable, peers: Peers | None) -> Made:
    """A preset as it is, no option set for any plant; ``default`` with its verdict."""
    learner = OfflineMPCLearner(arena.rough(job.seed), arena.learn, preset=job.algorithm, seed=job.seed)
    learned_by: list[float] = []  # until here nothing was chosen
    start = core_seconds()
    learner.fit(table, show_progress=False, callbacks=[lambda *_: learned_by.append(core_seconds())])
    times = {"train_s": core_seconds() - start, "regressions_s": max(learned_by) - start}
    times["pass_s"] = _pass(learner, table)
    verdict = ""
    if job.algorithm == "default":
        from mpcoffline.diagnostics import diagnose

        start = core_seconds()
        verdict = diagnose(learner, table, seed=job.seed).verdict
        times["verdict_s"] = core_seconds() - start
    handed_out = "" if learner.candidates is None else learner.candidates.chosen
    return Made(learner.policy, file_kb=_saved(learner.policy), verdict=verdict, said=handed_out, **times)


def _pass(learner: OfflineMPCLearner, table: TransitionTable) -> float:
    """Time of (FIT)'s error of each transition with the V that was learned, and its gradient in theta."""
    value, mpc = learner.value_function, learner.nominal_mpc
    if value is None or mpc.nx != table.ny:
        return NAN
    problem, theta = BellmanProblem(mpc, value, 1.0), torch.from_numpy(mpc.theta).requires_grad_()
    start = core_seconds()
    for k in range(0, len(table), _ROWS):
        rows = torch.from_numpy(np.array(table.rows[k : k + _ROWS]))
        torch.autograd.grad(problem.error(table.columns(rows), theta), theta)
    return core_seconds() - start


def _peer(arena: Arena, job: Job, table: TransitionTable, peers: Peers | None) -> Made:
    """Another package's algorithm; where it is searched, the best of its settings by closed loops on the plant."""
    peers = known(peers, job)
    algorithm, bounds = SEARCHED.get(job.algorithm, job.algorithm), arena.bounds(table)
    log = f"{job.arena} {job.size} {job.seed}"
    options: list[dict[str, float]] = settings_to_try(algorithm) if job.algorithm in SEARCHED else [{}]
    trained = [
        train(peers, log, table, bounds, algorithm=algorithm, seed=job.seed, steps=job.steps, options=each)
        for each in options
    ]
    seconds = sum(each.train_s for each in trained)
    best, said = 0, ""
    if len(trained) > 1:
        costs = [arena.loops(each.policy, job.seed, job.starts, tried=True).cost.mean() for each in trained]
        best = int(np.argmin(costs))
        said = ", ".join(f"{knob} {value:g}" for knob, value in options[best].items())
    return Made(trained[best].policy, seconds, trained[best].file_kb, said=said)


Maker = Callable[[Arena, Job, TransitionTable, "Peers | None"], "Made | None"]
_MAKERS: dict[str, Maker] = {"truth": _truth, "rough": _rough, "identified": _identified}
_MAKERS |= dict.fromkeys(("default", "paper"), _ours)
_MAKERS |= {name: _peer for name, algorithm in ALGORITHMS.items() if algorithm.peer and name not in SEARCHED}
