"""Where the package keeps what it can make again, and whom it trusts there.

``$MPCOFFLINE_CACHE`` names one folder for everything that is kept: compiled solvers, tables, notes. Without it, it is
``mpcoffline`` in the user's cache folder (``$XDG_CACHE_HOME``, else ``~/.cache``). A folder, or a file in it, counts
only if nobody but this user (or root) owns it or can write it: compiled code is run, and numbers are learned from.
Where no such folder can be had, a private one among the temporary files takes its place.
"""

from __future__ import annotations

import atexit
import functools
import logging
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

import platformdirs

from .errors import StorageError

logger = logging.getLogger(__name__)

_ROOT = 0
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def cache_root() -> Path | None:
    """The folder of all caches, whether it exists or not; None where the user has no home."""
    try:
        if chosen := os.environ.get("MPCOFFLINE_CACHE", "").strip():
            return Path(chosen).expanduser().absolute()
        folder = platformdirs.user_cache_path("mpcoffline")
        if not folder.is_absolute():  # $XDG_CACHE_HOME is no absolute path: as if unset, says its specification
            folder = Path.home() / ".cache" / "mpcoffline"
    except RuntimeError:  # "~" without a home
        return None
    return folder if folder.is_absolute() else None


def temporary_root() -> Path:
    """The folder of what has no room in :func:`cache_root`, whether it exists or not."""
    return Path(tempfile.gettempdir()) / f"mpcoffline-{os.geteuid()}"


def cache_folder(kind: str) -> Path:
    """The folder of one kind of what can be made again: made here if need be, and private.

    Args:
        kind: Its name below the folder of all caches, e.g. ``"tables"``.

    Raises:
        StorageError: Where there is no such folder, not even among the temporary files.
    """
    for folder in cache_folders(kind):
        if os.access(folder, os.W_OK | os.X_OK):
            return folder
        warn_once(f"The cache folder {folder} cannot be used, it cannot be written.")
    raise StorageError(f"cache of {kind}", expected="a folder that can be written", actual="none")


def cache_folders(kind: str) -> Iterator[Path]:
    """The folder of one kind, then the one among the temporary files, for what the first has no room for.

    Raises:
        StorageError: Where there is no such folder.
    """
    root = cache_root()
    if root is None:
        warn_once("There is no home directory to keep anything in, nor MPCOFFLINE_CACHE: temporary files are used.")
    elif _is_made_private(root) and _is_made_private(root / kind):
        yield root / kind
    yield _temporary_folder(kind)


def private_folder(folder: Path | None, kind: str) -> Path:
    """A folder that a user chose; a temporary one where it exists and others own it or can write it.

    Args:
        folder: The folder; None for :func:`cache_folder`.
        kind: What it is for, as there.

    Raises:
        StorageError: Where there is no such folder.
    """
    if folder is None:
        return cache_folder(kind)
    return folder if not folder.exists() or _is_made_private(folder) else _temporary_folder(kind)


def open_own(path: Path) -> int:
    """Opens a file for reading, if it is a regular one that nobody but this user (or root) owns or can write.

    The file that is looked at is the one that is opened, so that it cannot be another one afterwards; a link is none.

    Returns:
        The file descriptor.

    Raises:
        OSError: If there is no such file; ``PermissionError`` if it is another's.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    found = os.fstat(descriptor)
    reason = _distrust(found) if stat.S_ISREG(found.st_mode) else "is no regular file"
    if reason:
        os.close(descriptor)
        raise PermissionError(f"{path} {reason}")
    return descriptor


def distrusted(folder: Path) -> str:
    """Why a folder cannot be trusted, in words; empty if it can.

    Raises:
        OSError: If there is none.
    """
    link, found = folder.lstat(), folder.stat()
    if not stat.S_ISDIR(found.st_mode):
        return "is no folder"
    if link.st_uid not in (_ROOT, os.geteuid()):
        return f"belongs to user {link.st_uid}"
    return _distrust(found)


def _distrust(found: os.stat_result) -> str:
    if found.st_uid not in (_ROOT, os.geteuid()):
        return f"belongs to user {found.st_uid}"
    return "can be written by others" if found.st_mode & _OTHERS_WRITE else ""


def _is_made_private(folder: Path, *, tell: bool = True) -> bool:
    """Makes a folder if there is none; whether it is this user's alone."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        reason = distrusted(folder)
    except OSError as error:
        reason = f"cannot be made: {error.strerror or error}"
    if reason and tell:
        warn_once(f"The cache folder {folder} cannot be used, it {reason}: a temporary folder takes its place.")
    return not reason


def _temporary_folder(kind: str) -> Path:
    """The folder of one kind among the temporary files: the user's own, else one of this process alone."""
    root = temporary_root()
    try:
        if not _is_made_private(root, tell=False):
            root = _folder_of_this_process()
        (root / kind).mkdir(mode=0o700, exist_ok=True)
        if not distrusted(root / kind):
            return root / kind
        return Path(tempfile.mkdtemp(dir=_folder_of_this_process(), prefix=f"{kind}-"))
    except OSError as error:
        raise StorageError.of(root, error) from error


@functools.cache
def _folder_of_this_process() -> Path:
    folder, owner = Path(tempfile.mkdtemp(prefix="mpcoffline-")), os.getpid()

    def remove() -> None:
        if os.getpid() == owner:  # not a fork of it
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder


@functools.cache
def warn_once(text: str) -> None:
    """Logs a warning, unless this process did so before."""
    logger.warning(text)
