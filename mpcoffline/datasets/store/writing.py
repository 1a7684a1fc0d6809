"""Writing data sets into the Minari store of this machine: complete or not at all."""

from __future__ import annotations

import contextlib
import errno
import importlib.metadata
import itertools
import json
import shutil
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from mpcoffline.core.atomic import publish, sync_tree
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, MPCOfflineError, StorageError
from mpcoffline.core.outputs import write_file
from mpcoffline.core.scratch import scratch_folder

from .hdf5_writing import store_episodes
from .ids import check_dataset_id, dataset_path, is_local
from .manifest import write_manifest
from .names import NAMES
from .opening import open_dataset, read_metadata
from .recording_lock import check_not_recorded

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer

RECORDING = "mpcoffline_recording"


def check_new_dataset(dataset_id: str, *, overwrite: bool) -> None:
    """Refuses an id that is malformed, or that exists unless ``overwrite``.

    Raises:
        InvalidArgumentError: For either.
    """
    check_dataset_id(dataset_id)
    if is_local(dataset_id) and not overwrite:
        raise InvalidArgumentError(
            "dataset_id",
            expected="the id of a new data set",
            actual=f"{dataset_id!r}, which exists in {dataset_path(dataset_id)}",
            hint="Choose another version number, or pass overwrite=True.",
        )


def recording_of(dataset_id: str) -> str | None:
    """The name of the recording that a local data set was sealed from; None where it has none or does not exist."""
    try:
        name = read_metadata(dataset_path(dataset_id)).get(RECORDING)
    except (OSError, FileFormatError):
        return None
    return name if isinstance(name, str) else None


def episode_of(
    observations: NDArray[Any], actions: NDArray[Any], costs: NDArray[Any], states: NDArray[Any], *, terminated: bool
) -> EpisodeBuffer:
    """An episode as Minari stores it, with costs and states among its infos.

    Args:
        observations: ``(T+1, ny)``.
        actions: ``(T, nu)``.
        costs: L(s, a), ``(T,)``; the rewards are -L.
        states: ``(T+1, nx)``.
        terminated: Whether it ended in a terminal state; otherwise it was cut off there.
    """
    from minari.data_collector import EpisodeBuffer

    last = np.arange(len(actions)) == len(actions) - 1
    columns: dict[str, Any] = {
        "observations": observations,
        "actions": actions,
        "rewards": -costs,
        "terminations": last & terminated,
        "truncations": last & (not terminated),
        "infos": {"cost": np.concatenate([[0.0], costs])[:, None], "state": states},
    }
    return EpisodeBuffer(**columns)


def write_dataset(
    dataset_id: str,
    episodes: Iterable[EpisodeBuffer],
    *,
    env_spec: EnvSpec | None,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    algorithm_name: str | None = None,
    description: str | None = None,
    overwrite: bool = False,
    extend: bool = False,
    recording: str | None = None,
    building: Path | None = None,
    names: Sequence[str] = (),
) -> MinariDataset:
    """Stores episodes as a Minari data set, which appears complete or not at all.

    ``minari.create_dataset_from_buffers`` writes in place, so that a full disk or a killed process leaves
    half a data set under the final name. This does the same with the same storage class, but in a hidden
    folder that is written to the disk, its metadata last, and renamed when complete.

    Args:
        dataset_id: Minari id.
        episodes: The episodes, taken one at a time.
        env_spec: Spec of the environment; None where it has none (it cannot be recovered then).
        observation_space: Space of the observations.
        action_space: Space of the actions.
        algorithm_name: Metadata: what produced the data.
        description: Metadata: what the data are.
        overwrite: Whether an existing data set is replaced.
        extend: Whether the new data set begins with the episodes of the one replaced, and keeps its metadata.
        recording: Name of the recording that the episodes come from, kept in the metadata.
        building: The folder to build in, which must not exist; by default a hidden one in the store.
        names: Metadata: what its columns are called, observations first; none where nobody said.

    Returns:
        The stored data set.

    Raises:
        InvalidArgumentError: For a malformed id, one that exists or is being recorded, or no episode at all.
        StorageError: Where the disk is full or fails; nothing is left behind.
    """
    from minari.dataset.minari_storage import MinariStorage

    check_new_dataset(dataset_id, overwrite=overwrite)
    if recording is None:
        check_not_recorded(dataset_id)
    iterator = iter(episodes)
    first = next(iterator, None)
    if first is None:
        raise InvalidArgumentError(f"data set {dataset_id!r}", expected="at least one transition", actual="none")
    target = dataset_path(dataset_id)
    new_folders = [folder for folder in target.parents if not folder.exists()]
    metadata: dict[str, Any] = {RECORDING: recording}
    scratch = ExitStack()
    try:
        if building is None:
            # Hidden from Minari's listing; in the store, so that the rename stays in one file system.
            building = scratch.enter_context(scratch_folder(dataset_path("")))
        building.mkdir(exist_ok=True)
        data = building / "data"
        if extend:
            open_dataset(target)  # what is damaged must not be sealed anew
            shutil.copytree(target / "data", data)
            storage = open_dataset(building, sums=False).storage
        else:
            storage = MinariStorage.new(
                data, observation_space=observation_space, action_space=action_space, env_spec=env_spec
            )
            metadata |= {
                "dataset_id": dataset_id,
                "minari_version": importlib.metadata.version("minari"),
                "algorithm_name": algorithm_name,
                "description": description,
                NAMES: list(names) or None,
            }
        store_episodes(storage, itertools.chain([first], iterator), new=not extend)
        finish(building, {key: value for key, value in metadata.items() if value is not None})
        declare_namespace(dataset_id)
        publish(building, target, overwrite=overwrite)
    except (OSError, RuntimeError) as error:
        _undeclare_namespace(target, new_folders)
        if isinstance(error, MPCOfflineError) or (isinstance(error, OSError) and error.errno == errno.ENOTEMPTY):
            raise
        # h5py reports a full disk as either, and once more when it closes the file.
        raise StorageError.of(target, error) from error
    finally:
        if building is not None:
            shutil.rmtree(building, ignore_errors=True)
        scratch.close()
    return open_dataset(target, sums=False)


def finish(building: Path, metadata: dict[str, Any]) -> None:
    """Completes a data set's folder: data on the disk, then its metadata, then the manifest of both."""
    sync_tree(building)
    path = building / "data" / "metadata.json"
    write_file(path, json.dumps(json.loads(path.read_text(encoding="utf-8")) | metadata))
    write_manifest(building)
    building.chmod(0o755)


def declare_namespace(dataset_id: str) -> None:
    """Creates Minari's record of the namespace, which its remotes ask for."""
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.namespace import create_namespace, list_local_namespaces

    namespace, _, _ = parse_dataset_id(dataset_id)
    if namespace is not None and namespace not in list_local_namespaces():
        try:
            create_namespace(namespace)
        except ValueError:
            # Another process declared it in the meantime; anything else is an error.
            if namespace not in list_local_namespaces():
                raise


def _undeclare_namespace(target: Path, new_folders: list[Path]) -> None:
    """Removes the records that :func:`declare_namespace` could not write, and the folders made for them."""
    for folder in target.relative_to(dataset_path("")).parents:
        record = dataset_path("") / folder / "namespace_metadata.json"
        if record.exists() and (record.parent in new_folders or record.stat().st_size == 0):
            record.unlink(missing_ok=True)
        if record.parent in new_folders:
            with contextlib.suppress(OSError):  # another process's data set has come into it
                record.parent.rmdir()
