"""Folders in which something is built: gone at the end, and recognised where a process was killed.

Each holds a lock file, which the system unlocks when the process ends, however it ends. So a folder whose lock can be
had is nobody's any more.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

PREFIX = ".building-"
_LOCK, _CONTENT = ".lock", "content"
_HOUR = 3600.0


@contextmanager
def scratch_folder(parent: Path) -> Iterator[Path]:
    """An empty folder below ``parent``, in its file system, to build in and perhaps to rename; gone at the end.

    What killed processes left in that place goes first.

    Args:
        parent: Folder in which it is hidden; it must exist.

    Raises:
        OSError: Where the disk refuses.
    """
    with suppress(OSError):
        for leftover in abandoned(parent):
            remove_abandoned(leftover)
    folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
    lock = FileLock(folder / _LOCK, timeout=10.0, thread_local=False)
    try:
        lock.acquire()  # not at once only where another process looks whether this folder is abandoned
        (folder / _CONTENT).mkdir(mode=0o700)
        yield folder / _CONTENT
    except Timeout as error:
        raise OSError(f"the lock of {folder} cannot be had") from error
    finally:
        _remove(folder)
        lock.release()


def abandoned(parent: Path) -> list[Path]:
    """The folders below ``parent`` in which a killed process built something, and nobody does any more.

    Raises:
        OSError: Where ``parent`` cannot be read.
    """
    found = (path for path in sorted(parent.glob(PREFIX + "*")) if path.is_dir() and not path.is_symlink())
    return [path for path in found if _is_abandoned(path)]


def remove_abandoned(folder: Path) -> None:
    """Removes one of :func:`abandoned`. An empty one goes as such: if its lock has come meanwhile, it stays."""
    with suppress(OSError):
        folder.rmdir()
        return
    if _is_abandoned(folder):
        _remove(folder)


def _remove(folder: Path) -> None:
    """The lock goes last: what a killed process leaves of the rest is abandoned as well."""
    shutil.rmtree(folder / _CONTENT, ignore_errors=True)
    shutil.rmtree(folder, ignore_errors=True)


def _is_abandoned(folder: Path) -> bool:
    try:
        if not any(folder.iterdir()):  # killed within the first moments; or its lock comes next, and brings it back
            return True
        if not (folder / _LOCK).is_file():
            return time.time() - folder.stat().st_mtime > _HOUR
        return is_free(folder / _LOCK)
    except OSError:  # another user's
        return False


def is_free(lock: Path) -> bool:
    """Whether no living process holds a lock file that this one may open."""
    try:
        with FileLock(lock, timeout=0.0, thread_local=False):
            return True
    except (OSError, Timeout):
        return False
