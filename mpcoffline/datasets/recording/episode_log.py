"""An append-only log of episodes that survives a killed process and a lost power supply.

A file is a magic number and records one after the other, see :mod:`.log_format`. First comes the header, JSON; it
is on the disk before the file has its name, and comes once more behind the first episode, so that no damage at one
place takes it. Then come episodes; a long one is written in pieces while it is under way, the last of which is marked
as its end. A file that was closed in order ends with a record that says so.

What a crash can leave behind is an incomplete last record, a torn tail: the reader stops before it. Where a
damaged record is followed by an intact one, a crash cannot be the cause, and the reader refuses the file, or takes what
is intact where it is asked to.
"""

from __future__ import annotations

import json
import os
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

from mpcoffline.core.errors import FileFormatError, StorageError

from .log_format import (
    CLOSED,
    END,
    EPISODE,
    HEADER,
    MAGIC,
    MARKER,
    OVERHEAD,
    PART,
    VERSION,
    LoggedEpisode,
    LogHeader,
    cut_off,
    decode,
    decode_header,
    encode,
    framed,
    joined,
    unframed,
)

_BLOCK = 1 << 20


@dataclass(frozen=True)
class LogIndex:
    """Where the intact records of a log are.

    Attributes:
        path: The file.
        header: Its header.
        records: For each episode the offset and length of the content of its record, or of each of its pieces.
        cut: Which episodes are pieces without an end.
        end: Number of bytes up to the end of the last intact record.
        whole: Number of bytes up to the end of the last episode that has an end.
        torn: Number of bytes behind the last intact record, which a crash left.
        closed: Whether the last record says that the file was closed in order.
        damage: What could not be read, one sentence each; empty unless it was asked for what is intact.
    """

    path: Path
    header: LogHeader
    records: list[list[tuple[int, int]]] = field(repr=False)
    cut: frozenset[int]
    end: int
    whole: int
    torn: int
    closed: bool
    damage: tuple[str, ...] = ()

    def episodes(self) -> Iterator[LoggedEpisode]:
        """Reads the episodes one by one.

        Raises:
            FileFormatError: Where a record's content is not an episode; it names the record.
        """
        with self.path.open("rb") as file:
            for number, places in enumerate(self.records):
                pieces = []
                for offset, length in places:
                    file.seek(offset)
                    pieces.append(decode(file.read(length), f"log {self.path}, record at byte {offset - OVERHEAD}"))
                episode = joined(pieces)
                yield cut_off(episode) if number in self.cut else episode


class _Scan:
    """What has been found of a log while its records are read in order."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.headers: list[LogHeader] = []
        self.records: list[list[tuple[int, int]]] = []
        self.cut: set[int] = set()
        self.pieces: list[tuple[int, int]] = []
        self.first = -1
        self.whole = len(MAGIC)
        self.closed = False
        self.damage: list[str] = []

    def take(self, kind: int, begin: int, content: bytes) -> None:
        """Takes the next intact record, of which ``begin`` is the place."""
        place = (begin + OVERHEAD, len(content))
        if kind == HEADER:
            self.headers.append(decode_header(content, self.path))
        elif kind == EPISODE:
            self.break_off()
            self.records.append([place])
        elif kind in (PART, END):
            self._take_piece(kind, begin, place, content)
        self.closed = kind == CLOSED
        if not self.pieces:
            self.whole = place[0] + place[1]

    def _take_piece(self, kind: int, begin: int, place: tuple[int, int], content: bytes) -> None:
        first, number = decode(content, f"log {self.path}, record at byte {begin}").part or (begin, 0)
        if (first, number) != (self.first, len(self.pieces)) or not self.pieces:
            self.break_off()
            if number > 0:
                self.damage.append(f"{self.path.name}: piece {number} of an episode, without those before, at {begin}.")
                return
        self.first = first
        self.pieces.append(place)
        if kind == END:
            self.records.append(self.pieces)
            self.pieces = []

    def break_off(self) -> None:
        """Ends an episode of which no more pieces come."""
        if self.pieces:
            self.cut.add(len(self.records))
            self.records.append(self.pieces)
            self.pieces = []


def scan(path: Path, *, salvage: bool = False, fallback: LogHeader | None = None) -> LogIndex:
    """Checks every record's CRC and finds the end of the intact part.

    Args:
        path: The log.
        salvage: Whether to go on behind damaged records, which ``damage`` then names.
        fallback: The header, where none is left.

    Raises:
        FileFormatError: For a file that is no log, is of another version, or (unless ``salvage``) is damaged before its
            tail; the number of the damaged record is named. With ``salvage``, where no header is left.
    """
    found = _Scan(path)
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(MAGIC)) != MAGIC:
            if not salvage:
                raise FileFormatError(
                    f"log {path}", expected="a log of recorded episodes", actual="another kind of file"
                )
            found.damage.append(f"{path.name}: the first bytes are damaged.")
        end, number, before = len(MAGIC), 0, len(MAGIC)
        while True:
            content = _content(file, end, size)
            if content is None:
                behind = _nextrecord(file, end, size)
                if behind is None:
                    break
                if not salvage:
                    raise FileFormatError(
                        f"log {path}, record {number}",
                        expected="the content that its CRC-32 was computed from",
                        actual=f"damage at byte {end}, before intact records",
                        hint="`mpcoffline datasets repair --salvage` takes what is intact, and says what is not.",
                    )
                found.damage.append(f"{path.name}: bytes {end} to {behind} are damaged.")
                end = behind
                continue
            kind, inner = content
            if not found.headers and kind != HEADER and not salvage:
                break
            try:
                found.take(kind, end, inner)
            except FileFormatError as error:
                if not salvage:
                    raise
                found.damage.append(str(error))
            end = before = end + OVERHEAD + len(inner)
            number += kind != HEADER or number == 0
    found.break_off()
    header = found.headers[0] if found.headers else fallback
    if header is None:
        raise FileFormatError(f"log {path}", expected="a header", actual="none, or a damaged one")
    if salvage and end < size:
        found.damage.append(
            f"{path.name}: bytes {end} to {size}, the last, are damaged or were not written to their end."
        )
    return LogIndex(
        path,
        header,
        found.records,
        frozenset(found.cut),
        before,
        found.whole,
        size - before,
        found.closed,
        tuple(found.damage),
    )


class EpisodeLog:
    """Writes a log: each episode reaches the system as soon as it ends, and the disk every now and then.

    A killed process loses no episode that was appended; a lost power supply none of those before the last
    synchronisation (every ``sync_episodes`` episodes or ``sync_seconds`` seconds, and at the end).

    Args:
        path: The file. A new one gets the header; one that exists goes on after its last intact record.
        header: The header of a new file.
        sync_episodes: Number of episodes between synchronisations.
        sync_seconds: Seconds after which appended episodes are synchronised at the latest.
        keep_cut: Whether the pieces of an episode that a crash cut off stay, as an episode that did not end.

    Raises:
        FileFormatError: For an existing file that is damaged before its tail.
        StorageError: Where the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        header: LogHeader,
        *,
        sync_episodes: int = 10,
        sync_seconds: float = 5.0,
        keep_cut: bool = True,
    ) -> None:
        self.path = path
        self._every, self._seconds = sync_episodes, sync_seconds
        self._pending, self._since = 0, time.monotonic()
        if not path.exists():
            _create(path, header)
        index = scan(path)
        self._end = index.end if keep_cut else index.whole
        self._header = None if index.records else _header_content(header)
        self._first, self._pieces = -1, 0
        self._fd = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
        os.ftruncate(self._fd, self._end)

    def append(self, episode: LoggedEpisode) -> None:
        """Adds an episode, or the last piece of one.

        Raises:
            StorageError: Where it cannot be written; the file then ends with the episode before.
        """
        if self._pieces:
            self._append(replace(episode, part=(self._first, self._pieces)), END)
        else:
            self._append(episode, EPISODE)
        self._first, self._pieces = -1, 0

    def append_piece(self, piece: LoggedEpisode) -> None:
        """Adds a piece, but the last, of a long episode that is under way.

        Raises:
            StorageError: Where it cannot be written; the file then ends with the piece before.
        """
        first = self._first if self._pieces else self._end
        self._append(replace(piece, part=(first, self._pieces)), PART)
        self._first, self._pieces = first, self._pieces + 1

    def _append(self, episode: LoggedEpisode, kind: int) -> None:
        self._write(encode(episode), kind)
        if self._header is not None:
            self._write(self._header, HEADER)
            self._header = None
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
        whole = memoryview(framed(kind, content, self._end))
        try:
            written = 0
            while written < len(whole):
                written += os.pwrite(self._fd, whole[written:], self._end + written)
        except OSError as error:
            os.ftruncate(self._fd, self._end)
            raise StorageError.of(self.path, error) from error
        self._end += len(whole)


def _header_content(header: LogHeader) -> bytes:
    return json.dumps({"version": VERSION, **asdict(header)}).encode()


def _create(path: Path, header: LogHeader) -> None:
    new = path.with_suffix(".new")
    try:
        with new.open("wb") as file:
            file.write(MAGIC + framed(HEADER, _header_content(header), len(MAGIC)))
            file.flush()
            os.fsync(file.fileno())
        os.replace(new, path)
    except OSError as error:
        new.unlink(missing_ok=True)
        raise StorageError.of(path, error) from error


def _content(file: BinaryIO, offset: int, size: int) -> tuple[int, bytes] | None:
    """Kind and content of the record at ``offset``; None where there is no intact one."""
    try:
        file.seek(offset)
        frame = unframed(file.read(OVERHEAD), offset)
        if frame is None or offset + OVERHEAD + frame[1] > size:
            return None
        content = file.read(frame[1])
    except OSError:  # a disk that cannot read there
        return None
    return (frame[0], content) if len(content) == frame[1] and zlib.crc32(content) == frame[2] else None


def _nextrecord(file: BinaryIO, offset: int, size: int) -> int | None:
    """Where the first intact record behind ``offset`` begins; None where there is none."""
    start = offset + 1
    while start < size:
        try:
            file.seek(start)
            block = file.read(_BLOCK + len(MARKER) - 1)
        except OSError:
            block = b""
        at = block.find(MARKER)
        while at >= 0:
            if _content(file, start + at, size) is not None:
                return start + at
            at = block.find(MARKER, at + 1)
        start += _BLOCK
    return None
