"""Handing a log to a learner of another package, in an environment of its own, and taking its policy back."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.core.executors.protocol import THREAD_VARIABLES
from mpcoffline.core.types import Array
from mpcoffline.datasets.interop.convert import to_dict
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

#: What a search tries: the two main knobs of each, their authors' settings among the values.
KNOBS: dict[str, dict[str, tuple[float, ...]]] = {
    "td3+bc": {"alpha": (0.5, 1.0, 2.5, 5.0, 10.0), "gamma": (0.95, 0.99)},
    "iql": {"weight_temp": (1.0, 3.0, 10.0, 30.0, 100.0), "expectile": (0.7, 0.9)},
    "cql": {"conservative_weight": (0.1, 0.5, 1.0, 5.0, 10.0), "gamma": (0.95, 0.99)},
}


class PeerError(MPCOfflineError):
    """A learner of another package failed, or its environment is not there."""


@dataclass(frozen=True)
class Peers:
    """Where other packages live.

    Attributes:
        home: Holds an environment a package, ``env-d3rlpy`` and ``env-mpcrl``, and ``trained``, the trained policies,
            so that what was interrupted goes on after the last whole training.
        scripts: Holds what runs there, ``d3rlpy_peer.py`` and ``mpcrl_peer.py``: ``script data.npz output JOB``.
    """

    home: Path
    scripts: Path

    def python(self, package: str) -> Path:
        """The interpreter of a package's environment."""
        return self.home / f"env-{package}" / "bin" / "python"


@dataclass(frozen=True)
class Trained:
    """A policy that a peer has trained.

    Attributes:
        policy: It.
        train_s: CPU time of the training in s.
        file_kb: Size of its file.
    """

    policy: TorchScriptPolicy
    train_s: float
    file_kb: float


class TorchScriptPolicy:
    """A policy as TorchScript: observations to actions in the plant's units, its scalers inside.

    Args:
        path: The file.
        low: Least actions, ``(nu,)``.
        high: Largest actions, ``(nu,)``.
    """

    def __init__(self, path: Path, low: Array, high: Array) -> None:
        import torch

        self._torch = torch
        self._network: Any = torch.jit.load(str(path))  # type: ignore[no-untyped-call]
        self._low, self._high = low, high

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], None]:
        """Actions ``(B, nu)`` of observations ``(B, ny)``, or of one each without B; nothing is carried over."""
        y = np.asarray(observation, dtype=np.float32)
        with self._torch.no_grad():
            u = self._network(self._torch.from_numpy(np.atleast_2d(y))).numpy()
        u = np.clip(u, self._low, self._high).astype(np.float32)
        return (u if y.ndim == 2 else u[0]), None


def handed_over(table: TransitionTable, low: Array, high: Array) -> dict[str, NDArray[Any]]:
    """A log as the arrays that a peer reads.

    Args:
        table: The log, in whole episodes.
        low: Least actions, ``(nu,)``.
        high: Largest actions, ``(nu,)``.

    Returns:
        ``observations``, ``next_observations (n, ny)``, ``actions (n, nu)``, all in the plant's units; ``rewards (n,)``
        = -cost; ``terminals (n,)``: where an episode ended of itself, and the future costs nothing; ``timeouts (n,)``:
        where it was merely cut, and the future counts; ``low``, ``high (nu,)``, which a peer maps to -1 and 1.
    """
    columns = to_dict(table)
    kept = ("observations", "actions", "rewards", "next_observations", "terminals", "timeouts")
    return {name: columns[name] for name in kept} | {"low": np.asarray(low), "high": np.asarray(high)}


def train(
    peers: Peers,
    name: str,
    table: TransitionTable,
    bounds: tuple[Array, Array],
    *,
    algorithm: str,
    seed: int,
    steps: int,
    options: Mapping[str, float] | None = None,
) -> Trained:
    """Trains a peer on a log in its own environment; a training that is already there is not done again.

    Args:
        peers: Where they live.
        name: Of the log: what tells it from others.
        table: The log.
        bounds: Least and largest actions.
        algorithm: Name of the algorithm.
        seed: Seeds it.
        steps: Number of gradient steps.
        options: In place of its authors' settings.

    Raises:
        PeerError: If there is no such environment, or it fails; with the end of what it said.
    """
    job = {"algorithm": algorithm, "seed": seed, "steps": steps, "options": dict(options or {})}
    text = json.dumps([name, len(table), job], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    folder = peers.home / "trained"
    folder.mkdir(parents=True, exist_ok=True)
    policy, said = (folder / f"{digest}.{ending}" for ending in ("pt", "json"))
    if not said.exists():
        told = _run(peers, "d3rlpy", handed_over(table, *bounds), policy, job)
        said.write_text(json.dumps({"what": text, **told}), encoding="utf-8")  # last: without it there is no training
    told = json.loads(said.read_text(encoding="utf-8"))
    return Trained(TorchScriptPolicy(policy, *bounds), told["train_s"], policy.stat().st_size / 1e3)


def time_mpcrl(peers: Peers, mpc: MPC, table: TransitionTable, transitions: int) -> float:
    """CPU seconds a transition that LSTD-Q learning of mpcrl takes with an MPC, on the first rows of a log.

    Two MPCs are solved a transition, Q(s, a) and V(s+), by ipopt, and Q is differentiated.

    Args:
        peers: Where mpcrl lives.
        mpc: The MPC, whose whole theta is learned.
        table: The log.
        transitions: How many are timed.

    Raises:
        PeerError: As :func:`train`; also where less than half of them could be solved.
    """
    rows = table.take(slice(transitions)).values()
    functions = {"dynamics": mpc.dynamics_function, "stage": mpc.stage_function, "terminal": mpc.terminal_function}
    data: dict[str, Any] = {name: function.serialize() for name, function in functions.items()}
    data |= {"theta": mpc.theta, "horizon": mpc.horizon, "discount": mpc.discount}
    data |= {"low": mpc.action_low, "high": mpc.action_high, "actions": rows.actions, "costs": rows.costs}
    data |= {"states": mpc.state(rows.observations), "next_states": mpc.state(rows.next_observations)}
    told = _run(peers, "mpcrl", data, peers.home / "none", {"algorithm": "mpcrl", "transitions": transitions})
    if told["solved"] < 0.5 * told["transitions"]:
        raise PeerError("mpcrl", expected="most MPCs to be solved", actual=f"{told['solved']} of {told['transitions']}")
    return float(told["train_s"] / told["transitions"])


def _run(peers: Peers, package: str, data: dict[str, Any], output: Path, job: dict[str, Any]) -> dict[str, Any]:
    python, script = peers.python(package), peers.scripts / f"{package}_peer.py"
    if not python.exists():
        expected, hint = f"a Python environment with {package}", "scripts/bench_field makes it."
        raise PeerError(str(python), expected=expected, actual="none", hint=hint)
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, "1")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "data.npz"
        np.savez(file, **data)
        command = [str(python), str(script), str(file), str(output), json.dumps(job)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder, check=False)
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise PeerError(job["algorithm"], expected="a run that ends well", actual=lines[-1])
    told: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return told


def settings_to_try(algorithm: str) -> list[dict[str, float]]:
    """The ten settings of a search."""
    knobs = KNOBS[algorithm]
    return [dict(zip(knobs, values, strict=True)) for values in product(*knobs.values())]
