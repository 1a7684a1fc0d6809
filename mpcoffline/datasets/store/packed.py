"""The compact file in which a data set is shipped.

It holds what cannot be recomputed: float64 states (each episode's last one too), float32 actions and episode
lengths. Observations and costs follow from the environment's ``observe(state)`` and ``cost(state, action)``,
and Minari's other columns from the lengths. The states could be simulated from the first one, which would
make the file several times smaller still, but an unstable or chaotic plant turns the last bit of another
machine's sine into a visibly different episode.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import h5py
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

import mpcoffline.envs  # noqa: F401 -- registers the environments
from mpcoffline.core.errors import FileFormatError, InvalidDataError
from mpcoffline.core.outputs import replaced
from mpcoffline.envs import ControlTask

from .hdf5_guard import check_hdf5
from .hdf5_writing import SteadyFile, write_steadily
from .writing import episode_of, write_dataset

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer

FORMAT = "mpcoffline packed episodes"
VERSION = 1
_DAMAGES = (KeyError, OSError, TypeError, ValueError, AttributeError)


def pack(dataset: MinariDataset, path: str | Path) -> None:
    """Writes the shipped form of a data set that one of this package's tasks produced.

    The file is the same byte for byte whenever the data are: it holds no time stamps.

    Args:
        dataset: A data set with ``infos/state`` in every episode.
        path: The file to write; replaced if it exists.

    Raises:
        InvalidDataError: Where the environment does not reproduce the recorded observations
            and rewards from states and actions: such a data set cannot be packed.
        StorageError: Where the disk refuses; a file of that name is as it was.
    """
    name = f"data set {dataset.spec.dataset_id!r}"
    if dataset.env_spec is None:
        raise InvalidDataError(name, expected="an env_spec", actual="none")
    task = _task(dataset.env_spec)
    states, actions, terminated = [], [], []
    for episode in dataset.iterate_episodes():
        state = _recorded_states(f"{name}, episode {episode.id}", episode)
        _check_recomputes(f"{name}, episode {episode.id}", task, state, episode)
        states.append(state)
        actions.append(np.asarray(episode.actions, dtype=np.float32))
        terminated.append(bool(episode.terminations[-1]))
    metadata = dataset.storage.metadata

    def write(steady: SteadyFile) -> None:
        with h5py.File(steady, "w") as file:
            file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
            file.attrs["dataset_id"] = dataset.spec.dataset_id
            file.attrs["env_spec"] = dataset.env_spec.to_json()
            for key in ("algorithm_name", "description"):
                file.attrs[key] = metadata.get(key, "")
            # Shuffling puts the exponents of neighbours side by side, which is what can be compressed in float64.
            layout: dict[str, Any] = {"compression": "gzip", "compression_opts": 9, "shuffle": True}
            file.create_dataset("states", data=np.concatenate(states), **layout)
            file.create_dataset("actions", data=np.concatenate(actions), **layout)
            file.create_dataset("lengths", data=np.array([len(a) for a in actions], dtype=np.int32))
            file.create_dataset("terminated", data=np.array(terminated))

    with replaced(path) as new:
        write_steadily(Path(new.name), write)


def packed_size(path: str | Path) -> tuple[int, int]:
    """Numbers of episodes and of steps in a packed file.

    Raises:
        FileFormatError: For a file that is not one.
    """
    with _open(path) as file:
        try:
            lengths = _lengths(file, path)
        except _DAMAGES as error:
            raise _damaged(path, f"{type(error).__name__}: {error}") from error
    return len(lengths), int(lengths.sum())


def unpack(path: str | Path, dataset_id: str, *, overwrite: bool = False) -> MinariDataset:
    """Stores a packed file's episodes as a Minari data set.

    Args:
        path: The packed file.
        dataset_id: Minari id of the result.
        overwrite: Whether an existing data set of that id is replaced.

    Raises:
        FileFormatError: For a file that is damaged, of another kind or of another version.
        InvalidArgumentError: For a malformed or existing id.
    """
    with _open(path) as file:
        try:
            spec = EnvSpec.from_json(str(file.attrs["env_spec"]))
            states, actions = file["states"][:], file["actions"][:]
            lengths, terminated = _lengths(file, path), file["terminated"][:]
            texts = {key: str(file.attrs[key]) or None for key in ("algorithm_name", "description")}
        except _DAMAGES as error:
            raise _damaged(path, f"{type(error).__name__}: {error}") from error
    if any(array.dtype.kind not in "fiub" for array in (states, actions, terminated)):
        raise _damaged(path, "columns that are no numbers")
    if len(actions) != lengths.sum() or len(states) != len(actions) + len(lengths):
        raise _damaged(path, f"{len(states)} states, {len(actions)} actions in {len(lengths)} episodes")
    task = _task(spec)
    first = np.concatenate([[0], np.cumsum(lengths)])
    try:
        episodes = [
            _episode(task, states[begin + i : end + i + 1], actions[begin:end], bool(terminated[i]))
            for i, (begin, end) in enumerate(itertools.pairwise(first))
        ]
    except (ValueError, IndexError) as error:
        raise _damaged(path, f"states or actions of another task: {error}") from error
    return write_dataset(
        dataset_id,
        episodes,
        env_spec=spec,
        observation_space=task.observation_space,
        action_space=task.action_space,
        algorithm_name=texts["algorithm_name"],
        description=texts["description"],
        overwrite=overwrite,
    )


def _episode(
    task: ControlTask, states: NDArray[np.float64], actions: NDArray[np.float32], terminated: bool
) -> EpisodeBuffer:
    costs = task.cost(states[:-1], actions.astype(np.float64))
    return episode_of(task.observe(states), actions, costs, states, terminated=terminated)


def _recorded_states(where: str, episode: Any) -> NDArray[np.float64]:
    states = (episode.infos or {}).get("state")
    if states is None or not np.isfinite(states).all():
        found = "none" if states is None else "NaN (an episode joined halfway)"
        raise InvalidDataError(f"{where}: infos/state", expected="the state at every step", actual=found)
    return np.asarray(states, dtype=np.float64)


def _check_recomputes(where: str, task: ControlTask, states: NDArray[np.float64], episode: Any) -> None:
    again = _episode(task, states, episode.actions, bool(episode.terminations[-1]))
    for column, tolerance in (
        ("observations", 1e-6),
        ("rewards", 1e-12),
        ("terminations", 0),
        ("truncations", 0),
    ):
        recorded = np.asarray(getattr(episode, column), dtype=np.float64)
        recomputed = np.asarray(getattr(again, column), dtype=np.float64)
        error = float(np.max(np.abs(recorded - recomputed) / np.maximum(1.0, np.abs(recorded))))
        if not error <= tolerance:
            raise InvalidDataError(
                f"{where}: {column}",
                expected="what states and actions give",
                actual=f"a difference of {error:.1e}",
            )


def _task(spec: EnvSpec) -> ControlTask:
    """The registered environment of that id with the spec's arguments: nothing that a file names is imported."""
    known = gym.registry.get(spec.id)
    if known is None or known.entry_point != spec.entry_point or spec.additional_wrappers:
        raise InvalidDataError(
            f"environment {spec.id!r}",
            expected="one of this package's tasks, without wrappers",
            actual=f"{spec.entry_point}",
        )
    task = gym.make(replace(known, kwargs=dict(spec.kwargs), max_episode_steps=spec.max_episode_steps)).unwrapped
    if not isinstance(task, ControlTask):
        raise InvalidDataError(
            f"environment {spec.id!r}", expected="one of this package's tasks", actual=type(task).__name__
        )
    return task


def _lengths(file: Any, path: str | Path) -> NDArray[np.int64]:
    lengths = file["lengths"][:]
    if lengths.ndim != 1 or lengths.dtype.kind not in "iu" or (lengths < 1).any():
        raise _damaged(path, "lengths of episodes that are no positive integers")
    return np.asarray(lengths, dtype=np.int64)


def _open(path: str | Path) -> Any:
    try:
        check_hdf5(Path(path))
        file = h5py.File(path, "r")
    except OSError as error:
        raise _damaged(path, str(error)) from error
    try:
        found = (file.attrs.get("format"), file.attrs.get("version"))
    except _DAMAGES as error:
        file.close()
        raise _damaged(path, f"{type(error).__name__}: {error}") from error
    if found != (FORMAT, VERSION):
        file.close()
        raise FileFormatError(f"file {path}", expected=f"{FORMAT!r} of version {VERSION}", actual=str(found))
    return file


def _damaged(path: str | Path, found: str) -> FileFormatError:
    return FileFormatError(f"file {path}", expected=f"an intact HDF5 file of {FORMAT}", actual=found)
