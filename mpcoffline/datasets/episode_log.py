"""An append-only log of episodes that survives a killed process and a lost power supply.

A file is a magic number and records one after the other. A record is a frame (a marker, its kind, the length
and the CRC-32 of its content, and a CRC-32 of these) and its content. The first record is the header, JSON;
it is on the disk before the file has its name. Then come episodes: the length of a JSON description, the
description, and the arrays' bytes. A file that was closed in order ends with a record that says so.

What a crash can leave behind is an incomplete last record, a torn tail: the reader stops before it. Where a
damaged record is followed by an intact one, a crash cannot be the cause, and the reader refuses the file.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mpcoffline.errors import FileFormatError, StorageError

from .checks import NUMBERS, check_numbers

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

MAGIC = b"mpco-log"
VERSION = 1
HEADER, EPISODE, CLOSED = 1, 2, 3
_MARKER = b"\xb7\x1eR\x0a"
_FRAME = struct.Struct("<4sIII")  # marker, kind, length, CRC-32 of the content
_CRC = struct.Struct("<I")
_OVERHEAD = _FRAME.size + _CRC.size
_STEPS = ("actions", "rewards", "terminations", "truncations")


@dataclass(frozen=True)
class LogHeader:
    """What a log knows beside its episodes: enough to make a data set of them.

    Attributes:
        dataset_id: Minari id that the data set will have.
        recording: Random name of this recording, which the data set bears too: so that a second
            sealing of the same logs knows that it has been done.
        mode: What becomes of a data set that has this id: ``"new"`` (there must be none), ``"replace"``, or
            ``"extend"`` (the episodes are added to it).
        observation_space: The space in Minari's serialisation.
        action_space: The space in Minari's serialisation.
        env_spec: The environment's spec as JSON; None where it has none.
        algorithm_name: Metadata.
        description: Metadata.
        origin: What else makes it this recording and no other, a JSON object; None where nothing is known.
    """

    dataset_id: str
    recording: str
    mode: str
    observation_space: str
    action_space: str
    env_spec: str | None = None
    algorithm_name: str | None = None
    description: str | None = None
    origin: str | None = None


@dataclass(frozen=True)
class LoggedEpisode:
    """An episode as the log holds it.

    Attributes:
        sequence: Its place in the order in which episodes ended, over all environments.
        complete: False for the one under way when recording ended, whose last step is marked as truncated.
        arrays: ``observations (T+1, ...)``, ``actions (T, ...)``, ``rewards``, ``terminations``, ``truncations``
            ``(T,)``, and ``infos/...`` ``(T+1, ...)``.
    """

    sequence: int
    complete: bool
    arrays: dict[str, NDArray[Any]]

    @classmethod
    def of(cls, buffer: EpisodeBuffer, sequence: int, *, complete: bool) -> LoggedEpisode:
        """Takes over the arrays of Minari's buffer; ``InvalidDataError`` where one is not of numbers."""
        infos = {f"infos/{key}": value for key, value in (buffer.infos or {}).items()}
        columns = {key: getattr(buffer, key) for key in ("observations", *_STEPS)}
        named = (columns | infos).items()
        return cls(
            sequence, complete, {key: check_numbers(f"episode {sequence}: {key}", value) for key, value in named}
        )

    def __len__(self) -> int:
        """Number of transitions."""
        return len(self.arrays["rewards"])

    def buffer(self) -> EpisodeBuffer:
        """The episode as Minari stores it."""
        from minari.data_collector import EpisodeBuffer

        columns: dict[str, Any] = {key: self.arrays[key] for key in ("observations", *_STEPS)}
        infos = {key.removeprefix("infos/"): value for key, value in self.arrays.items() if key.startswith("infos/")}
        return EpisodeBuffer(**columns, infos=infos)


@dataclass(frozen=True)
class LogIndex:
    """Where the intact records of a log are.

    Attributes:
        path: The file.
        header: Its header.
        records: Offset and length of the content of each episode.
        end: Number of bytes up to the end of the last intact record.
        torn: Number of bytes behind them, which a crash left.
        closed: Whether the last record says that the file was closed in order.
    """

    path: Path
    header: LogHeader
    records: list[tuple[int, int]] = field(repr=False)
    end: int
    torn: int
    closed: bool

    def episodes(self) -> Iterator[LoggedEpisode]:
        """Reads the episodes one by one.

        Raises:
            FileFormatError: Where a record's content is not an episode; it names the record.
        """
        with self.path.open("rb") as file:
            for number, (offset, length) in enumerate(self.records, start=1):
                file.seek(offset)
                yield _decode(file.read(length), f"log {self.path}, record {number}")


def scan(path: Path) -> LogIndex:
    """Checks every record's CRC and finds the end of the intact part.

    Raises:
        FileFormatError: For a file that is no log, is of another version, or is damaged before its tail; the
            number of the damaged record is named.
    """
    records: list[tuple[int, int]] = []
    header, closed = None, False
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(MAGIC)) != MAGIC:
            raise FileFormatError(f"log {path}", expected="a log of recorded episodes", actual="another kind of file")
        end, number = len(MAGIC), 0
        while (found := _frame(file, end, size)) is not None:
            kind, length, content = found
            if number == 0:
                header = _decode_header(content if kind == HEADER else b"", path)
            elif kind == EPISODE:
                records.append((end + _OVERHEAD, length))
            closed = kind == CLOSED
            end += _OVERHEAD + length
            number += 1
        if end < size and _intact_record_after(file, end, size):
            raise FileFormatError(
                f"log {path}, record {number}",
                expected="the content that its CRC-32 was computed from",
                actual=f"damage at byte {end}, before intact records",
                hint=f"The {len(records)} episodes before it can be read; restore the file from a copy.",
            )
    if header is None:
        raise FileFormatError(f"log {path}", expected="a header", actual="none, or a damaged one")
    return LogIndex(path, header, records, end, size - end, closed)


class EpisodeLog:
    """Writes a log: each episode reaches the system as soon as it ends, and the disk every now and then.

    A killed process loses no episode that was appended; a lost power supply none of those before the last
    synchronisation (every ``sync_episodes`` episodes or ``sync_seconds`` seconds, and at the end).

    Args:
        path: The file. A new one gets the header; one that exists goes on after its last intact record.
        header: The header of a new file.
        sync_episodes: Number of episodes between synchronisations.
        sync_seconds: Seconds after which appended episodes are synchronised at the latest.

    Raises:
        FileFormatError: For an existing file that is damaged before its tail.
        StorageError: Where the file cannot be written.
    """

    def __init__(self, path: Path, header: LogHeader, *, sync_episodes: int = 10, sync_seconds: float = 5.0) -> None:
        self.path = path
        self._every, self._seconds = sync_episodes, sync_seconds
        self._pending, self._since = 0, time.monotonic()
        if not path.exists():
            _create(path, header)
        index = scan(path)
        self._end = index.end
        self._fd = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
        os.ftruncate(self._fd, self._end)

    def append(self, episode: LoggedEpisode) -> None:
        """Adds an episode.

        Raises:
            StorageError: Where it cannot be written; the file then ends with the episode before.
        """
        self._write(_encode(episode), EPISODE)
        self._pending += 1
        if self._pending == 1:
            self._since = time.monotonic()
        if self._pending >= self._every:
            self.sync()

    def poll(self) -> None:
        """Synchronises where an episode has waited for longer than ``sync_seconds``."""
        if self._pending and time.monotonic() - self._since >= self._seconds:
            self.sync()

    def sync(self) -> None:
        """Waits until all that was appended is on the disk.

        Raises:
            StorageError: Where the disk refuses.
        """
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            raise StorageError.of(self.path, error) from error
        self._pending = 0

    def close(self, *, finished: bool = True) -> None:
        """Closes the file; harmless when repeated.

        Args:
            finished: Whether recording came to its end, which the last record then says.
        """
        if self._fd < 0:
            return
        try:
            if finished:
                self._write(b"", CLOSED)
            self.sync()
        finally:
            os.close(self._fd)
            self._fd = -1

    def _write(self, content: bytes, kind: int) -> None:
        record = memoryview(_record(kind, content))
        try:
            written = 0
            while written < len(record):
                written += os.pwrite(self._fd, record[written:], self._end + written)
        except OSError as error:
            os.ftruncate(self._fd, self._end)
            raise StorageError.of(self.path, error) from error
        self._end += len(record)


def _create(path: Path, header: LogHeader) -> None:
    content = json.dumps({"version": VERSION, **asdict(header)}).encode()
    new = path.with_suffix(".new")
    try:
        with new.open("wb") as file:
            file.write(MAGIC + _record(HEADER, content))
            file.flush()
            os.fsync(file.fileno())
        os.replace(new, path)
    except OSError as error:
        new.unlink(missing_ok=True)
        raise StorageError.of(path, error) from error


def _record(kind: int, content: bytes) -> bytes:
    frame = _FRAME.pack(_MARKER, kind, len(content), zlib.crc32(content))
    return frame + _CRC.pack(zlib.crc32(frame)) + content


def _frame(file: BinaryIO, offset: int, size: int) -> tuple[int, int, bytes] | None:
    """Kind, length and content of the record at ``offset``; None where there is no intact one."""
    file.seek(offset)
    head = file.read(_OVERHEAD)
    if len(head) < _OVERHEAD or _CRC.unpack(head[_FRAME.size :])[0] != zlib.crc32(head[: _FRAME.size]):
        return None
    marker, kind, length, crc = _FRAME.unpack(head[: _FRAME.size])
    if marker != _MARKER or offset + _OVERHEAD + length > size:
        return None
    content = file.read(length)
    return (kind, length, content) if len(content) == length and zlib.crc32(content) == crc else None


def _intact_record_after(file: BinaryIO, offset: int, size: int) -> bool:
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        while (offset := content.find(_MARKER, offset + 1)) >= 0:
            if _frame(file, offset, size) is not None:
                return True
    return False


def _decode_header(content: bytes, path: Path) -> LogHeader:
    try:
        values = json.loads(content)
        version = values.pop("version")
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise FileFormatError(f"log {path}, header", expected="JSON with a version", actual=str(error)) from error
    if version != VERSION:
        raise FileFormatError(
            f"log {path}", expected=f"version {VERSION}", actual=str(version), hint="Seal it with what recorded it."
        )
    try:
        header = LogHeader(**values)
    except TypeError as error:
        raise FileFormatError(f"log {path}, header", expected="its fields", actual=str(error)) from error
    required = (header.dataset_id, header.recording, header.mode, header.observation_space, header.action_space)
    optional = (header.env_spec, header.algorithm_name, header.description, header.origin)
    if not all(isinstance(text, str) for text in (*required, *(text for text in optional if text is not None))):
        raise FileFormatError(f"log {path}, header", expected="texts", actual="something else")
    return header


def _encode(episode: LoggedEpisode) -> bytes:
    arrays = {key: np.ascontiguousarray(value) for key, value in episode.arrays.items()}
    description = {
        "sequence": episode.sequence,
        "complete": episode.complete,
        "arrays": [[key, value.dtype.str, value.shape] for key, value in arrays.items()],
    }
    text = json.dumps(description).encode()
    return b"".join([_CRC.pack(len(text)), text, *(value.tobytes() for value in arrays.values())])


def _decode(content: bytes, where: str) -> LoggedEpisode:
    try:
        (length,) = _CRC.unpack_from(content)
        description = json.loads(content[_CRC.size : _CRC.size + length])
        arrays, offset = {}, _CRC.size + length
        for key, code, shape in description["arrays"]:
            dtype = np.dtype(str(code))
            if dtype.kind not in NUMBERS or min(shape, default=0) < 0:
                raise ValueError(f"{key} of type {dtype} and shape {shape}")
            values: NDArray[Any] = np.frombuffer(content, dtype, int(np.prod(shape, dtype=np.int64)), offset)
            arrays[str(key)] = values.reshape(shape).copy()
            offset += values.nbytes
        episode = LoggedEpisode(int(description["sequence"]), bool(description["complete"]), arrays)
        _check_lengths(episode, left=len(content) - offset)
    except (ValueError, TypeError, KeyError, struct.error, RecursionError, OverflowError, MemoryError) as error:
        raise FileFormatError(where, expected="an episode", actual=f"{type(error).__name__}: {error}") from error
    return episode


def _check_lengths(episode: LoggedEpisode, left: int) -> None:
    steps = len(episode.arrays["rewards"])
    lengths = {key: len(value) - (key not in _STEPS) for key, value in episode.arrays.items()}
    if left or not {"observations", *_STEPS} <= lengths.keys() or set(lengths.values()) != {steps} or steps == 0:
        raise ValueError(f"columns of {lengths} transitions, {left} bytes left over")
