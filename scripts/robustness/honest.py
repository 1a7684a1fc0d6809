"""Honest files of every kind that is read, small and made in seconds, and what they hold."""

from __future__ import annotations

import os
import shutil
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import gymnasium as gym
import numpy as np
from gymnasium import spaces

import mpcoffline.envs  # noqa: F401 -- registers the environments
from mpcoffline import MPC, Model, MPCPolicy, OfflineMPCLearner, Parameter, QuadraticCost, TransitionTable, nominal_mpc
from mpcoffline.control import DistilledPolicy
from mpcoffline.control.explicit.network import PolicyNetwork
from mpcoffline.control.explicit.report import Comparison, DistillationReport
from mpcoffline.datasets import dataset_from_arrays, load_dataset, record, repair
from mpcoffline.datasets.store.packed import pack
from mpcoffline.mpc.labels import Label

ENV = "mpcoffline/LinearTracking-v0"
SET, LOGS, PACKED = "aa/set-v0", "aa/logs-v0", "aa/packed-v0"
EPISODES, STEPS = 6, 8
FIT = {"value_n_steps": 12, "fit_n_steps": 6}


@dataclass
class Honest:
    """A folder of honest files.

    Attributes:
        folder: ``policy.zip``, ``distilled.zip``, ``learner.zip``, ``fit.ckpt``, ``packed.h5``, ``other/`` (files of
            the same kinds with other content), ``store/`` (a Minari store), ``tables/`` and ``solvers/`` (caches).
        table: The rows of the data set.
        rows: The rows of the episodes in the logs, as bytes.
        foreign_rows: Those of the logs in ``other/``.
    """

    folder: Path
    table: TransitionTable
    rows: set[bytes]
    foreign_rows: set[bytes]


@contextmanager
def settings(**paths: Path | str) -> Any:
    """Environment variables for a while."""
    before = {key: os.environ.get(key) for key in paths}
    os.environ.update({key: str(value) for key, value in paths.items()})
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value


def small_mpc(mass: float = 1.0) -> MPC:
    """Three states and a name with a unit: quick to compile."""

    def dynamics(x: Any, u: Any, p: Any) -> Any:
        return ca.vertcat(x[1], x[2] + 0.1 * ca.sin(x[0]), u[0] / p["m"])

    model = Model(dynamics, 3, 1, 0.1, {"m": Parameter(mass, low=0.1, unit="kg")})
    return MPC(model, QuadraticCost(np.eye(3), [[0.1]]), QuadraticCost(np.eye(3)), 6, 0.95, [-1], [1])


def small_distilled() -> DistilledPolicy:
    """Random weights; one past input travels in its state."""
    rng, seen, set_ = np.random.default_rng(0), spaces.Box(-np.inf, np.inf, (3,)), spaces.Box(-1.0, 1.0, (1,))
    network = PolicyNetwork.random(
        rng.normal(size=(20, 4)), (set_.low, set_.high), rng.normal(size=(20, 1)), (4, 3), rng
    )
    report = DistillationReport(
        network.multiply_adds, 10, (0.1,), Comparison.of([1.0, 2.0], [1.0, 1.5], 10), None, 0.1, 0.95, 0
    )
    names = {"y_labels": [Label(f"x{i}", "m") for i in range(3)], "u_labels": [Label("u", "N")]}
    memory = {"usual_memory": [0.0], "memory_sources": [1], "memory_names": ["u[k-1]"]}
    return DistilledPolicy(network, seen, set_, **names, **memory, report=report)


def learner() -> OfflineMPCLearner:
    """A learner whose fit takes a second."""
    return OfflineMPCLearner(nominal_mpc(ENV), preset="paper", seed=0, **FIT)


def actions(seed: int) -> Any:
    """A policy: random actions."""
    rng = np.random.default_rng(seed)
    return lambda observation: rng.uniform(-0.3, 0.3, 2).astype(np.float32)


def short_env() -> gym.Env[Any, Any]:
    """The linear task with short episodes."""
    return gym.make(ENV, max_episode_steps=STEPS)


def leave_logs(dataset_id: str, seed: int, episodes: int = EPISODES) -> None:
    """A recording that is interrupted after some episodes."""
    steps, policy = iter(range(episodes * STEPS)), actions(seed)

    class InterruptionError(Exception):
        pass

    def interrupted(observation: Any) -> Any:
        if next(steps, None) is None:
            raise InterruptionError
        return policy(observation)

    with suppress(InterruptionError):
        record(short_env(), interrupted, episodes + 1, dataset_id, seed=seed)


def rows_in_logs(store: Path, copy: Path) -> set[bytes]:
    """What the logs of a store hold, by repairing a copy of it."""
    shutil.copytree(store / ".recording", copy / ".recording")
    with settings(MINARI_DATASETS_PATH=copy):
        repair(LOGS)
        return {row.tobytes() for row in TransitionTable.from_minari(LOGS).rows}


def make_honest(folder: Path) -> Honest:
    """Makes all of them."""
    store = folder / "store"
    (folder / "other").mkdir(parents=True)
    store.mkdir()
    x = np.array([0.3, 0.2, -0.1])
    with settings(MINARI_DATASETS_PATH=store, MPCOFFLINE_CACHE=folder / "solvers"):
        record(short_env(), actions(0), EPISODES, SET, seed=0)
        table = TransitionTable.from_minari(SET)
        TransitionTable.from_minari(SET, memory=1, cache=folder / "tables").statistics()
        pack(load_dataset(SET), folder / "packed.h5")
        policy = MPCPolicy(small_mpc())
        policy.predict(x)
        policy.save(folder / "policy.zip")
        MPCPolicy(small_mpc(2.0)).save(folder / "other" / "policy.zip")
        small_distilled().save(folder / "distilled.zip")
        fitted = learner()
        fitted.fit(table, show_progress=False)
        fitted.save(folder / "learner.zip")
        stopped = learner()
        stopped.fit(
            table, n_steps_per_epoch=4, checkpoint=folder / "fit.ckpt", show_progress=False,
            callbacks=[lambda owner, epoch, step: epoch < 2],
        )  # fmt: skip
        for number, place in ((1, store), (2, folder / "other")):
            with settings(MINARI_DATASETS_PATH=place):
                leave_logs(LOGS, number)
        rows = rows_in_logs(store, folder / "sealed")
        foreign_rows = rows_in_logs(folder / "other", folder / "other" / "sealed")
        with settings(MINARI_DATASETS_PATH=folder / "other"):
            rng = np.random.default_rng(3)
            episode = (rng.normal(size=(STEPS + 1, 4)), rng.normal(size=(STEPS, 2)), rng.normal(size=STEPS))
            dataset_from_arrays(SET, [episode] * EPISODES)
    return Honest(folder, table, rows, foreign_rows)
