"""One recording: the logs of a data set in the making, who may write them, and how they become the data set.

The logs are ``<Minari store>/.recording/<data set id>/env-0000.log``, one for each environment. ``lock`` beside
them is held while somebody records or seals; the system frees it with the process, however that ends.
"""

from __future__ import annotations

import fcntl
import heapq
import os
import shutil
import socket
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from mpcoffline.errors import FileFormatError, InvalidArgumentError, StorageError

from .atomic import sync_folder
from .episode_log import EpisodeLog, LoggedEpisode, LogHeader, LogIndex, scan
from .minari_store import check_new_dataset, dataset_path, is_local, recording_of, write_dataset

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer


def recording_path(dataset_id: str) -> Path:
    """The folder of a data set's logs, whether it exists or not."""
    return dataset_path("") / ".recording" / dataset_id


def log_files(dataset_id: str) -> list[Path]:
    """The logs of a data set that have not been sealed."""
    return sorted(recording_path(dataset_id).glob("env-*.log"))


class RecordingLock:
    """The right to write a data set's logs; the lock of a process that has died is free.

    Args:
        dataset_id: The data set.

    Raises:
        InvalidArgumentError: Where somebody else has it; names the process.
    """

    def __init__(self, dataset_id: str) -> None:
        self.folder = recording_path(dataset_id)
        self._path = self.folder / "lock"
        self._fd = -1
        while self._fd < 0:
            self.folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                holder = os.read(descriptor, 200).decode(errors="replace") or "another process"
                os.close(descriptor)
                raise InvalidArgumentError(
                    f"data set {dataset_id!r}",
                    expected="one recorder at a time",
                    actual=f"another one at work ({holder})",
                    hint="Wait for it, or record under another id; an interrupted recorder of this process is freed by"
                    " `recorder.close()`.",
                ) from error
            # Who held it may have removed the file in the meantime: then it is not the lock any more.
            if self._path.exists() and self._path.stat().st_ino == os.fstat(descriptor).st_ino:
                self._fd = descriptor
            else:
                os.close(descriptor)
        os.ftruncate(self._fd, 0)
        os.pwrite(self._fd, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)

    def release(self) -> None:
        """Gives it back, and removes the folder where there are no logs in it; harmless when repeated."""
        if self._fd < 0:
            return
        if not any(self.folder.glob("env-*.log")):
            shutil.rmtree(self.folder / "building", ignore_errors=True)
            self._path.unlink(missing_ok=True)
            folder = self.folder
            while folder != dataset_path(""):
                try:
                    folder.rmdir()
                except OSError:
                    break
                folder = folder.parent
        os.close(self._fd)
        self._fd = -1

    def __del__(self) -> None:
        if getattr(self, "_fd", -1) >= 0:
            os.close(self._fd)


class Recording:
    """Writes episodes into logs and makes a data set of them.

    Args:
        dataset_id: Minari id. Logs of this id that an interrupted recording left are continued.
        env_spec: Spec of the environment, or None.
        observation_space: Space of the observations; must be that of logs that are continued.
        action_space: Space of the actions; must be that of logs that are continued.
        mode: What becomes of a data set of this id: ``"new"``, ``"replace"`` or ``"extend"``.
        algorithm_name: Metadata.
        description: Metadata.
        resume: False deletes the logs of an interrupted recording instead of continuing them.
        sync_episodes: See :class:`EpisodeLog`.
        sync_seconds: See :class:`EpisodeLog`.

    Attributes:
        resumed: Number of episodes found in the logs.

    Raises:
        InvalidArgumentError: For an id that exists (mode ``"new"``), another recorder at work on it, or
            logs with other spaces or of another environment.
        FileFormatError: For logs that are damaged.
        StorageError: Where the disk refuses.
    """

    def __init__(
        self,
        dataset_id: str,
        *,
        env_spec: EnvSpec | None,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        mode: str = "new",
        algorithm_name: str | None = None,
        description: str | None = None,
        resume: bool = True,
        sync_episodes: int = 10,
        sync_seconds: float = 5.0,
    ) -> None:
        from minari.serialization import serialize_space

        check_new_dataset(dataset_id, overwrite=mode != "new")
        self.dataset_id = dataset_id
        self._settings: dict[str, Any] = {"sync_episodes": sync_episodes, "sync_seconds": sync_seconds}
        self._logs: dict[int, EpisodeLog] = {}
        try:
            self._lock = RecordingLock(dataset_id)
        except OSError as error:
            raise StorageError.of(recording_path(dataset_id), error) from error
        try:
            done = recording_of(dataset_id)
            indices = [scan(path) for path in log_files(dataset_id)]
            if not resume or any(index.header.recording == done for index in indices):
                _remove_logs(dataset_id)
                indices = []
            header = LogHeader(
                dataset_id,
                uuid.uuid4().hex,
                mode,
                str(serialize_space(observation_space)),
                str(serialize_space(action_space)),
                _spec_json(env_spec),
                algorithm_name,
                description,
            )
            self.header = _continued(indices, header) if indices else header
            self.resumed = sum(len(index.records) for index in indices)
            self._sequence = max((e.sequence + 1 for index in indices for e in index.episodes()), default=0)
        except BaseException:
            self._lock.release()
            raise

    def append(self, env: int, buffer: EpisodeBuffer, *, complete: bool) -> None:
        """Adds an episode to the log of an environment.

        Args:
            env: Number of the environment.
            buffer: The episode.
            complete: False for one that recording cuts off.

        Raises:
            StorageError: Where the disk refuses; what was written before is intact.
        """
        if env not in self._logs:
            path = self._lock.folder / f"env-{env:04d}.log"
            self._logs[env] = EpisodeLog(path, self.header, **self._settings)
            folder = path.parent
            while folder != dataset_path("").parent:  # its name, and those of new folders above, on the disk too
                sync_folder(folder)
                folder = folder.parent
        self._logs[env].append(LoggedEpisode.of(buffer, self._sequence, complete=complete))
        self._sequence += 1

    def poll(self) -> None:
        """Synchronises logs whose time has come."""
        for log in self._logs.values():
            log.poll()

    def seal(self) -> MinariDataset:
        """Closes the logs and makes the data set of them; see :func:`seal`."""
        self._close_logs(finished=True)
        try:
            return _seal(self.dataset_id)
        finally:
            self._lock.release()

    def close(self) -> None:
        """Lets go without sealing: the logs stay, to be continued or repaired; harmless when repeated."""
        self._close_logs(finished=False)
        self._lock.release()

    def _close_logs(self, *, finished: bool) -> None:
        for log in self._logs.values():
            log.close(finished=finished)


def seal(dataset_id: str) -> MinariDataset:
    """Makes the data set of the logs that a recording left, and removes them.

    The data set is built in a hidden folder, written to the disk, and only then named. Sealing that was interrupted
    at any moment is done again, with the same result.

    Args:
        dataset_id: Minari id under which the episodes were recorded.

    Raises:
        InvalidArgumentError: Where there is no log, no episode in them, a recorder at work on them, or another
            data set of this id.
        FileFormatError: For damaged logs; nothing is changed.
        StorageError: Where the disk refuses; the logs stay.
    """
    lock = RecordingLock(dataset_id)
    try:
        return _seal(dataset_id)
    finally:
        lock.release()


def _seal(dataset_id: str) -> MinariDataset:
    import minari
    from minari.serialization import deserialize_space

    indices = [scan(path) for path in log_files(dataset_id)]
    if sum(len(index.records) for index in indices) == 0:
        _remove_logs(dataset_id)
        raise InvalidArgumentError(f"data set {dataset_id!r}", expected="at least one transition", actual="none")
    header = _continued(indices, indices[0].header)
    if recording_of(dataset_id) != header.recording:
        check_new_dataset(dataset_id, overwrite=header.mode != "new")
        building = recording_path(dataset_id) / "building"
        shutil.rmtree(building, ignore_errors=True)
        aside = building.with_name("building-replaced")
        if aside.exists() and not is_local(dataset_id):
            os.rename(aside, dataset_path(dataset_id))
        write_dataset(
            dataset_id,
            (episode.buffer() for episode in _in_order(indices)),
            env_spec=None if header.env_spec is None else EnvSpec.from_json(header.env_spec),
            observation_space=deserialize_space(header.observation_space),
            action_space=deserialize_space(header.action_space),
            algorithm_name=header.algorithm_name,
            description=header.description,
            overwrite=header.mode != "new",
            extend=header.mode == "extend" and is_local(dataset_id),
            recording=header.recording,
            building=building,
        )
    _remove_logs(dataset_id)
    return minari.load_dataset(dataset_id)


def _in_order(indices: list[LogIndex]) -> Iterator[LoggedEpisode]:
    """All logs' episodes in the order in which they ended, one of each log in memory at a time."""
    return heapq.merge(*(index.episodes() for index in indices), key=lambda episode: episode.sequence)


def _continued(indices: list[LogIndex], header: LogHeader) -> LogHeader:
    """The header that the logs share, or an error where they differ in it or hold other spaces than ``header``."""
    first = indices[0].header
    for index in indices:
        if index.header.recording != first.recording:
            raise FileFormatError(
                f"log {index.path}", expected=f"a log of recording {first.recording}", actual=index.header.recording
            )
    for kind in ("observation_space", "action_space"):
        if getattr(first, kind) != getattr(header, kind):
            raise InvalidArgumentError(
                kind.replace("_", " "),
                expected=f"that of the interrupted recording of {header.dataset_id!r}: {getattr(first, kind)}",
                actual=getattr(header, kind),
                hint=f"Seal it first (`mpcoffline datasets repair {header.dataset_id}`), or pass resume=False.",
            )
    if None not in (first.env_spec, header.env_spec) and first.env_spec != header.env_spec:
        raise InvalidArgumentError(
            "environment",
            expected=f"that of the interrupted recording of {header.dataset_id!r}: {first.env_spec}",
            actual=str(header.env_spec),
            hint=f"Seal it first (`mpcoffline datasets repair {header.dataset_id}`), or pass resume=False.",
        )
    return first


def _remove_logs(dataset_id: str) -> None:
    for path in log_files(dataset_id):
        path.unlink()


def _spec_json(spec: EnvSpec | None) -> str | None:
    """The spec as it is stored."""
    if spec is None:
        return None
    try:
        return spec.to_json()
    except (ValueError, TypeError) as error:
        raise InvalidArgumentError(
            f"environment {spec.id!r}",
            expected="a spec that can be stored as JSON",
            actual=str(error),
            hint='Register it with entry_point="module:Class" instead of the class itself, and give it numbers, texts'
            " and lists as arguments.",
        ) from error
