"""One recording: the logs of a data set in the making, and how they become the data set."""

from __future__ import annotations

import heapq
import json
import os
import shutil
import uuid
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from mpcoffline.errors import FileFormatError, InvalidArgumentError, StorageError

from .atomic import sync_folder
from .checks import check_storable
from .episode_log import EpisodeLog, LoggedEpisode, LogHeader, LogIndex, scan
from .minari_store import check_new_dataset, dataset_path, is_local, recording_of, write_dataset
from .opening import open_dataset
from .recording_lock import RecordingLock, log_files, recording_path

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
        sync_episodes: int = 10,
        sync_seconds: float = 5.0,
    ) -> None:
        from minari.serialization import serialize_space

        check_new_dataset(dataset_id, overwrite=mode != "new")
        check_storable("observation space", observation_space)
        check_storable("action space", action_space)
        self.dataset_id = dataset_id
        self._settings: dict[str, Any] = {"sync_episodes": sync_episodes, "sync_seconds": sync_seconds}
        self._logs: dict[int, EpisodeLog] = {}
        self.header = LogHeader(
            dataset_id,
            uuid.uuid4().hex,
            mode,
            str(serialize_space(observation_space)),
            str(serialize_space(action_space)),
            _spec_json(env_spec),
            algorithm_name,
            description,
            _origin_json(origin),
        )
        _check_extends(self.header)
        self._lock = RecordingLock(dataset_id)
        try:
            if not resume:
                _remove_logs(dataset_id)
            indices = [scan(path) for path in log_files(dataset_id)]
            if indices and _are_continued(indices, self.header, leftover):
                self.header = indices[0].header
            else:
                indices = []
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
            InvalidArgumentError: After the end, or in a fork of the process that records.
            StorageError: Where the disk refuses; what was written before is intact.
        """
        self._check_held()
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
        self._check_held()
        self._close_logs(finished=True)
        try:
            return _seal(self.dataset_id)
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
    from minari.serialization import deserialize_space

    indices = [scan(path) for path in log_files(dataset_id)]
    if sum(len(index.records) for index in indices) == 0:
        _remove_logs(dataset_id)
        raise InvalidArgumentError(f"data set {dataset_id!r}", expected="at least one transition", actual="none")
    header = _common_header(indices)
    if recording_of(dataset_id) != header.recording:
        _check_extends(header)
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
    dataset = open_dataset(dataset_path(dataset_id))  # first: the logs are all there is if it is damaged
    _remove_logs(dataset_id)
    return dataset


def _in_order(indices: list[LogIndex]) -> Iterator[LoggedEpisode]:
    """All logs' episodes in the order in which they ended, one of each log in memory at a time."""
    return heapq.merge(*(index.episodes() for index in indices), key=lambda episode: episode.sequence)


def _common_header(indices: list[LogIndex]) -> LogHeader:
    """The header that the logs share, or an error where they are of different recordings."""
    first = indices[0].header
    for index in indices:
        if index.header.recording != first.recording:
            raise FileFormatError(
                f"log {index.path}", expected=f"a log of recording {first.recording}", actual=index.header.recording
            )
    return first


def _are_continued(indices: list[LogIndex], header: LogHeader, leftover: str) -> bool:
    """Whether a new recording goes on with these logs; where not, they are out of its way. See :class:`Recording`."""
    first, name = _common_header(indices), header.dataset_id
    differences = _differences(first, header)
    if not differences and leftover != "restart" and first.recording != recording_of(name):
        return True
    found = sum(len(index.records) for index in indices)
    if found == 0 or first.recording == recording_of(name):
        _remove_logs(name)
    elif not differences:
        _remove_logs(name)
        warnings.warn(f"{found} episodes of an interrupted recording of {name!r} are recorded anew.", stacklevel=3)
    elif leftover == "refuse":
        what, theirs, ours = differences[0]
        raise InvalidArgumentError(
            what,
            expected=f"that of the interrupted recording of {name!r}: {theirs}",
            actual=ours,
            hint=f"Seal it first (`mpcoffline datasets repair {name}`), or pass resume=False.",
        )
    else:
        kept = _set_aside(name)
        because = "; ".join(f"{what} {theirs}, now {ours}" for what, theirs, ours in differences)
        warnings.warn(
            f"An interrupted recording of {name!r} is another one ({because}): it is not continued."
            f" Its {found} episodes are kept in {kept}.",
            stacklevel=3,
        )
    return False


def _differences(first: LogHeader, second: LogHeader) -> list[tuple[str, str, str]]:
    """In what two recordings of one id are not the same: what, in the first, in the second."""
    pairs: dict[str, tuple[Any, Any]] = {
        "observation space": (first.observation_space, second.observation_space),
        "action space": (first.action_space, second.action_space),
        "environment": _plants(first.env_spec, second.env_spec),
        "algorithm": (first.algorithm_name, second.algorithm_name),
        "extends a data set": (first.mode == "extend", second.mode == "extend"),
    }
    theirs, ours = (json.loads(header.origin or "{}") for header in (first, second))
    # The plant's class is not known where it is in another process.
    keys = {*theirs, *ours} - ({"plant"} if "plant" not in theirs or "plant" not in ours else set())
    pairs |= {key: (theirs.get(key), ours.get(key)) for key in sorted(keys)}
    return [(what, str(a), str(b)) for what, (a, b) in pairs.items() if a != b]


def _check_extends(header: LogHeader) -> None:
    """Refuses a recording that is to extend the data set of another plant, which stays as it is."""
    if header.mode != "extend" or not is_local(header.dataset_id):
        return
    stored = json.loads((dataset_path(header.dataset_id) / "data" / "metadata.json").read_text(encoding="utf-8"))
    pairs = {
        "environment": _plants(stored.get("env_spec"), header.env_spec),
        "observation space": (stored.get("observation_space"), header.observation_space),
        "action space": (stored.get("action_space"), header.action_space),
    }
    for what, (theirs, ours) in pairs.items():
        if theirs != ours:
            raise InvalidArgumentError(
                f"{what} of what extends data set {header.dataset_id!r}",
                expected=f"that of the data set: {theirs}",
                actual=str(ours),
                hint="One data set holds one plant: record another plant under another id, with a recorder of its own.",
            )


def _plants(first: str | None, second: str | None) -> tuple[str | None, str | None]:
    """Two specs as short as they can be told apart: id and arguments, or all of it."""
    try:
        found = [None if spec is None else json.loads(spec) for spec in (first, second)]
        short = [None if spec is None else f"{spec['id']} with {spec['kwargs']}" for spec in found]
    except (ValueError, TypeError, KeyError):
        return first, second
    return (short[0], short[1]) if (short[0] == short[1]) == (first == second) else (first, second)


def _set_aside(dataset_id: str) -> Path:
    """Moves the logs to where nobody continues them; moved back, they can be repaired."""
    number = 0
    while (kept := dataset_path("") / ".broken" / f"{dataset_id}-recording-{number}").exists():
        number += 1
    try:
        kept.mkdir(parents=True)
        for path in log_files(dataset_id):
            path.rename(kept / path.name)
    except OSError as error:
        raise StorageError.of(kept, error) from error
    return kept


def _remove_logs(dataset_id: str) -> None:
    for path in log_files(dataset_id):
        path.unlink()


def _origin_json(origin: Mapping[str, Any] | None) -> str | None:
    return None if origin is None else json.dumps(origin, sort_keys=True, default=str)


def _spec_json(spec: EnvSpec | None) -> str | None:
    """The spec as it is stored."""
    if spec is None:
        return None
    try:
        return spec.to_json()
    except ValueError as error:
        raise InvalidArgumentError(
            f"environment {spec.id!r}",
            expected="a spec that can be stored as JSON",
            actual=str(error),
            hint='Register it with entry_point="module:Class" instead of the class itself.',
        ) from error
