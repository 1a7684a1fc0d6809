"""One recording: the logs of a data set in the making, and how they become the data set."""

from __future__ import annotations

import heapq
import os
import shutil
import uuid
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from mpcoffline.core.atomic import sync_folder
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.datasets.store.ids import dataset_path, is_local
from mpcoffline.datasets.store.opening import check_space, open_dataset
from mpcoffline.datasets.store.recording_lock import RecordingLock, log_files, recording_path
from mpcoffline.datasets.store.writing import check_new_dataset, recording_of, write_dataset
from mpcoffline.datasets.table.numbers import check_storable

from .episode_log import EpisodeLog, LogIndex, scan
from .log_format import LoggedEpisode, LogHeader
from .resuming import are_continued, check_extends, common_header, origin_json, remove_logs, set_aside

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer


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
        origin: What else makes it this recording and no other (policy, seed, number of episodes, ...), by name.
        resume: False deletes the logs of an interrupted recording instead of continuing them.
        leftover: What becomes of the logs of an interrupted recording. They are continued where it is the same one:
            environment, spaces, algorithm and ``origin`` are equal. Another one is an error (``"refuse"``), or is put
            aside with a warning (``"aside"``). ``"restart"`` continues none: the same one is deleted, another one is
            put aside.
        keep_cut: Whether an episode that a crash cut off, of which pieces were written, stays as one that did not end.
        sync_episodes: See :class:`EpisodeLog`.
        sync_seconds: See :class:`EpisodeLog`.

    Attributes:
        resumed: Number of episodes found in the logs.

    Raises:
        InvalidArgumentError: For an id that exists (mode ``"new"``), another recorder at work on it, spaces that cannot
            be stored, the logs of another recording (``"refuse"``), or a data set of another plant (``"extend"``).
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
        origin: Mapping[str, Any] | None = None,
        resume: bool = True,
        leftover: str = "refuse",
        keep_cut: bool = True,
        sync_episodes: int = 10,
        sync_seconds: float = 5.0,
    ) -> None:
        from minari.serialization import serialize_space

        check_new_dataset(dataset_id, overwrite=mode != "new")
        check_storable("observation space", observation_space)
        check_storable("action space", action_space)
        self.dataset_id = dataset_id
        self._settings: dict[str, Any] = {
            "sync_episodes": sync_episodes,
            "sync_seconds": sync_seconds,
            "keep_cut": keep_cut,
        }
        self._logs: dict[int, EpisodeLog] = {}
        self.header: LogHeader = LogHeader(
            dataset_id,
            uuid.uuid4().hex,
            mode,
            str(serialize_space(observation_space)),
            str(serialize_space(action_space)),
            _spec_json(env_spec),
            algorithm_name,
            description,
            origin_json(origin),
        )
        check_extends(self.header)
        self._lock = RecordingLock(dataset_id)
        try:
            if not resume:
                remove_logs(dataset_id)
            indices = [scan(path) for path in log_files(dataset_id)]
            if indices and are_continued(indices, self.header, leftover):
                self.header = indices[0].header
            else:
                indices = []
            self.resumed: int = sum(len(index.records) - (0 if keep_cut else len(index.cut)) for index in indices)
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
            InvalidArgumentError: After the end, or in a fork of the process that records.
            StorageError: Where the disk refuses; what was written before is intact.
        """
        self._log(env).append(LoggedEpisode.of(buffer, self._sequence, complete=complete))
        self._sequence += 1

    def append_piece(self, env: int, buffer: EpisodeBuffer) -> None:
        """Adds a piece of a long episode that is under way; :meth:`append` adds the last one.

        Args:
            env: Number of the environment.
            buffer: The next steps, in pieces but the first without the row before them.

        Raises:
            InvalidArgumentError: After the end, or in a fork of the process that records.
            StorageError: Where the disk refuses; what was written before is intact.
        """
        self._log(env).append_piece(LoggedEpisode.of(buffer, self._sequence, complete=False))
        self.poll()

    def _log(self, env: int) -> EpisodeLog:
        self._check_held()
        if env not in self._logs:
            path = self._lock.folder / f"env-{env:04d}.log"
            self._logs[env] = EpisodeLog(path, self.header, **self._settings)
            folder = path.parent
            while folder != dataset_path("").parent:  # its name, and those of new folders above, on the disk too
                sync_folder(folder)
                folder = folder.parent
        return self._logs[env]

    def tell_resumed(self, who: str, more: str = "") -> None:
        """Warns where episodes of an interrupted recording are continued."""
        if self.resumed:
            warnings.warn(
                f"{who}: {self.resumed} episodes of an interrupted recording of {self.dataset_id!r} are continued;"
                f" resume=False starts anew.{more}",
                stacklevel=3,
            )

    def poll(self) -> None:
        """Synchronises logs whose time has come."""
        for log in self._logs.values():
            log.poll()

    def seal(self) -> MinariDataset:
        """Closes the logs and makes the data set of them; see :func:`seal`."""
        self._check_held()
        self._close_logs(finished=True)
        try:
            return _seal(self.dataset_id)[0]
        finally:
            self._lock.release()

    def close(self) -> None:
        """Lets go without sealing: the logs stay, to be continued or repaired; harmless when repeated."""
        self._close_logs(finished=False)
        self._lock.release()

    def _check_held(self) -> None:
        if not self._lock.held:
            raise InvalidArgumentError(
                f"recording of {self.dataset_id!r}",
                expected="the process that began it, before its end",
                actual=f"process {os.getpid()}, which does not hold its lock",
            )

    def _close_logs(self, *, finished: bool) -> None:
        for log in self._logs.values():
            log.close(finished=finished)


def seal(dataset_id: str, *, salvage: bool = False) -> tuple[MinariDataset, list[str], Path | None]:
    """Makes the data set of the logs that a recording left, and removes them.

    The data set is built in a hidden folder, written to the disk, and only then named. Sealing that was interrupted
    at any moment is done again, with the same result.

    Args:
        dataset_id: Minari id under which the episodes were recorded.
        salvage: Whether to take what is intact of damaged logs; they are then kept as they were.

    Returns:
        The data set; what is not in it, one sentence each; and where damaged logs are kept.

    Raises:
        InvalidArgumentError: Where there is no log, no episode in them, a recorder at work on them, or another
            data set of this id.
        FileFormatError: For damaged logs; nothing is changed.
        StorageError: Where the disk refuses; the logs stay.
    """
    lock = RecordingLock(dataset_id)
    try:
        return _seal(dataset_id, salvage=salvage)
    finally:
        lock.release()


def _seal(dataset_id: str, *, salvage: bool = False) -> tuple[MinariDataset, list[str], Path | None]:
    indices, lost = _salvaged(dataset_id) if salvage else ([scan(path) for path in log_files(dataset_id)], [])
    if sum(len(index.records) for index in indices) == 0:
        if lost:
            raise FileFormatError(f"recording of {dataset_id!r}", expected="an intact episode", actual="none")
        remove_logs(dataset_id)
        raise InvalidArgumentError(f"data set {dataset_id!r}", expected="at least one transition", actual="none")
    header = common_header(indices)
    if recording_of(dataset_id) != header.recording:
        check_extends(header)
        if is_local(dataset_id) and header.mode == "new":
            raise InvalidArgumentError(
                f"data set {dataset_id!r}",
                expected="none of that id, which the recording is to become",
                actual=f"another one in {dataset_path(dataset_id)}",
                hint=f"It exists since the recording began. Move its folder away, then `mpcoffline datasets repair"
                f" {dataset_id}`: the recording is kept.",
            )
        building = recording_path(dataset_id) / "building"
        shutil.rmtree(building, ignore_errors=True)
        aside = building.with_name("building-replaced")
        if aside.exists() and not is_local(dataset_id):
            os.rename(aside, dataset_path(dataset_id))
        write_dataset(
            dataset_id,
            (episode.buffer() for episode in _in_order(indices)),
            env_spec=_spec_of(header),
            observation_space=_space_of(header, "observation_space"),
            action_space=_space_of(header, "action_space"),
            algorithm_name=header.algorithm_name,
            description=header.description,
            overwrite=header.mode != "new",
            extend=header.mode == "extend" and is_local(dataset_id),
            recording=header.recording,
            building=building,
        )
    dataset = open_dataset(dataset_path(dataset_id))  # first: the logs are all there is if it is damaged
    kept = set_aside(dataset_id) if lost else None
    remove_logs(dataset_id)
    return dataset, lost, kept


def _salvaged(dataset_id: str) -> tuple[list[LogIndex], list[str]]:
    """What is intact of the logs, and what is not: damaged bytes, and the numbers of the episodes that are missing."""
    paths = log_files(dataset_id)
    header = next((index.header for path in paths if (index := _try_scan(path)) is not None), None)
    indices = [scan(path, salvage=True, fallback=header) for path in paths]
    lost: list[str] = []
    for index in [index for index in indices if header is not None and index.header.recording != header.recording]:
        lost.append(f"{index.path.name} is left out: it is of another recording.")
        indices.remove(index)
    lost += [sentence for index in indices for sentence in index.damage]
    numbers = sorted(episode.sequence for index in indices for episode in index.episodes())
    missing = sorted(set(range(max(numbers, default=-1))) - set(numbers)) if lost else []
    if missing:
        lost.append(f"Of the episodes in the order in which they ended, these are missing: {missing}.")
    return indices, lost


def _try_scan(path: Path) -> LogIndex | None:
    try:
        return scan(path, salvage=True)
    except FileFormatError:
        return None


def _space_of(header: LogHeader, kind: str) -> spaces.Space[Any]:
    from minari.serialization import deserialize_space

    text = getattr(header, kind)
    check_space(f"recording of {header.dataset_id!r}: {kind}", text)
    space: spaces.Space[Any] = deserialize_space(text)
    return space


def _spec_of(header: LogHeader) -> EnvSpec | None:
    try:
        return None if header.env_spec is None else EnvSpec.from_json(header.env_spec)
    except (ValueError, TypeError, KeyError, AttributeError, gym.error.Error) as error:
        name = f"recording of {header.dataset_id!r}: env_spec"
        raise FileFormatError(name, expected="a spec as Gymnasium stores it", actual=repr(error)[:300]) from error


def _in_order(indices: list[LogIndex]) -> Iterator[LoggedEpisode]:
    """All logs' episodes in the order in which they ended, one of each log in memory at a time."""
    return heapq.merge(*(index.episodes() for index in indices), key=lambda episode: episode.sequence)


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
