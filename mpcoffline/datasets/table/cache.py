"""Packed tables in files: written block by block, found again by the content they were built from.

The key of a table is the SHA-256 of the data set's file: not its name, since a copy is the same, and not
its size and date alone, since a file can be changed and keep both. Hashing takes about a second a gigabyte, so
the hash is remembered for as long as inode, size, and the times of modification and of status change (which nobody
sets) are the same.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
import weakref
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.atomic import publish
from mpcoffline.core.caches import mark_used, read_note, trim, write_note
from mpcoffline.core.errors import FileFormatError, StorageError
from mpcoffline.core.limits import TABLE_META_BYTES, check_limit
from mpcoffline.core.places import open_own
from mpcoffline.core.scratch import scratch_folder
from mpcoffline.datasets.store.manifest import sha256_of

from .centring import Centring

VERSION = 3 if sys.byteorder == "little" else -3  # rows lie there as this machine keeps numbers
READ_BYTES = 1 << 18
_ROWS, _IDS, _META = "rows.f32", "episodes.i64", "table.json"


class TableFile:
    """A table in a folder: packed rows, episode ids, and the CRC-32 of each block of rows.

    Args:
        folder: The folder, as :func:`write_table` leaves it. It may be removed afterwards: the files stay open.

    Attributes:
        ny: Number of observation coordinates.
        nu: Number of action coordinates.
        centring: What the rows are packed without.
        raw_rows: The rows ``(n, 2 ny + nu + 2)`` as they are in the file, mapped; :attr:`rows` are checked.
        raw_ids: The episode of each ``(n,)``, likewise.
        block_rows: Number of rows in a block.

    Raises:
        FileFormatError: For a folder that is not such a table, of another version, or with files of another size.
    """

    ny: int
    nu: int
    block_rows: int

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            with os.fdopen(open_own(folder / _META), encoding="utf-8") as meta_file:
                size = os.fstat(meta_file.fileno()).st_size
                check_limit(str(folder / _META), "bytes", size, TABLE_META_BYTES)
                meta = json.loads(meta_file.read(size))
            if meta["version"] != VERSION:
                raise ValueError(f"version {meta['version']}")
            if meta.pop("crc") != _crc(meta):
                raise ValueError(f"{_META} with another CRC-32")
            self.ny, self.nu, n = int(meta["ny"]), int(meta["nu"]), int(meta["rows"])
            self.block_rows, self._crcs = int(meta["block_rows"]), [int(crc) for crc in meta["crcs"]]
            self._ids_crc = int(meta["ids_crc"])
            self._fd = open_own(folder / _ROWS)
            weakref.finalize(self, os.close, self._fd)
            shape = (n, 2 * self.ny + self.nu + 2)
            self.row_bytes: int = 4 * shape[1]
            self.centring: Centring = Centring.from_json(meta["centring"])
            if (self.centring.centre.shape, self.centring.increments.shape) != ((shape[1],), (self.ny,)):
                raise ValueError("centres of another width")
            with os.fdopen(open_own(folder / _IDS), "rb") as ids_file, os.fdopen(os.dup(self._fd), "rb") as rows_file:
                sizes = (os.fstat(self._fd).st_size, os.fstat(ids_file.fileno()).st_size)
                if sizes != (n * self.row_bytes, 8 * n) or len(self._crcs) != -(-n // self.block_rows):
                    raise ValueError(f"files of {sizes} bytes for {n} rows")
                self.raw_rows: NDArray[np.float32] = np.memmap(rows_file, np.float32, "r", shape=shape)
                self.raw_ids: NDArray[np.int64] = np.memmap(ids_file, np.int64, "r", shape=(n,))
        except (OSError, ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:
            raise self._damaged(f"{type(error).__name__}: {error}") from error
        self._ids_checked = False
        self._checked = np.zeros(len(self._crcs), dtype=bool)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.raw_rows)

    @property
    def width(self) -> int:
        """Number of columns, 2 ny + nu + 2."""
        return int(self.raw_rows.shape[1])

    @property
    def rows(self) -> NDArray[np.float32]:
        """The rows ``(n, 2 ny + nu + 2)``, mapped; all of them are checked the first time.

        Raises:
            FileFormatError: Where they are not what was written.
        """
        if not self._checked.all():
            block = np.empty((self.block_rows, self.width), np.float32)
            for number in np.flatnonzero(~self._checked).tolist():
                self.read_block(number, block)
        return self.raw_rows

    @property
    def episode_ids(self) -> NDArray[np.int64]:
        """The episode of each row ``(n,)``, mapped; checked the first time.

        Raises:
            FileFormatError: Where they are not what was written.
        """
        if not self._ids_checked:
            if zlib.crc32(_bytes(self.raw_ids)) != self._ids_crc:
                raise self._damaged("episode ids with another CRC-32")
            self._ids_checked = True
        return self.raw_ids

    @property
    def identity(self) -> list[Any]:
        """What tells it from other tables: sizes, centring and checksums, as JSON."""
        sizes = [self.ny, self.nu, len(self), self.block_rows, self._ids_crc]
        return [*sizes, self.centring.to_json(), *self._crcs]

    @property
    def n_blocks(self) -> int:
        """Number of blocks, the last of which may be shorter."""
        return len(self._crcs)

    def load(self) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Reads rows and episode ids into memory and checks them.

        Raises:
            FileFormatError: Where they are not what was written.
        """
        rows, ids = np.empty(self.raw_rows.shape, np.float32), np.array(self.raw_ids)
        for block in range(self.n_blocks):
            start = block * self.block_rows
            self.read_block(block, rows[start : start + self.block_rows])
        if zlib.crc32(ids.data) != self._ids_crc:
            raise self._damaged("episode ids with another CRC-32")
        return rows, ids

    def read_block(self, block: int, out: NDArray[np.float32]) -> int:
        """Reads a block into the first rows of ``out`` and checks it the first time; returns its number of rows.

        Raises:
            FileFormatError: Where it is not what was written.
        """
        count = min(self.block_rows, len(self) - block * self.block_rows)
        view = _bytes(out[:count])
        offset, done = block * self.block_rows * self.row_bytes, 0
        while done < len(view):
            got = os.preadv(self._fd, [view[done:]], offset + done)
            if got == 0:
                raise self._damaged(f"an end at byte {offset + done}")
            done += got
        if not self._checked[block]:
            if zlib.crc32(view) != self._crcs[block]:
                raise self._damaged(f"block {block} with another CRC-32")
            self._checked[block] = True
        return count

    def advise(self, block: int, *, needed: bool) -> None:
        """Tells the system to fetch a block in the background, or that its copy in the page cache is not needed."""
        if hasattr(os, "posix_fadvise"):
            size = self.block_rows * self.row_bytes
            advice = os.POSIX_FADV_WILLNEED if needed else os.POSIX_FADV_DONTNEED
            os.posix_fadvise(self._fd, block * size, size, advice)

    def _damaged(self, found: str) -> FileFormatError:
        return FileFormatError(
            f"table {self.folder}", expected="an intact packed table", actual=found, hint="Remove that folder."
        )


def write_table(
    folder: Path,
    ny: int,
    nu: int,
    blocks: Iterable[tuple[NDArray[Any], NDArray[Any]]],
    centring: Centring | None = None,
) -> None:
    """Writes a table into a folder of its own.

    Args:
        folder: The folder.
        ny: Number of observation coordinates.
        nu: Number of action coordinates.
        blocks: Packed rows ``(B, 2 ny + nu + 2)`` and their episodes ``(B,)``.
        centring: What they are packed without; nothing by default.

    Raises:
        StorageError: Where the disk refuses.
    """
    row_bytes = 4 * (2 * ny + nu + 2)
    block_bytes = max(1, READ_BYTES // row_bytes) * row_bytes
    crcs: list[int] = []
    crc, room, total, ids_crc = 0, block_bytes, 0, 0
    try:
        with (folder / _ROWS).open("wb") as rows_file, (folder / _IDS).open("wb") as ids_file:
            for rows, ids in blocks:
                view = _bytes(np.ascontiguousarray(rows, np.float32))
                rows_file.write(view)
                total += len(view)
                while len(view):
                    part, view = view[:room], view[room:]
                    crc, room = zlib.crc32(part, crc), room - len(part)
                    if room == 0:
                        crcs.append(crc)
                        crc, room = 0, block_bytes
                ids_view = _bytes(np.ascontiguousarray(ids, np.int64))
                ids_file.write(ids_view)
                ids_crc = zlib.crc32(ids_view, ids_crc)
        if room < block_bytes:
            crcs.append(crc)
        meta: dict[str, Any] = {"version": VERSION, "ny": ny, "nu": nu, "rows": total // row_bytes}
        meta |= {"block_rows": block_bytes // row_bytes, "ids_crc": ids_crc}
        meta["centring"] = (centring or Centring.none(ny, nu)).to_json()
        meta["crcs"] = crcs
        (folder / _META).write_text(json.dumps({**meta, "crc": _crc(meta)}), encoding="utf-8")
        for name in (_ROWS, _IDS, _META):
            (folder / name).chmod(0o600)  # whatever the umask: see open_own
    except OSError as error:
        raise StorageError.of(folder, error) from error


def cached_table(
    key: str,
    ny: int,
    nu: int,
    blocks: Iterable[tuple[NDArray[Any], NDArray[Any]]],
    cache: Path,
    again: Callable[[], tuple[Iterable[tuple[NDArray[Any], NDArray[Any]]], Centring] | None] = lambda: None,
) -> TableFile:
    """The table of that key, written now if the cache does not hold it (intact).

    Once the blocks are written, ``again`` says whether the same rows, centred, should take their place.

    Raises:
        StorageError: Where the disk refuses; the cache is as it was.
    """
    target = cache / key
    try:
        file = TableFile(target)
        mark_used(target)
        return file
    except FileFormatError:
        shutil.rmtree(target, ignore_errors=True)
    with _scratch_folder(cache) as building:
        write_table(building, ny, nu, blocks)
        if (better := again()) is not None:
            write_table(building, ny, nu, *better)
        try:
            publish(building, target, overwrite=False)
        except OSError:
            if not target.exists():  # otherwise another process was faster: its table is as good
                raise
        file = TableFile(target)
    trim(keep=target)
    return file


def scratch_table(
    ny: int,
    nu: int,
    blocks: Iterable[tuple[NDArray[Any], NDArray[Any]]],
    cache: Path,
    centring: Centring | None = None,
) -> TableFile:
    """A table in files that have no name any more, so that they vanish with their last user.

    Raises:
        StorageError: Where the disk refuses.
    """
    with _scratch_folder(cache) as folder:
        write_table(folder, ny, nu, blocks, centring)
        file = TableFile(folder)
    file.folder = cache / folder.parent.name
    return file


def content_key(path: Path, episodes: NDArray[Any] | None, cache: Path) -> str:
    """The cache key of a data set's file.

    Args:
        path: The file.
        episodes: The episodes chosen of it; None for all.
        cache: Folder in which hashes are remembered.

    Raises:
        StorageError: Where that folder cannot be written.
    """
    stat = path.stat()
    signature = [stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]
    match read_note(cache, path):
        case {"signature": known, "sha256": str(digest)} if known == signature:
            pass
        case _:
            digest = sha256_of(path)
            write_note(cache, path, {"signature": signature, "sha256": digest})
    chosen = b"" if episodes is None else np.ascontiguousarray(episodes, np.int64).tobytes()
    return hashlib.sha256(digest.encode() + chosen).hexdigest()[:40]


def default_memory() -> int:
    """A quarter of this machine's memory, in bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 4


def _crc(meta: dict[str, Any]) -> int:
    """The CRC-32 of what describes a table."""
    return zlib.crc32(json.dumps(meta, sort_keys=True).encode())


def _bytes(array: Any) -> memoryview:
    """The memory of a contiguous array."""
    return memoryview(array.reshape(-1)).cast("B")


@contextmanager
def _scratch_folder(cache: Path) -> Iterator[Path]:
    try:
        cache.mkdir(mode=0o700, parents=True, exist_ok=True)
        with scratch_folder(cache) as folder:
            yield folder
    except OSError as error:
        raise error if isinstance(error, StorageError) else StorageError.of(cache, error) from error
