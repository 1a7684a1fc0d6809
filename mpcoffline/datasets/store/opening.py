"""The one door to a stored Minari data set: everything that reads one comes through here.

Minari makes the environment, and so imports and calls what ``metadata.json`` says, where the spaces are not stored; it
allocates what the counts say, opens whatever has the right name, and compares nothing with the manifest. Here the
files are looked over first. What was found good is remembered for as long as each file's inode, size, and times of
modification and of status change are the same, so that this is done once.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from mpcoffline.core.caches import read_note, write_note
from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.files import check_regular, read_limited
from mpcoffline.core.limits import (
    EPISODE_BYTES,
    FOLDER_ENTRIES,
    METADATA_BYTES,
    SPACE_DEPTH,
    SPACE_ELEMENTS,
    check_limit,
)
from mpcoffline.core.places import cache_folder

from .hdf5_guard import check_episodes, check_hdf5
from .ids import dataset_path, is_valid_id
from .manifest import MANIFEST, differences

if TYPE_CHECKING:
    from minari import MinariDataset

DATA_FILE = "main_data.hdf5"
_SETTLED = 100_000_000  # ns; a file changed later than that could change again without another time
_RECORD_VERSION = 1
_found_here: dict[Path, str] = {}  # by this process: saves it the record
_T = TypeVar("_T")


def open_dataset(folder: Path, *, sums: bool = True) -> MinariDataset:
    """Opens the data set of a folder, anywhere, without importing or making anything that its files name.

    Args:
        folder: The folder that holds ``data``.
        sums: Whether the files must be those of its manifest, where there is one, and as many rows must be there as
            the metadata say. Only a reader who reports on both himself leaves it to himself.

    Raises:
        FileFormatError: For damage, special files, files or spaces beyond the limits, links to elsewhere, and
            anything else that Minari cannot read, or would have to import something for.
    """
    from minari import MinariDataset

    if sums:
        check_stored(folder)
    else:
        _or_incomplete(folder, check_data)
    return _or_incomplete(folder, lambda folder: MinariDataset(folder / "data"))


def open_to_examine(folder: Path) -> tuple[MinariDataset, dict[str, str]]:
    """Opens a data set of which some episodes may be damaged.

    Returns:
        The data set, and for each group that must not be read why.

    Raises:
        FileFormatError: Where it is damaged as a whole.
    """
    from minari import MinariDataset

    faults = _or_incomplete(folder, faults_of)
    return _or_incomplete(folder, lambda folder: MinariDataset(folder / "data")), faults


def faults_of(folder: Path) -> dict[str, str]:
    """For each group of an HDF5 data set that must not be read why.

    Raises:
        FileFormatError: Where it is damaged as a whole.
    """
    if read_metadata(folder)["data_format"] != "hdf5":
        check_data(folder)
        return {}
    return {name: fault for name, fault in check_episodes(folder / "data" / DATA_FILE).items() if fault}


def check_stored(folder: Path) -> None:
    """Refuses a data set whose files are not sound, or not those of its manifest; done once for each state of them.

    Raises:
        FileFormatError: Naming what is wrong and what to do next.
    """
    _or_incomplete(folder, _check_stored)


def _check_stored(folder: Path) -> None:
    state = _state(folder)
    if _is_known(folder, state):
        return
    episodes, steps = check_data(folder)
    metadata = read_metadata(folder)
    counts = (metadata["total_episodes"], metadata["total_steps"])
    if steps >= 0 and counts != (episodes, steps):
        raise FileFormatError(
            "counts",
            expected=f"{counts[0]} episodes of {counts[1]} steps, as its metadata say",
            actual=f"{episodes} of {steps}",
        )
    check_sums(folder)
    if state == _state(folder):
        _remember(folder, state)


def check_sums(folder: Path) -> None:
    """Refuses files that are not those of the folder's manifest; without a manifest there is nothing to compare.

    Raises:
        FileFormatError: Telling damage from a change by another program, where the dates do.
    """
    name = _id_of(folder)
    try:
        wrong = [difference for difference in differences(folder) if difference.concerns_data]
    except FileNotFoundError:
        return
    except FileFormatError as error:
        hint = f"If the data are good, `mpcoffline datasets verify {name} --accept` writes {MANIFEST} anew."
        raise FileFormatError(error.name, expected=error.expected, actual=error.actual, hint=hint) from error
    if not wrong:
        return
    hint = f"Restore it from a copy, or download it again. `mpcoffline datasets verify {name}` says what is wrong."
    if was_changed(folder, [difference.path for difference in wrong]):
        hint = (
            f"It was changed after {MANIFEST} was written, as Minari's own tools do. If that was you:"
            f" `mpcoffline datasets verify {name} --accept`. Otherwise restore it from a copy."
        )
    raise FileFormatError(
        f"data set in {folder}: {wrong[0].path}", expected=wrong[0].expected, actual=wrong[0].actual, hint=hint
    )


def was_changed(folder: Path, paths: list[str]) -> bool:
    """Whether all these files, where they are there, were written after the manifest; bits that rot leave no date."""
    times = [(folder / path).stat().st_mtime_ns for path in paths if (folder / path).exists()]
    return bool(times) and min(times) > (folder / MANIFEST).stat().st_mtime_ns


def check_data(folder: Path) -> tuple[int, int]:
    """Refuses data that are no regular files, point elsewhere or declare more than is there.

    Returns:
        Numbers of episodes and of steps that are there; -1 steps where only reading them would tell.

    Raises:
        FileFormatError: Naming the file.
    """
    metadata = read_metadata(folder)
    if metadata["data_format"] != "hdf5":
        entries = sum(1 for _ in _files(folder / "data"))
        check_limit(str(folder), "episodes in that many files", metadata["total_episodes"], entries)
        return entries, -1
    rows = check_hdf5(folder / "data" / DATA_FILE)
    if metadata["total_episodes"] == len(rows):
        missing = next((f"episode_{i}" for i in range(len(rows)) if rows.get(f"episode_{i}", -1) < 0), None)
        if missing is not None:
            raise FileFormatError(
                f"file {folder / 'data' / DATA_FILE}", expected=f"a group {missing} with rewards", actual="none"
            )
    return len(rows), sum(rows.values())


def read_metadata(folder: Path) -> dict[str, Any]:
    """The metadata of a data set's folder, with spaces, counts and id that can be believed.

    Raises:
        FileFormatError: For anything else.
        OSError: Where there are none.
    """
    path = folder / "data" / "metadata.json"
    try:
        metadata = json.loads(read_limited(path, METADATA_BYTES))
    except (ValueError, RecursionError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(str(path), expected="JSON", actual=str(error) or "too many levels") from error
    if not isinstance(metadata, dict):
        raise FileFormatError(str(path), expected="a JSON object", actual=type(metadata).__name__)
    for key in ("observation_space", "action_space"):
        if not isinstance(metadata.get(key), str):
            raise FileFormatError(
                str(path),
                expected=f"a stored {key}",
                actual="none: Minari would import and make the environment that the file names",
            )
        check_space(f"{path}: {key}", metadata[key])
    for key in ("total_episodes", "total_steps"):
        if type(metadata.get(key)) is not int or metadata[key] < 0:
            raise FileFormatError(f"{path}: {key}", expected="a number of them", actual=repr(metadata.get(key))[:80])
    if not is_valid_id(metadata.get("dataset_id")):
        found = repr(metadata.get("dataset_id"))[:80]
        raise FileFormatError(f"{path}: dataset_id", expected="the id of a data set", actual=found)
    if metadata.get("data_format") not in ("hdf5", "arrow"):
        found = repr(metadata.get("data_format"))[:80]
        raise FileFormatError(f"{path}: data_format", expected="'hdf5' or 'arrow'", actual=found)
    if metadata["data_format"] == "hdf5":
        size = check_regular(folder / "data" / DATA_FILE).st_size
        check_limit(f"{path}: total_episodes", f"in {size} bytes", metadata["total_episodes"], size // EPISODE_BYTES)
    return metadata


def check_space(name: str, text: str) -> None:
    """Refuses a space, as Minari stores it, that would take more room than its description.

    Args:
        name: What error messages call it.
        text: Its JSON.

    Raises:
        FileFormatError: For too many numbers or levels, or values that are no plain numbers.
    """
    try:
        _check_space(name, json.loads(text), SPACE_DEPTH)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(
            name, expected="a space as Minari stores it", actual=f"{type(error).__name__}: {str(error)[:200]}"
        ) from error


def _check_space(name: str, space: Any, depth: int) -> None:
    if depth == 0:
        raise FileFormatError(name, expected=f"at most {SPACE_DEPTH} spaces within each other", actual="more")
    kind = space["type"]
    if kind in ("Dict", "Tuple"):
        inner = space["subspaces"]
        for part in inner.values() if kind == "Dict" else inner:
            _check_space(name, part, depth - 1)
        return
    if "dtype" in space and (len(space["dtype"]) > 16 or np.dtype(space["dtype"]).kind not in "fiub"):
        raise FileFormatError(name, expected="numbers", actual=repr(space["dtype"])[:80])
    if kind in ("Box", "MultiBinary"):
        size = space["shape"] if kind == "Box" else space["n"]
        shape = [int(n) for n in size] if isinstance(size, list) else [int(size)]
        if min(shape, default=0) < 0:
            raise FileFormatError(name, expected="sizes from 0", actual=str(shape)[:80])
        check_limit(name, "numbers", math.prod(shape), SPACE_ELEMENTS)


def _files(folder: Path) -> Iterator[Path]:
    """Files below a folder, links followed; refuses special ones."""
    for number, path in enumerate(sorted(folder.rglob("*"))):
        check_limit(str(folder), "files", number, FOLDER_ENTRIES)
        if not path.is_dir():
            check_regular(path)
            yield path


# What was found good


def _state(folder: Path) -> str:
    """A hash over what the system says of each file: it changes with each of them."""
    lines: list[str] = []
    newest = 0
    for path in _paths(os.fspath(folder)):
        try:
            status = os.stat(path)
        except FileNotFoundError:
            continue
        check_limit(str(folder), "files", len(lines), FOLDER_ENTRIES)
        newest = max(newest, status.st_ctime_ns)
        numbers = (status.st_ino, status.st_dev, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
        lines.append(f"{os.fsencode(path)!r} {numbers}")
    settled = time.time_ns() - newest > _SETTLED
    return hashlib.sha256("\n".join(lines).encode()).hexdigest() if settled else ""


def _paths(folder: str) -> Iterator[str]:
    """The manifest, and all below ``data`` in a fixed order; without pathlib, since this is done at every opening."""
    yield os.path.join(folder, MANIFEST)
    folders = [os.path.join(folder, "data")]
    while folders:
        try:
            entries = sorted(os.scandir(folders.pop()), key=lambda entry: entry.name)
        except (FileNotFoundError, NotADirectoryError):
            continue
        folders += [entry.path for entry in entries if entry.is_dir(follow_symlinks=False)]
        yield from (entry.path for entry in entries)


def _is_known(folder: Path, state: str) -> bool:
    if not state:
        return False
    if _found_here.get(folder) == state:
        return True
    with suppress(OSError):
        if read_note(cache_folder("checked"), folder) == {"version": _RECORD_VERSION, "state": state}:
            _found_here[folder] = state
            return True
    return False


def _remember(folder: Path, state: str) -> None:
    """Only ever saves time: where it cannot be kept, the next reader looks again."""
    if not state:
        return
    _found_here[folder] = state
    with suppress(OSError, RuntimeError):
        write_note(cache_folder("checked"), folder, {"version": _RECORD_VERSION, "state": state})


def _id_of(folder: Path) -> str:
    """The id of a folder in the local store; its path for any other."""
    try:
        return folder.relative_to(dataset_path("")).as_posix()
    except ValueError:
        return str(folder)


def _or_incomplete(folder: Path, read: Callable[[Path], _T]) -> _T:
    """What a reader gives; whatever it raises says which data set it is, and what to do next."""
    try:
        return read(folder)
    except Exception as error:  # assertions, lookups, versions: whatever a damaged file makes Minari do
        if isinstance(error, FileFormatError) and error.hint:
            raise
        said = str(error).rstrip(".") if isinstance(error, FileFormatError) else f"{type(error).__name__}: {error}"
        raise FileFormatError(
            f"data set in {folder}",
            expected="a complete Minari data set",
            actual=said,
            hint=f"Try `mpcoffline datasets repair {_id_of(folder)}`, or remove that folder; a shipped data set comes"
            " back when it is loaded again.",
        ) from error
