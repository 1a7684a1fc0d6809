"""The Minari store on this machine: finding, loading and writing data sets, atomically."""

from __future__ import annotations

import contextlib
import difflib
import errno
import hashlib
import importlib.metadata
import importlib.resources
import itertools
import json
import os
import shutil
import warnings
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from mpcoffline.core.atomic import publish, sync_tree
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, MPCOfflineError, StorageError, UnknownIdError
from mpcoffline.core.scratch import scratch_folder
from mpcoffline.datasets.recipes import Recipe, catalog_file, recorded_tasks

from .ids import GRAMMAR, is_valid_id
from .manifest import write_manifest
from .opening import open_dataset, read_metadata
from .recording_lock import check_not_recorded
from .writing import store_episodes

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer

RECORDING = "mpcoffline_recording"


@dataclass(frozen=True)
class DatasetRow:
    """A data set that :func:`load_dataset` can give.

    Attributes:
        id: Minari id.
        where: ``"local"`` (in the Minari store) or ``"shipped"`` (with this package, not yet in the store).
        episodes: Number of episodes.
        steps: Number of transitions.
    """

    id: str
    where: str
    episodes: int
    steps: int


def load_dataset(dataset_id: str, *, download: bool = True) -> MinariDataset:
    """Gives a data set: out of the local Minari store, shipped with this package, or from the remote.

    A shipped data set is put into the store when it is first asked for (about two seconds); after that
    ``minari.load_dataset`` finds it without this package. A download that was finished but not yet put into the
    store needs no connection; a remote is asked only where one is configured (``MINARI_REMOTE``, or the catalogue).

    Args:
        dataset_id: Minari id, e.g. ``"mpcoffline/pendulum/ddpg-v0"``.
        download: Whether a remote may be asked.

    Raises:
        UnknownIdError: For an id that is nowhere; it names the nearest ones.
        FileFormatError: For a damaged data set, or a shipped file that does not have its sha256.
        RemoteError: Where the remote does not answer.
    """
    if is_valid_id(dataset_id):
        if is_local(dataset_id):
            return open_dataset(dataset_path(dataset_id))
        if dataset_id in shipped_datasets():
            return _materialise(dataset_id, shipped_datasets()[dataset_id])
        if download:
            from mpcoffline.datasets.hub.transfer import download_dataset, find_source

            if find_source(dataset_id) is not None:
                return download_dataset(dataset_id)
    known = sorted({*local_datasets(), *shipped_datasets()})
    nearest = difflib.get_close_matches(str(dataset_id), known, n=3, cutoff=0.4)
    hint = f"Did you mean {' or '.join(repr(name) for name in nearest)}? " if nearest else ""
    raise UnknownIdError.of(
        "data set id", str(dataset_id), known, hint=f"{hint}`mpcoffline collect` records a new one."
    )


def list_datasets() -> list[DatasetRow]:
    """All data sets that :func:`load_dataset` can give, sorted by id."""
    from .packed import packed_size

    rows = {
        name: DatasetRow(name, "local", metadata["total_episodes"], metadata["total_steps"])
        for name, metadata in local_datasets().items()
    }
    for name, task in shipped_datasets().items():
        if name not in rows:
            with importlib.resources.as_file(catalog_file(f"{task}.h5", task)) as path:
                rows[name] = DatasetRow(name, "shipped", *packed_size(path))
    return [rows[name] for name in sorted(rows)]


def local_datasets() -> dict[str, dict[str, Any]]:
    """The data sets of the local store: id to metadata, sorted by id.

    Minari's own list fails as a whole where one folder has a name or metadata that it does not expect; here such a
    folder is left out, with a warning, and hides none of the others.
    """
    found = {}
    for dataset_id in sorted(_stored_ids(dataset_path(""), "", set())):
        try:
            metadata = read_metadata(dataset_path(dataset_id))
            if metadata["dataset_id"] != dataset_id:
                raise FileFormatError(
                    f"data set in {dataset_path(dataset_id)}",
                    expected="the id of its folder",
                    actual=repr(metadata["dataset_id"]),
                )
            found[dataset_id] = metadata
        except (FileFormatError, OSError) as error:
            warnings.warn(f"Not listed: {dataset_id!r}. {error}", stacklevel=3)
    return found


def _stored_ids(folder: Path, prefix: str, above: set[str]) -> Iterator[str]:
    """Ids of the folders that hold ``data``; links are followed, but not back to where they come from."""
    try:
        place = os.path.realpath(folder)
        names = sorted(entry.name for entry in os.scandir(folder) if entry.is_dir() and entry.name[0] != ".")
    except OSError:
        return
    if place in above:
        return
    for name in names:
        dataset_id = f"{prefix}{name}"
        if is_valid_id(dataset_id):
            if (folder / name / "data").exists():
                yield dataset_id
        else:
            yield from _stored_ids(folder / name, f"{dataset_id}/", above | {place})


def shipped_datasets() -> dict[str, str]:
    """The shipped data sets: Minari id to the name of the task, and so of the packed file in its catalogue."""
    packed = [task for task in recorded_tasks() if catalog_file(f"{task}.h5", task).is_file()]
    return {Recipe.load(task).dataset_id: task for task in packed}


def dataset_path(dataset_id: str) -> Path:
    """The folder of a data set in the local Minari store, whether it exists or not."""
    from minari.storage import get_dataset_path

    return Path(get_dataset_path(dataset_id))


def is_local(dataset_id: str) -> bool:
    """Whether the local Minari store holds the data set."""
    return (dataset_path(dataset_id) / "data").exists()


def check_dataset_id(dataset_id: object) -> None:
    """Refuses an id that Minari could not parse, or would take for something else.

    Raises:
        InvalidArgumentError: Naming Minari's grammar.
    """
    if not is_valid_id(dataset_id):
        raise InvalidArgumentError("dataset_id", expected=f"an id {GRAMMAR}", actual=repr(dataset_id))


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
    metadata = {RECORDING: recording}
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
            }
        store_episodes(storage, itertools.chain([first], iterator), new=not extend)
        finish(building, {key: value for key, value in metadata.items() if value is not None})
        _declare_namespace(dataset_id)
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


def finish(building: Path, metadata: dict[str, str]) -> None:
    """Completes a data set's folder: data on the disk, then its metadata, then the manifest of both."""
    sync_tree(building)
    path = building / "data" / "metadata.json"
    complete = json.loads(path.read_text(encoding="utf-8")) | metadata
    new = path.with_suffix(".new")
    new.write_text(json.dumps(complete), encoding="utf-8")
    os.replace(new, path)
    write_manifest(building)
    building.chmod(0o755)


def _materialise(dataset_id: str, task: str) -> MinariDataset:
    """Puts a shipped data set into the store, after checking that its file is the one that was shipped."""
    from .packed import unpack

    file, sums = f"{task}.h5", catalog_file("SHA256SUMS", task).read_text(encoding="utf-8").splitlines()
    expected = {name: digest for digest, name in (line.split() for line in sums if line.strip())}
    with importlib.resources.as_file(catalog_file(file, task)) as path:
        actual = hashlib.sha256(path.read_bytes()).hexdigest()
        if actual != expected.get(file):
            raise FileFormatError(
                f"shipped file {path}",
                expected=f"sha256 {expected.get(file, '(none listed)')}",
                actual=actual,
                hint="Reinstall mpcoffline.",
            )
        try:
            return unpack(path, dataset_id)
        except (OSError, MPCOfflineError):
            # Another process was faster: its copy is as good as ours.
            if not is_local(dataset_id):
                raise
            return open_dataset(dataset_path(dataset_id))


def _declare_namespace(dataset_id: str) -> None:
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
    """Removes the records that :func:`_declare_namespace` could not write, and the folders made for them."""
    for folder in target.relative_to(dataset_path("")).parents:
        record = dataset_path("") / folder / "namespace_metadata.json"
        if record.exists() and (record.parent in new_folders or record.stat().st_size == 0):
            record.unlink(missing_ok=True)
        if record.parent in new_folders:
            with contextlib.suppress(OSError):  # another process's data set has come into it
                record.parent.rmdir()
