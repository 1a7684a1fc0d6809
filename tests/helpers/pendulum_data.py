"""Short episodes under random actions, of the pendulum unless asked otherwise, made without the recorder."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer

import mpcoffline.envs  # noqa: F401 -- registers the environments
from mpcoffline.datasets.store.ids import dataset_path
from mpcoffline.datasets.store.manifest import write_manifest
from mpcoffline.datasets.store.writing import write_dataset

PENDULUM = "mpcoffline/PendulumSwingUp-v0"


def recorded(
    length: int = 5,
    episodes: int = 2,
    seed: int = 0,
    *,
    terminate: bool = False,
    env_id: str = PENDULUM,
    **arguments: Any,
) -> list[EpisodeBuffer]:
    """Episodes that are truncated at the end, or terminated, every other one, where asked to."""
    env = gym.make(env_id, **arguments)
    env.action_space.seed(seed)
    buffers = []
    for i in range(episodes):
        observation, info = env.reset(seed=seed + i)
        columns: dict[str, Any] = {"observations": [observation], "actions": [], "rewards": []}
        infos = {"cost": [[0.0]], "state": [info["state"]]}
        for _ in range(length):
            action = env.action_space.sample()
            observation, reward, _, _, info = env.step(action)
            columns["observations"].append(observation)
            columns["actions"].append(action)
            columns["rewards"].append(reward)
            infos["cost"].append([info["cost"]])
            infos["state"].append(info["state"])
        columns = {key: np.array(value) for key, value in columns.items()}
        ends = np.arange(length) == length - 1
        terminates = terminate and i % 2 == 1
        buffers.append(
            EpisodeBuffer(
                **columns,
                terminations=ends & terminates,
                truncations=ends & (not terminates),
                infos={key: np.array(value) for key, value in infos.items()},
            )
        )
    return buffers


def stored(
    dataset_id: str = "test/set-v0", *, env_id: str = PENDULUM, alpha: float | None = None, **arguments: Any
) -> minari.MinariDataset:
    """Writes episodes (by default those of :func:`recorded`) into the store."""
    env = gym.make(env_id, **({} if alpha is None else {"alpha": alpha}))
    given = {"env_spec": env.spec, "observation_space": env.observation_space, "action_space": env.action_space}
    return write_dataset(dataset_id, arguments.pop("episodes", None) or recorded(), **{**given, **arguments})


def resealed(dataset_id: str = "test/set-v0") -> None:
    """Writes the manifest of a data set anew: what a test changed of its files is no damage."""
    write_manifest(dataset_path(dataset_id))
