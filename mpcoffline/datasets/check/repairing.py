"""Making a data set whole again that a crash has left in pieces."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from mpcoffline.core.atomic import publish
from mpcoffline.core.errors import FileFormatError, StorageError, UnknownIdError
from mpcoffline.core.files import check_regular, read_limited
from mpcoffline.core.limits import METADATA_BYTES
from mpcoffline.core.scratch import scratch_folder
from mpcoffline.core.text import visible
from mpcoffline.datasets.recording.session import seal
from mpcoffline.datasets.store.hdf5_guard import check_episodes, episode_number
from mpcoffline.datasets.store.hdf5_writing import SteadyFile, checked, write_steadily
from mpcoffline.datasets.store.ids import backup_path, check_dataset_id, dataset_path, is_local
from mpcoffline.datasets.store.local import list_datasets
from mpcoffline.datasets.store.manifest import MANIFEST, differences
from mpcoffline.datasets.store.opening import DATA_FILE, check_space, open_dataset
from mpcoffline.datasets.store.recording_lock import RecordingLock, log_files, recording_path
from mpcoffline.datasets.store.writing import finish, recording_of

_STEPS = ("actions", "rewards", "terminations", "truncations")


@dataclass(frozen=True)
class RepairReport:
    """What :func:`repair` did.

    Attributes:
        dataset_id: Minari id.
        action: ``"sealed"`` (the data set was made of a recording's logs), ``"salvaged"`` (of what is intact of them),
            ``"rebuilt"`` (of the readable episodes of its HDF5 file), or ``"intact"`` (nothing was to be done).
        episodes: Number of episodes that the data set has now.
        steps: Number of transitions that the data set has now.
        notes: What was lost or had to be guessed, one sentence each.
        backup: Where the data set is kept as it was found; None where it was not changed.
    """

    dataset_id: str
    action: str
    episodes: int
    steps: int
    notes: tuple[str, ...] = ()
    backup: Path | None = None

    def __str__(self) -> str:
        lines = [f"{self.dataset_id}: {self.action}, {self.episodes} episodes, {self.steps} steps."]
        kept = [] if self.backup is None else [f"As it was found: {self.backup}"]
        return visible("\n  ".join([*lines, *self.notes, *kept]))


def repair(dataset_id: str, *, env_spec: EnvSpec | None = None, salvage: bool = False) -> RepairReport:
    """Makes a data set readable again: from the logs of its recording, or from what its HDF5 file still holds.

    Repairs what a killed recorder leaves (logs that are not sealed), and what a killed Minari leaves (an empty
    ``metadata.json``, a half-written episode, counts that do not fit). Episodes are copied as they are, with all that
    stands beside them, and so are all entries of the metadata that can be read. What is found is kept as a backup.

    Numbers that have changed cannot be told from those that have not: a data set that is readable but not what its
    manifest says is refused, and one that must be rebuilt although its data are not, says so in a note.

    Args:
        dataset_id: Minari id.
        env_spec: Spec of the environment, where the metadata that knew it are lost.
        salvage: Whether to take what is intact of logs that are damaged, which are refused otherwise. The notes say
            what is missing; the logs are kept.

    Raises:
        InvalidArgumentError: For a malformed id, or a recorder at work on it.
        UnknownIdError: Where there is neither such a data set nor a recording of it.
        FileFormatError: Where nothing can be read, or the files are readable but not those of the manifest; nothing is
            changed then.
        StorageError: Where the disk refuses; nothing is changed then.
    """
    check_dataset_id(dataset_id)
    if log_files(dataset_id):
        if is_local(dataset_id) and recording_of(dataset_id) is None and not _is_readable(dataset_id):
            raise FileFormatError(
                f"data set {dataset_id!r}",
                expected="an intact data set, or none, beside a recording of that id",
                actual=f"a damaged one in {dataset_path(dataset_id)}",
                hint="Move that folder away, then repair again: the recording takes its place.",
            )
        sealed, lost, kept = seal(dataset_id, salvage=salvage)
        counts = int(sealed.total_episodes), int(sealed.total_steps)
        return RepairReport(dataset_id, "salvaged" if lost else "sealed", *counts, tuple(lost), kept)
    if recording_path(dataset_id).exists():
        RecordingLock(dataset_id).release()  # an empty recording: only its folder is left
    if not dataset_path(dataset_id).is_dir():
        raise UnknownIdError.of("data set id", dataset_id, [row.id for row in list_datasets()])
    return _repair_stored(dataset_id, env_spec)


def _repair_stored(dataset_id: str, env_spec: EnvSpec | None) -> RepairReport:
    path = dataset_path(dataset_id) / "data" / DATA_FILE
    metadata = _metadata(dataset_id)
    if metadata.get("data_format", "hdf5") != "hdf5":
        raise FileFormatError(
            f"data set {dataset_id!r}", expected="format 'hdf5'", actual=repr(metadata.get("data_format"))
        )
    with _open(path) as file:
        good, notes = _inspect(file, path)
        steps = sum(len(file[f"{name}/rewards"]) for name in good)
        counts = (metadata.get("total_episodes"), metadata.get("total_steps"))
        if not notes and counts == (len(good), steps) and _is_intact(dataset_id):
            return RepairReport(dataset_id, "intact", len(good), steps)
        if not good:
            raise FileFormatError(f"file {path}", expected="a readable episode", actual="none")
        _note_changes(dataset_id, notes)
        observed, acted = (_space(metadata, kind, file[good[0]], notes) for kind in ("observation", "action"))
        spec = _env_spec(metadata, notes) if env_spec is None else env_spec.to_json()
        kept = _kept(metadata, notes) | {
            "dataset_id": dataset_id,
            "minari_version": importlib.metadata.version("minari"),
            "data_format": "hdf5",
            "jpeg_encoding": bool(metadata.get("jpeg_encoding", True)),
            "observation_space": observed,
            "action_space": acted,
            "total_episodes": len(good),
            "total_steps": steps,
        }
        kept = {key: value for key, value in kept.items() if key != "env_spec"}
        backup = _rebuild(dataset_id, file, good, kept if spec is None else kept | {"env_spec": spec})
    dataset = open_dataset(dataset_path(dataset_id), sums=False)
    return RepairReport(
        dataset_id, "rebuilt", int(dataset.total_episodes), int(dataset.total_steps), tuple(notes), backup
    )


def _rebuild(dataset_id: str, file: Any, names: list[str], metadata: dict[str, Any]) -> Path:
    """Puts a data set of these groups of a file in the place of the damaged one; returns where that is kept."""

    def copy(new_file: SteadyFile) -> None:
        with h5py.File(new_file, "w", track_order=True) as new:
            for number, name in enumerate(checked(names, new_file)):
                file.copy(name, new, f"episode_{number}")
                new[f"episode_{number}"].attrs["id"] = number

    target = dataset_path(dataset_id)
    try:
        with scratch_folder(dataset_path("")) as building:
            data = building / "data"
            data.mkdir()
            (data / DATA_FILE).touch()
            write_steadily(data / DATA_FILE, copy)
            (data / "metadata.json").write_text(json.dumps(metadata), encoding="utf-8")
            finish(building, {})
            backup = _back_up(dataset_id)
            publish(building, target, overwrite=True)
    except (OSError, RuntimeError) as error:
        raise StorageError.of(target, error) from error
    return backup


def _open(path: Path) -> Any:
    try:
        check_regular(path)
        return h5py.File(path, "r")
    except OSError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> FileFormatError:
    return FileFormatError(
        f"file {path}",
        expected="an HDF5 file that can be opened",
        actual=str(error),
        hint="Nothing can be read from it; nothing was changed.",
    )


def _metadata(dataset_id: str) -> dict[str, Any]:
    try:
        found = json.loads(read_limited(dataset_path(dataset_id) / "data" / "metadata.json", METADATA_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _inspect(file: Any, path: Path) -> tuple[list[str], list[str]]:
    """Names of the groups that hold a whole episode, in order, and a sentence for each other one."""
    good, notes = [], []
    try:
        checked = check_episodes(path)
    except (OSError, RuntimeError) as error:
        raise _unreadable(path, error) from error
    numbered = {number: name for name in checked if (number := episode_number(name)) is not None}
    for _, name in sorted(numbered.items()):
        reason = checked[name]
        try:
            reason = reason or _fault(file[name])
        except (KeyError, OSError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            reason = f"{type(error).__name__}: {error}"
        if reason:
            notes.append(f"{name} is left out: {reason}.")
        else:
            good.append(name)
    return good, notes


def _fault(group: Any) -> str:
    """What keeps a group from being a whole episode; empty if nothing. Its arrays are read to the end."""
    steps = len(group["rewards"])
    lengths = dict(_lengths(group["observations"], "observations"))
    for key in _STEPS:
        lengths |= _lengths(group[key], key)
    infos = _lengths(group["infos"], "infos") if "infos" in group else {}
    odd = [key for key in _STEPS[1:] if getattr(group[key], "dtype", np.dtype("O")).kind not in "fiub"]
    if odd:
        return f"{', '.join(odd)} that are no numbers"
    wrong = [key for key, n in lengths.items() if n != steps + key.startswith("observations")]
    wrong += [key for key, n in infos.items() if n != steps + 1]
    return f"unequal lengths of {', '.join(wrong)}" if wrong else "" if steps else "no step"


def _lengths(member: Any, name: str) -> dict[str, int]:
    """Rows of an array, or of all arrays of a group (spaces and infos within others), each of which is read."""
    if isinstance(member, h5py.Dataset):
        member[()]
        return {name: len(member)}
    return {key: n for inner in member for key, n in _lengths(member[inner], f"{name}/{inner}").items()}


def _note_changes(dataset_id: str, notes: list[str]) -> None:
    """Says so where the data that are kept are not those of the manifest."""
    try:
        changed = [difference.path for difference in differences(dataset_path(dataset_id))]
    except FileNotFoundError:
        return
    except (FileFormatError, OSError) as error:
        notes.append(f"Whether numbers have changed is unknown: {error}")
        return
    if f"data/{DATA_FILE}" in changed:
        notes.append(
            f"{DATA_FILE} is not what {MANIFEST} says: numbers in the episodes that are kept may be wrong."
            f" The new {MANIFEST} is of the files as they are now."
        )


def _space(metadata: dict[str, Any], kind: str, group: Any, notes: list[str]) -> str:
    """The stored space as Minari writes it; where it is lost, one that fits the data."""
    stored = metadata.get(f"{kind}_space")
    if isinstance(stored, str):
        from minari.serialization import deserialize_space

        try:
            check_space(kind, stored)
            deserialize_space(stored)
            return stored
        except (ValueError, LookupError, TypeError, AttributeError, AssertionError, ArithmeticError, RuntimeError):
            pass
    from minari.serialization import serialize_space

    values = group[f"{kind}s"]
    notes.append(f"The {kind} space is lost; an unbounded Box of shape {values.shape[1:]} takes its place.")
    return str(serialize_space(spaces.Box(-np.inf, np.inf, values.shape[1:], values.dtype)))


def _kept(metadata: dict[str, Any], notes: list[str]) -> dict[str, Any]:
    """The entries of the metadata that Minari can read again."""
    kept = dict(metadata)
    for key in ("author", "author_email", "eval_env_spec"):
        value = metadata.get(key)
        good = isinstance(value, list) and all(isinstance(text, str) for text in value)
        if key == "eval_env_spec":
            good = value is None or _is_spec(value)
        if key in kept and not good:
            del kept[key]
            notes.append(f"{key} is left out of the metadata: it cannot be read.")
    return kept


def _is_spec(text: object) -> bool:
    try:
        EnvSpec.from_json(str(text))
    except (ValueError, TypeError, KeyError, AttributeError, gym.error.Error):
        return False
    return isinstance(text, str)


def _env_spec(metadata: dict[str, Any], notes: list[str]) -> str | None:
    stored = metadata.get("env_spec")
    if stored is None and metadata:
        return None
    if _is_spec(stored):
        return str(stored)
    notes.append("The environment's spec is lost; repair(..., env_spec=...) can give it.")
    return None


def _is_intact(dataset_id: str) -> bool:
    """Whether it can be opened.

    Raises:
        FileFormatError: Where it could be, but is not what its manifest says.
    """
    folder = dataset_path(dataset_id)
    try:
        open_dataset(folder, sums=False)
    except FileFormatError:
        return False
    open_dataset(folder)
    return True


def _is_readable(dataset_id: str) -> bool:
    try:
        open_dataset(dataset_path(dataset_id))
    except FileFormatError:
        return False
    return True


def _back_up(dataset_id: str) -> Path:
    """Keeps the folder as it is under another, hidden name: links where they can be, so that it needs no room yet."""
    source, backup = dataset_path(dataset_id), backup_path(dataset_id)
    backup.parent.mkdir(parents=True, exist_ok=True)
    try:
        shutil.copytree(source, backup, copy_function=_link_or_copy, ignore=_special)
    except OSError:
        shutil.rmtree(backup, ignore_errors=True)
        raise
    return backup


def _link_or_copy(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # another disk, or a file system without links
        shutil.copy2(source, target)


def _special(folder: str, names: list[str]) -> list[str]:
    """What is neither file nor folder cannot be kept."""
    paths = {name: Path(folder) / name for name in names}
    return [name for name, path in paths.items() if not (path.is_file() or path.is_dir())]
