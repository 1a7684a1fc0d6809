"""What the caches hold: notes about files, and how much in all; what was not used for longest goes first."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from .files import read_limited
from .outputs import write_file
from .places import cache_root, distrusted, temporary_root, warn_once

KINDS = ("solvers", "tables", "checked")
DEFAULT_SIZE = 20 * 10**9
# What is kept has the name of a digest: whatever else a user has in the folder that MPCOFFLINE_CACHE names is his own.
_NAME = re.compile(r"(?:[a-z]+-)?[0-9a-f]{24,64}(?:\.[a-z0-9]+)?")
_NOTE_BYTES = 1000
_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


class Entry(NamedTuple):
    """One thing in a cache: a compiled solver, a table, a note.

    Attributes:
        path: File or folder.
        kind: The cache that it is in, e.g. ``"tables"``.
        size: On the disk, in bytes.
        used: When last, in s since 1970.
    """

    path: Path
    kind: str
    size: int
    used: float


def size_limit() -> int:
    """The bytes that all caches together may hold: ``$MPCOFFLINE_CACHE_SIZE``, e.g. ``"5 GB"``; 20 GB by default."""
    text = os.environ.get("MPCOFFLINE_CACHE_SIZE", "").strip()
    if not text:
        return DEFAULT_SIZE
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kmgt]?)b?", text.lower())
    if found is None:
        warn_once(f"MPCOFFLINE_CACHE_SIZE: expected a size such as '5 GB', got {text!r}: 20 GB is taken.")
        return DEFAULT_SIZE
    return int(float(found[1]) * _UNITS[found[2]])


def entries(root: Path) -> Iterator[Entry]:
    """What the caches below a root hold; neither what is being built nor what is not of this package."""
    for kind in KINDS:
        try:
            paths = [] if distrusted(root / kind) else sorted((root / kind).iterdir())
        except OSError:
            continue
        for path in paths:
            with suppress(OSError):
                found = path.lstat()
                if _NAME.fullmatch(path.name) and not path.is_symlink():
                    yield Entry(path, kind, disk_size(path), max(found.st_atime, found.st_mtime))


def disk_size(path: Path) -> int:
    """The room that a file, or all files in a folder, take on the disk, in bytes."""
    files = (Path(parent) / name for parent, _, names in os.walk(path) for name in names)
    total = 0
    for file in (path, *files):
        with suppress(OSError):
            total += file.lstat().st_blocks * 512
    return total


def read_note(cache: Path, subject: Path) -> Any:
    """What :func:`write_note` kept of a file or folder, from JSON; None where nothing that can be read is there."""
    try:
        return json.loads(read_limited(_note(cache, subject), _NOTE_BYTES))
    except (OSError, ValueError, RuntimeError):
        return None


def write_note(cache: Path, subject: Path, content: object) -> None:
    """Keeps a little about a file or folder, as JSON, under a digest of where it is.

    Raises:
        StorageError: Where the cache cannot be written.
    """
    write_file(_note(cache, subject), json.dumps(content))


def _note(cache: Path, subject: Path) -> Path:
    return cache / f"{hashlib.sha256(os.fsencode(subject.resolve())).hexdigest()[:32]}.json"


def mark_used(path: Path) -> None:
    """Remembers that an entry was used now; file systems do not by themselves."""
    with suppress(OSError):
        os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))


def trim(keep: Path) -> None:
    """Removes what was not used for longest until the caches hold no more than :func:`size_limit`, but not ``keep``.

    What is in use stays readable for those who use it: the files lose their names alone.
    """
    for root in (cache_root(), temporary_root()):
        if root is None or not root.is_dir():
            continue
        held = sorted(entries(root), key=lambda entry: entry.used)
        excess = sum(entry.size for entry in held) - size_limit()
        for entry in held:
            if excess <= 0:
                break
            if entry.path != keep:
                remove(entry.path)
                excess -= entry.size


def remove(path: Path) -> None:
    """Removes a file or folder, as far as it can be removed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()
