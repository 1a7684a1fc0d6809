"""Files that appear complete or not at all: replaced only as a whole, and refused before the work, not after it.

What exists and is no regular file (a device, a FIFO, a socket, a folder) is never opened and never replaced.
"""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import IO

from .atomic import sync_folder
from .errors import FileFormatError, StorageError
from .files import check_regular

_UNIQUE = re.compile("[0-9a-f]{12}")


@contextmanager
def replaced(path: str | PathLike[str]) -> Iterator[IO[bytes]]:
    """A new file that takes its name once it is complete and on the disk; until then, what was there stays.

    A symbolic link stays one: what it points to is replaced, and keeps its permissions. Where the old file may not be
    written, nothing is. What a killed process has left of the same name goes first.

    Args:
        path: Its name.

    Yields:
        The file, for writing.

    Raises:
        StorageError: If what is there is no regular file, or the disk or the file system refuses.
    """
    target = _target(path)
    begin = f".{target.name[:100]}."
    temporary = target.with_name(f"{begin}{uuid.uuid4().hex[:12]}")
    try:
        _remove_abandoned(target.parent, begin)
        with _locked(temporary) as file:
            with suppress(OSError):  # there is none, or its mode cannot be had
                os.fchmod(file.fileno(), target.stat().st_mode & 0o777)
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(temporary, target)  # while it is locked: nobody takes it for abandoned
        with suppress(OSError):  # a file system that cannot say so
            sync_folder(target.parent)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and not isinstance(error, StorageError):  # which names the temporary file
            raise StorageError.of(path, OSError(error.strerror or str(error))) from error
        raise


def _locked(path: Path) -> IO[bytes]:
    """A new file with a lock: who looks for abandoned ones may have taken the first before it had one."""
    while True:
        file = path.open("xb")
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        with suppress(FileNotFoundError):
            if os.path.samestat(path.stat(), os.fstat(file.fileno())):
                return file
        file.close()


def _remove_abandoned(folder: Path, begin: str) -> None:
    """Removes the temporary files that nobody writes any more: the system gives their locks back with their process."""
    with suppress(OSError), os.scandir(folder) as entries:
        ours = [e for e in entries if e.name.startswith(begin) and _UNIQUE.fullmatch(e.name[len(begin) :])]
        for path in (entry.path for entry in ours if entry.is_file(follow_symlinks=False)):
            # Not to wait for a writer, should it have become a FIFO since.
            with suppress(OSError), open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.unlink(path)


def write_file(path: str | PathLike[str], content: bytes | str) -> Path:
    """Writes a file as :func:`replaced` does; its folder is made where it is missing.

    Args:
        path: The file.
        content: What it holds; text in UTF-8.

    Returns:
        The path.

    Raises:
        StorageError: As :func:`replaced`.
    """
    make_folder(Path(path).parent)
    with replaced(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)
    return Path(path)


def make_folder(folder: str | PathLike[str]) -> Path:
    """Makes a folder and those above it.

    Raises:
        StorageError: If that is impossible.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError.of(folder, OSError(error.strerror or str(error))) from error
    return Path(folder)


def check_output(path: str | PathLike[str], *, make: bool = False) -> None:
    """Refuses a file that could not be written at the end of the work: before it.

    Args:
        path: The file.
        make: Whether a missing folder will be made.

    Raises:
        StorageError: If what is there is no regular file, or its folder is missing or takes no new file.
    """
    target = _target(path)
    if make:
        check_output_folder(target.parent)
    else:
        _check_takes_files(target.parent)


def check_output_folder(folder: str | PathLike[str], names: tuple[str, ...] = ()) -> None:
    """Refuses a folder in which nothing could be written at the end of the work: before it. It is not made.

    Args:
        folder: The folder.
        names: Of the files that will be written there.

    Raises:
        StorageError: If it is something else, or cannot be made or written in.
    """
    nearest = Path(folder)
    while not os.path.lexists(nearest) and nearest != nearest.parent:
        nearest = nearest.parent
    _check_takes_files(nearest)
    for name in names if nearest == Path(folder) else ():
        _target(nearest / name)


def _target(path: str | PathLike[str]) -> Path:
    """The file that a name stands for, through links."""
    try:
        target = Path(path).resolve()
        check_regular(target)
    except FileNotFoundError:
        return target
    except FileFormatError as error:
        raise StorageError(
            f"file {path}", expected="a file or nothing there", actual=error.actual, hint="Name another file."
        ) from error
    except (OSError, RuntimeError, ValueError) as error:  # links in a circle, a name with a zero byte
        raise StorageError(f"file {path}", expected="a name for a file", actual=str(error)) from error
    if not os.access(target, os.W_OK):
        raise StorageError(f"file {path}", expected="a file that may be written", actual="a read-only one")
    return target


def _check_takes_files(folder: Path) -> None:
    """Tries it: permissions, read-only disks and quotas are too many to be asked one by one."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"0")
    except OSError as error:
        raise StorageError.of(f"in folder {folder}", OSError(error.strerror or str(error))) from error
