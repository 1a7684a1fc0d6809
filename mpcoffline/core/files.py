"""Opening files that somebody else may have put there: regular ones, and no more of them than a limit."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from mpcoffline.core.limits import HOLES, check_limit

from .errors import FileFormatError

_SMALL = 64 << 20


def check_regular(path: Path) -> os.stat_result:
    """Refuses what is no regular file before it is opened: opening a FIFO or a device can wait for ever.

    A link counts as what it leads to. A file of holes, which claims far more bytes than it occupies, is none either:
    reading it would take for ever, too.

    Args:
        path: The file.

    Returns:
        What the system says of it.

    Raises:
        FileFormatError: For anything else.
        FileNotFoundError: Where there is nothing.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise FileFormatError(f"file {path}", expected="a regular file", actual=_kind(status.st_mode))
    if status.st_size > max(_SMALL, HOLES * 512 * status.st_blocks):
        raise FileFormatError(
            f"file {path}",
            expected=f"its {status.st_size} bytes on the disk",
            actual=f"{512 * status.st_blocks}: it is full of holes",
        )
    return status


def read_limited(path: Path, limit: int) -> bytes:
    """The content of a regular file of at most ``limit`` bytes.

    Raises:
        FileFormatError: For a larger one, or what is no regular file.
        OSError: Where it cannot be read.
    """
    check_limit(f"file {path}", "bytes", check_regular(path).st_size, limit)
    # It may have become something else since: neither wait for a writer nor read without end.
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        content = file.read(limit + 1)
    check_limit(f"file {path}", "bytes", len(content), limit)
    return content


def _kind(mode: int) -> str:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a FIFO",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
        stat.S_IFSOCK: "a socket",
    }
    return kinds.get(stat.S_IFMT(mode), "something else")
