"""The project's files: a zip of one JSON document and one npz of arrays. Loading one never executes code."""

from __future__ import annotations

import io
import json
import os
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mpcoffline.errors import FileFormatError, MPCOfflineError

_VERSION = 1
_DOCUMENT, _ARRAYS = "mpcoffline.json", "arrays.npz"
_EPOCH = (1980, 1, 1, 0, 0, 0)  # equal contents give equal bytes


def write_archive(
    path: str | PathLike[str], kind: str, document: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None
) -> None:
    """Writes an archive; an existing file is replaced only once the new one is complete.

    Args:
        path: Where to.
        kind: What it holds, checked by :func:`read_archive`.
        document: JSON-able content.
        arrays: Numpy arrays by name.
    """
    target = Path(path)
    buffer = io.BytesIO()
    np.savez(buffer, **dict(arrays or {}))  # type: ignore[arg-type]
    text = json.dumps({"format": "mpcoffline", "version": _VERSION, "kind": kind} | dict(document), indent=1)
    handle, temporary = tempfile.mkstemp(dir=target.resolve().parent, prefix=f".{target.name}.")
    try:
        with os.fdopen(handle, "wb") as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(zipfile.ZipInfo(_DOCUMENT, _EPOCH), text, zipfile.ZIP_DEFLATED)
            archive.writestr(zipfile.ZipInfo(_ARRAYS, _EPOCH), buffer.getvalue(), zipfile.ZIP_DEFLATED)
        os.replace(temporary, target)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_archive(path: str | PathLike[str], kind: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Reads what :func:`write_archive` wrote.

    Args:
        path: Where from.
        kind: What it must hold.

    Returns:
        The document and the arrays.

    Raises:
        FileNotFoundError: If there is no such file.
        FileFormatError: If it is damaged, foreign, of another kind or of a newer version.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            document = json.loads(archive.read(_DOCUMENT))
            with np.load(io.BytesIO(archive.read(_ARRAYS)), allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
    except FileNotFoundError:
        raise
    except (OSError, zipfile.BadZipFile, KeyError, ValueError, EOFError, NotImplementedError, RuntimeError) as error:
        raise FileFormatError(str(path), expected=f"an mpcoffline {kind} file", actual=f"{error!r}") from error
    found = document.get("format"), document.get("kind") if isinstance(document, dict) else None
    if found != ("mpcoffline", kind):
        raise FileFormatError(str(path), expected=f"an mpcoffline {kind} file", actual=f"format and kind {found}")
    if document["version"] != _VERSION:
        raise FileFormatError(
            str(path),
            expected=f"file version {_VERSION}",
            actual=str(document["version"]),
            hint="Use the version of mpcoffline that wrote it.",
        )
    return document, arrays


@contextmanager
def file_errors(path: str | PathLike[str]) -> Iterator[None]:
    """Turns what goes wrong while rebuilding objects from a document into one error that names the file.

    Raises:
        FileFormatError: For a missing key, a wrong type, or a value that the object refuses.
    """
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, MPCOfflineError) as error:
        raise FileFormatError(str(path), expected="a complete mpcoffline file", actual=f"{error!r}") from error


def box_to_json(space: spaces.Box) -> dict[str, Any]:
    """A one-dimensional Box space as JSON."""
    return {"low": space.low.tolist(), "high": space.high.tolist(), "dtype": str(space.dtype)}


def box_from_json(data: Mapping[str, Any]) -> spaces.Box:
    """The inverse of :func:`box_to_json`."""
    dtype = np.dtype(data["dtype"])
    low, high = (np.array(data[name], dtype=dtype) for name in ("low", "high"))
    return spaces.Box(low, high, dtype=dtype.type)
