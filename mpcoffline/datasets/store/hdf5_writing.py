"""Writing HDF5 files so that a full disk, a quota or Ctrl-C is an exception here and never one inside HDF5.

HDF5 does not survive an error of the system while it closes a file: it frees twice what it could not write, and the
process dies with all that it holds. So HDF5 never meets the disk: a data set is made in memory and then written, in
one piece; or, where it is large, through a :class:`SteadyFile`, which takes everything: what the system refuses is
kept in memory for the moment that it takes to stop, and the error is raised afterwards.
"""

from __future__ import annotations

import io
import itertools
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

WINDOW = 4 << 20
_LOOK = 0.1  # s between two looks for signals
IN_MEMORY = 128 << 20  # bytes of episodes

T = TypeVar("T")


class SteadyFile(io.RawIOBase):
    """A file that can be written and read back whatever the disk says; :meth:`check` tells what it said.

    Its last bytes wait in memory: most of what HDF5 writes, it writes in small pieces near the end.

    Args:
        path: An existing file.

    Raises:
        OSError: Where it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        self._position = 0
        self._base = os.fstat(self._fd).st_size  # what lies behind it is in `_tail`
        self._tail = bytearray()
        self._refused: list[tuple[int, bytes]] = []  # pieces before `_base`
        self._error: BaseException | None = None

    def check(self) -> None:
        """Raises what the system refused, or what :meth:`stop` was told."""
        if self._error is not None:
            raise self._error

    def stop(self, reason: BaseException) -> None:
        """Lets the writer's next :meth:`check` fail."""
        self._error = self._error or reason

    def readable(self) -> bool:
        """True."""
        return True

    def writable(self) -> bool:
        """True."""
        return True

    def seekable(self) -> bool:
        """True."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """As every file's."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._base + len(self._tail)}[whence]
        self._position = start + offset
        return self._position

    def tell(self) -> int:
        """As every file's."""
        return self._position

    def write(self, data: Any, /) -> int:
        """As every file's, but that it never fails."""
        size, begin = len(data), self._position - self._base
        if begin < 0:
            content = bytes(data)
            self._put(content[:-begin], self._position)
            self._tail[: max(0, begin + size)] = content[-begin:]
        else:
            if begin > len(self._tail):
                self._tail.extend(bytes(begin - len(self._tail)))
            self._tail[begin : begin + size] = data
            if len(self._tail) > WINDOW:
                self._write_out(len(self._tail) - WINDOW // 4)
        self._position += size
        return size

    def readinto(self, buffer: Any, /) -> int:
        """As every file's."""
        view = memoryview(buffer).cast("B")
        end = min(self._position + len(view), self._base + len(self._tail))
        stored = max(0, min(end, self._base) - self._position)
        # Shorter only where a piece was refused: it comes next.
        os.preadv(self._fd, [view[:stored]], self._position)
        for offset, piece in self._refused:
            first, last = max(offset, self._position), min(offset + len(piece), self._position + stored)
            if first < last:
                view[first - self._position : last - self._position] = piece[first - offset : last - offset]
        begin = self._position + stored - self._base
        size = max(0, end - self._position)
        view[stored:size] = self._tail[begin : begin + size - stored]
        self._position += size
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """As every file's, but that it never fails."""
        size = self._position if size is None else size
        self.flush()
        if self._error is None and self._try(lambda: os.ftruncate(self._fd, size)):
            self._base = size
        self._tail.extend(bytes(max(0, size - self._base - len(self._tail))))
        return size

    def flush(self) -> None:
        """Hands all that waits in memory to the system."""
        self._write_out(len(self._tail))

    def close(self) -> None:
        """Closes the file; harmless when repeated."""
        if not self.closed:
            super().close()
            os.close(self._fd)

    def _write_out(self, size: int) -> None:
        if self._error is None and size:
            piece = bytes(self._tail[:size])
            if self._try(lambda: _pwrite(self._fd, piece, self._base)):
                self._tail = self._tail[size:]
                self._base += size

    def _put(self, piece: bytes, offset: int) -> None:
        if self._error is not None or not self._try(lambda: _pwrite(self._fd, piece, offset)):
            self._refused.append((offset, piece))

    def _try(self, call: Callable[[], None]) -> bool:
        try:
            call()
        except OSError as error:
            self.stop(error)
        return self._error is None


def _pwrite(descriptor: int, data: bytes, offset: int) -> None:
    written = 0
    while written < len(data):
        written += os.pwrite(descriptor, memoryview(data)[written:], offset + written)


def write_steadily(path: Path, job: Callable[[SteadyFile], None]) -> None:
    """Has HDF5 write a file.

    The job runs in a thread of its own: signals, and with them the exceptions of their handlers (Ctrl-C), come to the
    main thread alone, and so never out of a function that HDF5 calls.

    Args:
        path: An existing file.
        job: Writes into what it is given, by h5py; it calls ``check`` every now and then.

    Raises:
        OSError: What the system refused, after the job has ended.
    """
    file = SteadyFile(path)

    def work() -> None:
        with file:
            job(file)
        file.check()

    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(work)
        try:
            # Where Polars is imported, no signal ends a wait: the system takes it up again, unless it has an end.
            while not wait([done], timeout=_LOOK).done:
                pass
            done.result()
        except BaseException as error:
            file.stop(error)
            raise


def checked(items: Iterable[T], file: SteadyFile) -> Iterator[T]:
    """The items one by one, as long as the file takes what is made of them."""
    for item in items:
        file.check()
        yield item


def store_episodes(storage: Any, episodes: Iterable[EpisodeBuffer], *, new: bool) -> None:
    """Minari's ``update_episodes``, with which no full disk and no signal ends the process.

    What is small enough is made in memory, no slower than on the disk; the rest goes through a :class:`SteadyFile`.

    Args:
        storage: Minari's HDF5 storage; not to be used afterwards.
        episodes: The episodes, taken one at a time (in another thread where they are many).
        new: Whether the storage is empty.

    Raises:
        OSError: What the system refused.
    """
    path = Path(storage._file_path)
    held: deque[EpisodeBuffer] = deque()
    rest = iter(episodes)
    room = IN_MEMORY if new else IN_MEMORY - path.stat().st_size
    for episode in rest:
        held.append(episode)
        room -= _size(vars(episode))
        if room < 0:
            break
    consumed = itertools.chain((held.popleft() for _ in range(len(held))), rest)
    if room >= 0:
        _store_in_memory(storage, path, consumed, mode="w" if new else "r+")
    else:
        _store_steadily(storage, path, consumed, new=new)


def _store_in_memory(storage: Any, path: Path, episodes: Iterable[EpisodeBuffer], *, mode: str) -> None:
    import h5py

    with h5py.File(path, mode, driver="core", backing_store=False, track_order=True) as file:

        def written_at_last() -> Iterator[EpisodeBuffer]:
            yield from episodes
            file.flush()  # and now to the disk, before Minari asks for its size
            path.write_bytes(file.id.get_file_image())

        storage._file_path = file.id  # which Minari gives to h5py.File
        storage.update_episodes(written_at_last())


def _store_steadily(storage: Any, path: Path, episodes: Iterable[EpisodeBuffer], *, new: bool) -> None:
    import h5py

    def job(file: SteadyFile) -> None:
        if new:
            h5py.File(file, "w", track_order=True).close()
        storage._file_path = file  # which Minari gives to h5py.File
        storage.update_episodes(checked(episodes, file))

    write_steadily(path, job)


def _size(item: Any) -> int:
    """Bytes of the arrays of an episode, whatever they are nested in."""
    if isinstance(item, dict):
        return sum(map(_size, item.values()))
    if isinstance(item, tuple | list):
        return sum(map(_size, item))
    return np.asarray(item).nbytes if item is not None else 0
