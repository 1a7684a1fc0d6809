"""Where the logs of a recording lie, and who may write them.

The logs are ``<Minari store>/.recording/<data set id>/env-0000.log``, one for each environment. ``lock`` beside
them is held while somebody records or seals; the system frees it with the process, however that ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import socket
import weakref
from pathlib import Path

from mpcoffline.core.errors import InvalidArgumentError, StorageError

from .ids import RECORDINGS, dataset_path


def recording_path(dataset_id: str) -> Path:
    """The folder of a data set's logs, whether it exists or not."""
    return dataset_path("") / RECORDINGS / dataset_id


def log_files(dataset_id: str) -> list[Path]:
    """The logs of a data set that have not been sealed."""
    return sorted(recording_path(dataset_id).glob("env-*.log"))


def check_not_recorded(dataset_id: str) -> None:
    """Refuses an id under which somebody records, or whose recording was interrupted.

    Raises:
        InvalidArgumentError: Where there are logs, or a lock that is held.
    """
    path = recording_path(dataset_id) / "lock"
    found = f"an interrupted recording in {path.parent}" if log_files(dataset_id) else ""
    if path.exists():
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            found = f"a recording under way ({_holder(descriptor)})"
        finally:
            os.close(descriptor)
    if found:
        raise InvalidArgumentError(
            f"data set {dataset_id!r}",
            expected="an id under which nothing is recorded",
            actual=found,
            hint=f"Choose another id; `mpcoffline datasets repair {dataset_id}` makes the data set of an interrupted"
            " recording.",
        )


def _holder(descriptor: int) -> str:
    """Who holds the lock: a process that lives, or "another process"."""
    said = os.pread(descriptor, 200, 0).decode(errors="replace")
    words = said.split()
    try:
        if words[3] == socket.gethostname():
            os.kill(int(words[1]), 0)
    except PermissionError:
        pass  # it lives, but is somebody else's
    except (IndexError, ValueError, OSError, OverflowError):
        return "another process"
    return said


class RecordingLock:
    """The right to write a data set's logs; the lock of a process that has died is free.

    Args:
        dataset_id: The data set.

    Raises:
        InvalidArgumentError: Where somebody else has it; names the process.
        StorageError: Where the folder cannot be written.
    """

    def __init__(self, dataset_id: str) -> None:
        self.folder: Path = recording_path(dataset_id)
        self._path = self.folder / "lock"
        self._fd = -1
        _OPEN.add(self)
        try:
            while not self._opened():
                pass
        except BlockingIOError as error:
            holder = _holder(self._fd)
            self._close()
            raise InvalidArgumentError(
                f"data set {dataset_id!r}",
                expected="one recorder at a time",
                actual=f"another one at work ({holder})",
                hint="Wait for it, or record under another id; an interrupted recorder of this process is freed by"
                " `recorder.close()`.",
            ) from error
        except OSError as error:
            raise StorageError.of(self._path, error) from error
        with contextlib.suppress(OSError):  # on a full disk it has no name, but it holds
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)

    def _opened(self) -> bool:
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            self._fd = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except FileNotFoundError:  # somebody tidies up: see remove_empty
            return False
        fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Who held it may have removed the file in the meantime: then it is not the lock any more.
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(self._path.stat(), os.fstat(self._fd)):
                return True
        self._close()
        return False

    def release(self) -> None:
        """Gives it back, and removes the folder where there are no logs in it; harmless when repeated."""
        if self._fd < 0:
            return
        if not any(self.folder.glob("env-*.log")):
            shutil.rmtree(self.folder / "building", ignore_errors=True)
            for path in (*self.folder.glob("env-*.new"), self._path):  # a log that was not begun
                path.unlink(missing_ok=True)
            folder = self.folder
            while folder != dataset_path(""):
                try:
                    folder.rmdir()
                except OSError:
                    break
                folder = folder.parent
        self._close()

    @property
    def held(self) -> bool:
        """Whether this process has it: neither after its release nor in a fork of the process that has it."""
        return self._fd >= 0

    def _close(self) -> None:
        descriptor, self._fd = self._fd, -1
        if descriptor >= 0:
            os.close(descriptor)

    def __del__(self) -> None:
        if hasattr(self, "_fd"):
            self._close()


def empty_recordings() -> list[Path]:
    """Folders without a log that killed recorders left, each with all that is below it; nobody holds their locks."""

    def outermost(folder: Path) -> list[Path]:
        files = [path for path in folder.rglob("*") if path.is_file()]
        known = all(
            path.name == "lock" or path.match("env-*.new") or "building" in path.relative_to(folder).parts
            for path in files
        )
        if known and not any(folder.rglob("env-*.log")) and all(map(_is_free, folder.rglob("lock"))):
            return [folder]
        below = [] if any(path.parent == folder for path in files) else sorted(folder.iterdir())
        return [found for part in below if part.is_dir() for found in outermost(part)]

    root = dataset_path("") / RECORDINGS
    return outermost(root) if root.is_dir() else []


def remove_empty(folder: Path) -> None:
    """Removes one of :func:`empty_recordings`, but for where somebody has begun to record meanwhile."""
    held = {path.parent for name in ("lock", "env-*.new") for path in folder.rglob(name)}
    for path in sorted(held):
        with contextlib.suppress(InvalidArgumentError, StorageError):
            RecordingLock(path.relative_to(dataset_path("") / RECORDINGS).as_posix()).release()
    for path in sorted([folder, *folder.rglob("*")], reverse=True):
        with contextlib.suppress(OSError):
            path.rmdir()


def _is_free(lock: Path) -> bool:
    with contextlib.suppress(OSError), lock.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return True
    return False


_OPEN: weakref.WeakSet[RecordingLock] = weakref.WeakSet()


def _let_go() -> None:
    """In a forked process: the lock stays with the recorder's, and ends with it however long this one lives."""
    for lock in list(_OPEN):
        lock._close()


os.register_at_fork(after_in_child=_let_go)
