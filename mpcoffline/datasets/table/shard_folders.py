"""Where shards lie, and what their columns are called."""

from __future__ import annotations

import json
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError

NAMES = "columns.json"
_MOST_NAMES = 1 << 20  # bytes


def folders_of(shards: str | PathLike[str] | Sequence[str | PathLike[str]]) -> list[Path]:
    """The folders of the shards."""
    if not isinstance(shards, str | PathLike):
        folders = [Path(each) for each in shards]
    elif not Path(shards).is_dir():
        raise InvalidArgumentError("shards", expected="a folder with shards", actual=f"{shards}, which is none")
    else:
        folders = sorted(path for path in Path(shards).iterdir() if path.is_dir() and not path.name.startswith("."))
    if not folders:
        hint = "mpcoffline.datasets.write_shards writes them."
        raise InvalidArgumentError("shards", expected="at least one", actual=f"none in {shards}", hint=hint)
    return folders


def names_of(folder: Path) -> tuple[str, ...]:
    """Names and units of a shard's columns."""
    try:
        path = folder / NAMES
        if not path.exists():
            return ()
        if path.stat().st_size > _MOST_NAMES:
            raise ValueError("too long")
        return tuple(str(name) for name in json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise FileFormatError(f"shard {folder}", expected=f"names in {NAMES}", actual=str(error)) from error
