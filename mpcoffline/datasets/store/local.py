"""What this machine has: data sets in the local Minari store, and those that this package ships."""

from __future__ import annotations

import importlib.resources
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpcoffline.core.errors import FileFormatError, MPCOfflineError, UnknownIdError
from mpcoffline.datasets.recipes import Recipe, catalog_file, recorded_tasks

from .ids import dataset_path, is_local, is_valid_id
from .manifest import MANIFEST, parse_manifest, sha256_of
from .opening import open_dataset, read_metadata
from .packed import packed_size, unpack

if TYPE_CHECKING:
    from minari import MinariDataset


@dataclass(frozen=True)
class DatasetRow:
    """A data set that :func:`~mpcoffline.load_dataset` can give.

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


def is_here(dataset_id: str) -> bool:
    """Whether :func:`open_local` gives it."""
    return is_valid_id(dataset_id) and (is_local(dataset_id) or dataset_id in shipped_datasets())


def open_local(dataset_id: str) -> MinariDataset:
    """Gives a data set out of the local Minari store, into which a shipped one is put when it is first asked for.

    Args:
        dataset_id: Minari id.

    Raises:
        UnknownIdError: For an id that is not on this machine; it names the nearest ones.
        FileFormatError: For a damaged data set, or a shipped file that does not have its sha256.
    """
    if is_here(dataset_id):
        return open_dataset(dataset_path(dataset_id)) if is_local(dataset_id) else _unpacked(dataset_id)
    known = {*local_datasets(), *shipped_datasets()}
    raise UnknownIdError.of("data set id", dataset_id, known, hint="`mpcoffline collect` records a new one.")


def list_datasets() -> list[DatasetRow]:
    """All data sets that :func:`~mpcoffline.load_dataset` can give, sorted by id."""
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


def _unpacked(dataset_id: str) -> MinariDataset:
    """Puts a shipped data set into the store, after checking that its file is the one that was shipped."""
    task = shipped_datasets()[dataset_id]
    file = f"{task}.h5"
    expected = parse_manifest(catalog_file(MANIFEST, task).read_bytes()).get(file, "(none listed)")
    with importlib.resources.as_file(catalog_file(file, task)) as path:
        if (actual := sha256_of(path)) != expected:
            raise FileFormatError(
                f"shipped file {path}", expected=f"sha256 {expected}", actual=actual, hint="Reinstall mpcoffline."
            )
        try:
            return unpack(path, dataset_id)
        except (OSError, MPCOfflineError):
            # Another process was faster: its copy is as good as ours.
            if not is_local(dataset_id):
                raise
            return open_dataset(dataset_path(dataset_id))
