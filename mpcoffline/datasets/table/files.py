"""A table of transitions as one file, exact to the bit: zip of JSON and npz."""

from __future__ import annotations

import hashlib
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.archive import file_errors, read_archive, write_archive
from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.text import visible

from .centring import Centring
from .transitions import TransitionTable

_KIND = "table"
_NAME = 1_000  # characters


def save_table(table: TransitionTable, path: str | PathLike[str]) -> None:
    """Writes a table.

    Args:
        table: The table.
        path: Where to; what was there is replaced.

    Raises:
        StorageError: If it cannot be written.
    """
    arrays: dict[str, NDArray[Any]] = {"rows": table.rows, "episode_ids": table.episode_ids}
    arrays |= {"centre": table.centring.centre, "increments": table.centring.increments}
    write_archive(path, _KIND, {"name": table.name[:_NAME], "ny": table.ny, "nu": table.nu}, arrays)


def load_table(path: str | PathLike[str]) -> TransitionTable:
    """Reads what :func:`save_table` wrote.

    Raises:
        FileNotFoundError: If there is no such file.
        FileFormatError: If it is damaged or foreign.
    """
    document, arrays = read_archive(path, _KIND)
    with file_errors(path):
        ny, nu, name = int(document["ny"]), int(document["nu"]), visible(str(document["name"])[:_NAME])
        rows, ids = arrays["rows"], arrays["episode_ids"]
        width = 2 * ny + nu + 2
        shapes = {"rows": (len(ids), width), "episode_ids": (len(ids),), "centre": (width,), "increments": (ny,)}
        types = {"rows": np.float32, "episode_ids": np.int64, "centre": np.float64, "increments": np.bool_}
        for key, shape in shapes.items():
            if arrays[key].shape != shape or arrays[key].dtype != types[key]:
                actual = f"{arrays[key].dtype} {arrays[key].shape}"
                raise FileFormatError(key, expected=f"{np.dtype(types[key])} {shape}", actual=actual)
        if min(ny, nu, len(ids)) < 1 or not (np.isfinite(rows).all() and np.isfinite(arrays["centre"]).all()):
            raise FileFormatError("rows", expected="finite numbers", actual="none, or others")
        if len(np.unique(ids)) != 1 + int((np.diff(ids) != 0).sum()):
            raise FileFormatError("episode_ids", expected="rows of an episode together", actual="apart")
        return TransitionTable(rows, ny, nu, ids, name, centring=Centring(arrays["centre"], arrays["increments"]))


def hash_of(table: TransitionTable) -> str:
    """A table's content as a SHA-256."""
    digest = hashlib.sha256()
    for column in (table.rows, table.episode_ids, *table.centring):
        digest.update(np.ascontiguousarray(column).data)
    return digest.hexdigest()
