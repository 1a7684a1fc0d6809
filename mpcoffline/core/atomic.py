"""Folders that appear complete or not at all, also after a lost power supply."""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import sys
from pathlib import Path

_RENAME_EXCHANGE = 2
_AT_FDCWD = -100


def sync_folder(folder: Path) -> None:
    """Waits until the folder's own entries are on the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Waits until all files and folders below ``folder`` are on the disk."""
    for parent, _, files in os.walk(folder):
        for name in files:
            with (Path(parent) / name).open("rb") as file:
                os.fsync(file.fileno())
        sync_folder(Path(parent))


def publish(building: Path, target: Path, *, overwrite: bool) -> None:
    """Gives a finished folder its final name; what had that name is removed, after the fact.

    Where the target lies on another disk (it, or a folder above it, is a link), the folder is copied beside it first,
    so that it still appears in one step. A target that is a link stays one: what it leads to is replaced.

    Args:
        building: The finished folder.
        target: Its final name.
        overwrite: Whether an existing folder is replaced, in one step where the system can (Linux).

    Raises:
        OSError: Where the target exists and must not be replaced, or the file system refuses.
    """
    if target.is_symlink():
        target = Path(os.path.realpath(target))
    target.parent.mkdir(parents=True, exist_ok=True)
    sync_tree(building)
    try:
        _rename(building, target, overwrite)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        beside = target.parent / f".building-{building.name.removeprefix('.building-')}-{os.getpid()}"
        try:
            shutil.copytree(building, beside)
            sync_tree(beside)
            _rename(beside, target, overwrite)
        finally:
            shutil.rmtree(beside, ignore_errors=True)
        shutil.rmtree(building)


def _rename(building: Path, target: Path, overwrite: bool) -> None:
    if overwrite and target.exists():
        if not _exchange(building, target):
            # The gap between these two renames is closed by sealing again: the logs are still there.
            aside = building.with_name(f"{building.name}-replaced")
            os.rename(target, aside)
            os.rename(building, target)
            os.rename(aside, building)
        sync_folder(target.parent)
        shutil.rmtree(building)
    else:
        os.rename(building, target)
        sync_folder(target.parent)


def _exchange(first: Path, second: Path) -> bool:
    """Swaps two names in one step; False where the system cannot."""
    if sys.platform != "linux":
        return False
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:
        return False
    if rename(_AT_FDCWD, os.fsencode(first), _AT_FDCWD, os.fsencode(second), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.EINVAL, errno.ENOSYS, errno.EPERM):
        return False
    raise OSError(code, os.strerror(code), str(first))
