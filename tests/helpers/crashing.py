"""A recording in a forked process that is killed with SIGKILL, and what must hold afterwards."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from mpcoffline.core.errors import UnknownIdError
from mpcoffline.datasets import repair
from mpcoffline.datasets.recording.session import Recording
from mpcoffline.datasets.store.recording_lock import log_files

DATASET = "test/crash-v0"
SPACE = spaces.Box(-np.inf, np.inf, (2,), np.float32)
ACTIONS = spaces.Box(-1.0, 1.0, (1,), np.float32)


def episode(number: int, length: int = 5) -> EpisodeBuffer:
    """An episode whose every value follows from its number."""
    rng = np.random.default_rng(number)
    columns: dict[str, Any] = {
        "observations": rng.normal(size=(length + 1, 2)).astype(np.float32),
        "actions": rng.uniform(-1, 1, size=(length, 1)).astype(np.float32),
        "rewards": np.full(length, -float(number)),
        "terminations": np.zeros(length, bool),
        "truncations": np.arange(length) == length - 1,
        "infos": {"cost": rng.normal(size=(length + 1, 1))},
    }
    return EpisodeBuffer(**columns)


def recording(**arguments: Any) -> Recording:
    """A recording into :data:`DATASET`."""
    spec = gym.spec("mpcoffline/PendulumSwingUp-v0")
    settings = {"env_spec": spec, "observation_space": SPACE, "action_space": ACTIONS, **arguments}
    return Recording(DATASET, **settings)


def run_and_kill(job: Callable[[Callable[[str], None]], None], after: Callable[[int], str]) -> tuple[str, bool]:
    """Runs ``job(say)`` in a forked process; ``after(fd)`` reads what it says until it is to be killed.

    Returns:
        All that the process said (one letter at a time), and whether it ended by itself.
    """
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.close(ours)
            pipe = os.fdopen(theirs, "w")
            job(lambda letter: print(letter, end="", file=pipe, flush=True))
            code = 0
        finally:
            os._exit(code)
    os.close(theirs)
    said = after(ours)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    while part := os.read(ours, 4096):
        said += part.decode()
    os.close(ours)
    return said, os.WIFEXITED(status)


def kill_at_call(number: int) -> None:
    """Kills this process at its ``number``-th call of a C function: any moment that another process could see."""
    count = 0

    def profile(frame: Any, event: str, argument: Any) -> None:
        nonlocal count
        if event == "c_call":
            count += 1
            if count == number:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.setprofile(profile)
    threading.setprofile(profile)  # HDF5 is written in a thread of its own


def count_calls(job: Callable[[], None]) -> int:
    """Number of C functions that a job calls."""
    count = 0

    def profile(frame: Any, event: str, argument: Any) -> None:
        nonlocal count
        count += event == "c_call"

    sys.setprofile(profile)
    threading.setprofile(profile)  # HDF5 is written in a thread of its own
    try:
        job()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return count


def check_survivors(said: int) -> int:
    """Repairs, and checks that the first episodes are all there and right; returns how many there are.

    Args:
        said: Number of episodes that the process had finished when it was killed.
    """
    try:
        repair(DATASET)
    except UnknownIdError:
        assert said == 0, f"{said} episodes lost"
        return 0
    assert not log_files(DATASET)
    dataset = minari.load_dataset(DATASET)
    episodes = list(dataset.iterate_episodes())
    assert len(episodes) == dataset.total_episodes
    assert said <= len(episodes), f"{said} finished, {len(episodes)} left"
    for number, found in enumerate(episodes):
        wanted = episode(number)
        for column in ("observations", "actions", "rewards", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(found, column), getattr(wanted, column))
    return len(episodes)
