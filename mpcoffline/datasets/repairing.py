"""Making a data set whole again that a crash has left in pieces."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from mpcoffline.errors import FileFormatError, UnknownIdError

from .minari_store import check_dataset_id, dataset_path, is_local, list_datasets, recording_of, write_dataset
from .recording import seal
from .recording_lock import RecordingLock, log_files, recording_path

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer

_STEPS = ("actions", "rewards", "terminations", "truncations")


@dataclass(frozen=True)
class RepairReport:
    """What :func:`repair` did.

    Attributes:
        dataset_id: Minari id.
        action: ``"sealed"`` (the data set was made of a recording's logs), ``"salvaged"`` (of what is intact of them),
            ``"rebuilt"`` (of the readable
            episodes of its HDF5 file), or ``"intact"`` (nothing was to be done).
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
        return "\n  ".join([*lines, *self.notes, *kept])


def repair(dataset_id: str, *, env_spec: EnvSpec | None = None, salvage: bool = False) -> RepairReport:
    """Makes a data set readable again: from the logs of its recording, or from what its HDF5 file still holds.

    Repairs what a killed recorder leaves (logs that are not sealed), and what a killed Minari leaves (an empty
    ``metadata.json``, a half-written episode, counts that do not fit). What is found is kept as a backup.

    Args:
        dataset_id: Minari id.
        env_spec: Spec of the environment, where the metadata that knew it are lost.
        salvage: Whether to take what is intact of logs that are damaged, which are refused otherwise. The notes say
            what is missing; the logs are kept.

    Raises:
        InvalidArgumentError: For a malformed id, or a recorder at work on it.
        UnknownIdError: Where there is neither such a data set nor a recording of it.
        FileFormatError: Where nothing can be read; nothing is changed then.
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
    path = dataset_path(dataset_id) / "data" / "main_data.hdf5"
    metadata = _metadata(dataset_id)
    if metadata.get("data_format", "hdf5") != "hdf5":
        raise FileFormatError(
            f"data set {dataset_id!r}", expected="format 'hdf5'", actual=repr(metadata.get("data_format"))
        )
    file = _open(path)
    with file:
        try:
            good, notes = _inspect(file)
        except (OSError, RuntimeError, KeyError) as error:
            raise _unreadable(path, error) from error
        steps = sum(len(file[f"{name}/rewards"]) for name in good)
        counts = (metadata.get("total_episodes"), metadata.get("total_steps"))
        if not notes and counts == (len(good), steps) and _is_readable(dataset_id):
            return RepairReport(dataset_id, "intact", len(good), steps)
        if not good:
            raise FileFormatError(f"file {path}", expected="a readable episode", actual="none")
        observed, acted = (_space(metadata, kind, file[good[0]], notes) for kind in ("observation", "action"))
        if env_spec is None:
            env_spec = _env_spec(metadata, notes)
        backup = _back_up(dataset_id)
        dataset: MinariDataset = write_dataset(
            dataset_id,
            _episodes(file, good),
            env_spec=env_spec,
            observation_space=observed,
            action_space=acted,
            algorithm_name=metadata.get("algorithm_name"),
            description=metadata.get("description"),
            overwrite=True,
        )
    return RepairReport(
        dataset_id, "rebuilt", int(dataset.total_episodes), int(dataset.total_steps), tuple(notes), backup
    )


def _open(path: Path) -> Any:
    try:
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
        found = json.loads((dataset_path(dataset_id) / "data" / "metadata.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _inspect(file: Any) -> tuple[list[str], list[str]]:
    """Names of the groups that hold a whole episode, in order, and a sentence for each other one."""
    good, notes = [], []
    numbered = {int(name[8:]): name for name in file if name.startswith("episode_") and name[8:].isdecimal()}
    for _, name in sorted(numbered.items()):
        try:
            lengths = {key: len(file[name][key]) for key in ("observations", *_STEPS)}
            infos = {key: len(value) for key, value in file[name].get("infos", {}).items()}
            steps = lengths["rewards"]
            wrong = [key for key in _STEPS if lengths[key] != steps]
            wrong += [key for key, n in {"observations": lengths["observations"], **infos}.items() if n != steps + 1]
            reason = f"unequal lengths of {', '.join(wrong)}" if wrong else "" if steps else "no step"
            for key in () if reason else lengths:
                file[name][key][()]
        except (KeyError, OSError, TypeError, ValueError, RuntimeError) as error:
            reason = f"{type(error).__name__}: {error}"
        if reason:
            notes.append(f"{name} is left out: {reason}.")
        else:
            good.append(name)
    return good, notes


def _episodes(file: Any, names: list[str]) -> Iterator[EpisodeBuffer]:
    from minari.data_collector import EpisodeBuffer

    for name in names:
        group = file[name]
        infos = {key: value[()] for key, value in group.get("infos", {}).items()}
        seed = group.attrs.get("seed")
        columns: dict[str, Any] = {key: group[key][()] for key in ("observations", *_STEPS)}
        yield EpisodeBuffer(**columns, infos=infos, seed=None if seed is None else int(seed))


def _space(metadata: dict[str, Any], kind: str, group: Any, notes: list[str]) -> spaces.Space[Any]:
    from minari.serialization import deserialize_space

    stored = metadata.get(f"{kind}_space")
    if isinstance(stored, str):
        try:
            space: spaces.Space[Any] = deserialize_space(stored)
            return space
        except (ValueError, KeyError, TypeError, AssertionError):
            pass
    values = group[f"{kind}s"]
    notes.append(f"The {kind} space is lost; an unbounded Box of shape {values.shape[1:]} takes its place.")
    return spaces.Box(-np.inf, np.inf, values.shape[1:], values.dtype)


def _env_spec(metadata: dict[str, Any], notes: list[str]) -> EnvSpec | None:
    stored = metadata.get("env_spec")
    if stored is None and metadata:
        return None
    try:
        return EnvSpec.from_json(str(stored))
    except (ValueError, TypeError, KeyError, AttributeError):
        notes.append("The environment's spec is lost; repair(..., env_spec=...) can give it.")
        return None


def _is_readable(dataset_id: str) -> bool:
    import minari

    try:
        minari.load_dataset(dataset_id)
    except Exception:
        return False
    return True


def _back_up(dataset_id: str) -> Path:
    """Keeps the folder as it is under another, hidden name: links, so that it needs no room until it is replaced."""
    source, number = dataset_path(dataset_id), 0
    while (backup := dataset_path("") / ".broken" / f"{dataset_id}-{number}").exists():
        number += 1
    backup.parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(source, backup, copy_function=os.link)
    return backup
