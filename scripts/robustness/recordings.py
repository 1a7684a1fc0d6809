"""Recordings whose every number says which episode it belongs to, and what must be left of them."""

from __future__ import annotations

import json
import mmap
import os
import shutil
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import h5py
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from mpcoffline.datasets import MinariRecorder, record

ID = "crash/set-v0"
ENV = "Numbered-v0"
LONGEST, SERIALS, RUN, COPY = 12, 1 << 20, 10_000, 2_000


def length_of(serial: int) -> int:
    """Steps of the episode."""
    return 1 + int(np.random.default_rng(serial).integers(LONGEST))


def rewards_of(serial: int) -> Any:
    """Rewards of all its steps, exact in float32."""
    return -(np.random.default_rng(serial + 7).integers(1, 1 << 20, length_of(serial)) / 1024.0)


def states_of(serial: int) -> Any:
    """Its states ``(T+1, 2)`` in float64."""
    return np.random.default_rng(serial + 13).normal(size=(length_of(serial) + 1, 2))


class Promises:
    """Which episodes are recorded, in memory that outlives the process that records them."""

    def __init__(self) -> None:
        self.renew()

    def renew(self) -> None:
        """Memory of this process's own, shared with those that it forks from now on."""
        self._map = mmap.mmap(-1, SERIALS + 64)

    def clear(self) -> None:
        """Forgets all."""
        self._map[:] = bytes(len(self._map))

    def add(self, serial: int) -> None:
        """The recorder has returned from this episode."""
        self._map[serial] = 1

    def say(self, letter: bytes) -> None:
        """Says how far the process is, by one letter."""
        self._map[SERIALS] = letter[0]

    @property
    def said(self) -> bytes:
        """The last letter."""
        return bytes((self._map[SERIALS],))

    def __iter__(self) -> Any:
        return iter(np.flatnonzero(np.frombuffer(self._map, np.uint8)[:SERIALS]).tolist())


PROMISES = Promises()


class Numbered(gym.Env[Any, Any]):
    """Observation: number of the episode and of the step, the action before; one in three episodes terminates."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self) -> None:
        self.next, self.serial = 0, -1

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        if self.serial >= 0 and self.k == self.length:
            self.ended(self.serial)
        if seed is not None and seed >= RUN:  # `record` says which episode is next, also where it goes on
            self.next = seed
        self.serial, self.next, self.k = self.next, self.next + 1, 0
        self.length, self.rewards, self.states = length_of(self.serial), rewards_of(self.serial), states_of(self.serial)
        return self._seen(0.0), {"state": self.states[0], "cost": 0.0}

    def ended(self, serial: int) -> None:
        """An episode has been finished, and the next one begins."""

    def step(self, action: Any) -> Any:
        reward = float(self.rewards[self.k])
        self.k += 1
        over = self.k == self.length
        terminated = over and self.serial % 3 == 0
        info = {"state": self.states[self.k], "cost": -reward}
        return self._seen(float(action[0])), reward, terminated, over and not terminated, info

    def _seen(self, action: float) -> Any:
        return np.array([self.serial, self.k, action], np.float32)


class Promising(Numbered):
    """For ``record``, which asks for the next episode once the one before is in its log."""

    def ended(self, serial: int) -> None:
        PROMISES.add(serial)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        first = super().reset(seed=seed, options=options)
        if PROMISES.said != b"b":
            PROMISES.say(b"b")
        return first


class Say(BaseCallback):
    """After the recorder in the list: what has ended until now is promised."""

    def _on_step(self) -> bool:
        done = np.flatnonzero(self.locals["dones"])
        for copy in done:
            PROMISES.add(int(self.locals["infos"][copy]["terminal_observation"][0]))
        return True


class SayEnd(BaseCallback):
    """Before the recorder in the list: it has begun, and it seals next."""

    def _on_step(self) -> bool:
        if PROMISES.said != b"b":
            PROMISES.say(b"b")
        return True

    def _on_training_end(self) -> None:
        PROMISES.say(b"s")


def register() -> None:
    """Makes the environments known to Gymnasium, by a module that a repair can import."""
    for name, entry in ((ENV, Numbered), ("Promising-v0", Promising)):
        if name not in gym.registry:
            gym.register(name, entry_point=f"{__name__}:{entry.__name__}")


def numbered(name: str, run: int, copy: int = 0) -> gym.Env[Any, Any]:
    """One of these environments; its copies, and those of other runs, are one plant that counts from another number."""
    env = gym.make(name)
    plant = cast("Numbered", env.unwrapped)
    plant.next = run * RUN + copy * COPY
    return env


def with_record(run: int, episodes: int, **options: Any) -> None:
    """Records by ``record``."""
    rng = np.random.default_rng(run)

    def policy(observation: Any) -> Any:
        return rng.uniform(-1, 1, 1).astype(np.float32)

    record(numbered("Promising-v0", run), policy, episodes, ID, seed=run * RUN, **options)


def with_agent(run: int, copies: int, steps: int, rounds: int = 1, **options: Any) -> None:
    """Records what a DDPG agent does that never learns."""
    env = DummyVecEnv([lambda copy=copy: numbered(ENV, run, copy) for copy in range(copies)])
    agent = DDPG(
        "MlpPolicy", env, learning_starts=10**9, buffer_size=100, policy_kwargs={"net_arch": [4]}, device="cpu"
    )
    recorder = MinariRecorder(ID, sync_episodes=3, **options)
    for number in range(rounds):
        agent.learn(steps, callback=[SayEnd(), recorder, Say()], reset_num_timesteps=number == 0)


def arrays_of(serials: Iterable[int]) -> list[tuple[Any, Any, Any]]:
    """Episodes for ``dataset_from_arrays``."""
    episodes = []
    for serial in serials:
        n = length_of(serial)
        actions = np.random.default_rng(serial).uniform(-1, 1, (n, 1)).astype(np.float32)
        seen = np.zeros((n + 1, 3), np.float32)
        seen[:, 0], seen[:, 1], seen[1:, 2] = serial, np.arange(n + 1), actions[:, 0]
        episodes.append((seen, actions, -rewards_of(serial)))
    return episodes


def buffer_of(serial: int) -> EpisodeBuffer:
    """An episode as Minari stores it."""
    (seen, actions, costs), *_ = arrays_of([serial])
    ends = np.arange(len(costs)) == len(costs) - 1
    return EpisodeBuffer(
        observations=seen, actions=actions, rewards=-costs, terminations=ends, truncations=ends & False
    )


@dataclass
class Found:
    """What is left of a recording.

    Attributes:
        promised: Number of episodes that were recorded.
        stored: Number of episodes in the data set.
        problems: What is wrong, a sentence each.
    """

    promised: int = 0
    stored: int = 0
    problems: list[str] = field(default_factory=list)


def store() -> Path:
    """The Minari store in use."""
    return Path(os.environ["MINARI_DATASETS_PATH"])


def check_set(promised: Iterable[int], *, allowed: set[int] | None = None) -> Found:
    """Compares the data set, read by h5py alone, with what its episodes must hold.

    Args:
        promised: Serial numbers of the episodes that must be there.
        allowed: Those that may be there; None for any.
    """
    wanted = set(promised)
    found = Found(promised=len(wanted))
    path = store() / ID / "data" / "main_data.hdf5"
    if not path.exists():
        if wanted:
            found.problems.append(f"lost: all {len(wanted)} episodes, there is no data set")
        return found
    seen: list[int] = []
    steps: Counter[int] = Counter()  # of episodes in parts: the end of a training cuts the one under way in two
    with h5py.File(path, "r") as file:
        for number in range(len(file)):
            group = file[f"episode_{number}"]
            serial, problem = _episode(group)
            whole = len(group["rewards"]) == length_of(serial) if serial >= 0 else False
            if problem:
                found.problems.append(f"mixed: episode {number}: {problem}")
            elif whole:
                seen.append(serial)
            else:
                steps[serial] += len(group["rewards"])
                if steps[serial] == length_of(serial):
                    seen.append(serial)
        found.stored = len(file)
    for serial, count in steps.items():
        if count != length_of(serial) and serial in wanted:
            found.problems.append(f"lost: episode {serial} is cut off")
    metadata = json.loads((path.parent / "metadata.json").read_text())
    if metadata["total_episodes"] != found.stored:
        found.problems.append(f"wrong: {metadata['total_episodes']} episodes in the metadata, {found.stored} stored")
    if missing := sorted(wanted - set(seen)):
        found.problems.append(f"lost: {len(missing)} of {len(wanted)} promised episodes, the first {missing[0]}")
    if len(seen) != len(set(seen)):
        found.problems.append(f"duplicated: {len(seen) - len(set(seen))} episodes")
    if allowed is not None and not set(seen) <= allowed:
        found.problems.append(f"mixed: {len(set(seen) - allowed)} episodes of another recording")
    for run in {serial // COPY for serial in seen}:
        own = [serial for serial in seen if serial // COPY == run]
        if own != sorted(own):
            found.problems.append(f"mixed: the episodes of environment {run} are out of order")
    return found


def _episode(group: Any) -> tuple[int, str]:
    """The serial number that an episode bears, and what is wrong with it."""
    seen, actions, rewards = (group[name][()] for name in ("observations", "actions", "rewards"))
    n, serial = len(rewards), int(seen[0, 0])
    if not (seen[:, 0] == serial).all():
        return -1, f"rows of episodes {sorted(set(seen[:, 0].tolist()))[:4]}"
    first = int(seen[0, 1])  # above 0 where recording began halfway
    checks = {
        "steps": len(seen) == n + 1 and np.array_equal(seen[:, 1], np.arange(first, first + n + 1)),
        "actions": len(actions) == n and np.array_equal(seen[1:, 2], actions[:, 0]),
        "rewards": np.array_equal(rewards, rewards_of(serial)[first : first + n]),
        "end": first + n < length_of(serial) or bool(group["terminations"][-1] | group["truncations"][-1]),
        "ends": not (group["terminations"][:-1] | group["truncations"][:-1]).any(),
    }
    if "infos" in group and "state" in group["infos"] and group["infos/state"].shape == (n + 1, 2):
        known = slice(1 if first else 0, None)
        wanted = states_of(serial)[first : first + n + 1]
        checks["states"] = np.array_equal(group["infos/state"][()][known], wanted[known])
    wrong = [name for name, right in checks.items() if not right]
    return serial, f"episode {serial}: other {', '.join(wrong)}" if wrong else ""


def leftovers() -> list[str]:
    """Hidden files and folders in the store and in the caches, by their paths, but for what was kept on purpose."""
    roots = [store(), Path(os.environ["MPCOFFLINE_CACHE"]), Path(os.environ["XDG_CACHE_HOME"])]
    names = [(root, path.relative_to(root)) for root in roots if root.exists() for path in root.rglob(".*")]
    found = {str(path): root / path for root, path in names if path.parts[0] not in (".broken", ".locks")}
    inside = {name: [str(p.relative_to(path)) for p in path.rglob("*")] for name, path in found.items()}
    return [f"{name} ({', '.join(sorted(inside[name])) or 'empty'})" for name in sorted(found)]


def fresh(folder: Path) -> None:
    """An empty store and empty caches."""
    shutil.rmtree(folder, ignore_errors=True)
    for key in ("MINARI_DATASETS_PATH", "MPCOFFLINE_CACHE", "XDG_CACHE_HOME"):
        os.environ[key] = str(folder / key.lower())
        (folder / key.lower()).mkdir(parents=True)
    PROMISES.clear()
