"""The project's files: a zip of one JSON document and one npz of arrays. Loading one never executes code."""

from __future__ import annotations

import io
import json
import lzma
import math
import os
import struct
import tokenize
import uuid
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mpcoffline.errors import FileFormatError, MPCOfflineError, StorageError

_VERSION = 1
_DOCUMENT, _ARRAYS = "mpcoffline.json", "arrays.npz"
_BOX_TYPES = (
    *("float16", "float32", "float64", "bool"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)
_EPOCH = (1980, 1, 1, 0, 0, 0)  # equal contents give equal bytes

# What zipfile, zlib, json and numpy raise on damaged bytes; OSError and ValueError include their own classes.
_DAMAGE = (
    OSError,
    EOFError,
    LookupError,
    ValueError,
    TypeError,
    ArithmeticError,
    RuntimeError,
    MemoryError,
    SyntaxError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    tokenize.TokenError,
)
# What constructors raise on a document that is not what it says.
_MISFITS = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError, MemoryError)


def write_archive(
    path: str | PathLike[str], kind: str, document: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None
) -> None:
    """Writes an archive; an existing file is replaced only once the new one is complete.

    Args:
        path: Where to.
        kind: What it holds, checked by :func:`read_archive`.
        document: JSON-able content.
        arrays: Numpy arrays by name.

    Raises:
        StorageError: If the disk or the file system refuses, as for a folder that does not exist.
    """
    target = Path(path).resolve()
    buffer = io.BytesIO()
    np.savez(buffer, **dict(arrays or {}))  # type: ignore[arg-type]
    text = json.dumps({"format": "mpcoffline", "version": _VERSION, "kind": kind} | dict(document), indent=1)
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex[:12]}")
    try:
        with temporary.open("xb") as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(zipfile.ZipInfo(_DOCUMENT, _EPOCH), text, zipfile.ZIP_DEFLATED)
            archive.writestr(zipfile.ZipInfo(_ARRAYS, _EPOCH), buffer.getvalue(), zipfile.ZIP_DEFLATED)
        os.replace(temporary, target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):  # which names the temporary file
            raise StorageError.of(path, OSError(error.strerror or str(error))) from error
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
                arrays = {name: np.asarray(stored[name]) for name in stored.files}
    except FileNotFoundError:
        raise
    except _DAMAGE as error:
        raise FileFormatError(str(path), expected=f"an mpcoffline {kind} file", actual=f"{error!r}") from error
    found = (document.get("format"), document.get("kind")) if isinstance(document, dict) else (None, None)
    if found != ("mpcoffline", kind):
        raise FileFormatError(str(path), expected=f"an mpcoffline {kind} file", actual=f"format and kind {found}")
    if document.get("version") != _VERSION:
        raise FileFormatError(
            str(path),
            expected=f"file version {_VERSION}",
            actual=str(document.get("version")),
            hint="Use the version of mpcoffline that wrote it.",
        )
    return document, arrays


def holds(path: str | PathLike[str], kind: str) -> bool:
    """Whether :func:`read_archive` would read a file as of this kind.

    Raises:
        FileNotFoundError: If there is no such file.
    """
    try:
        read_archive(path, kind)
    except FileFormatError:
        return False
    return True


@contextmanager
def file_errors(path: str | PathLike[str]) -> Iterator[None]:
    """Turns what goes wrong while rebuilding objects from a document into one error that names the file.

    Raises:
        FileFormatError: For a missing key, a wrong type, or a value that the object refuses.
    """
    try:
        yield
    except (*_MISFITS, MPCOfflineError) as error:
        raise FileFormatError(str(path), expected="a complete mpcoffline file", actual=f"{error!r}") from error


def plain(value: Any) -> Any:
    """What JSON can say of numbers, arrays, texts, paths, and lists and dictionaries of these; NaN and inf are null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def box_to_json(space: spaces.Box) -> dict[str, Any]:
    """A one-dimensional Box space as JSON, of any type of number; bounds that are none become null."""
    sides = ((space.low, space.bounded_below), (space.high, space.bounded_above))
    low, high = (
        [v if known else None for v, known in zip(bound.tolist(), bounded.tolist(), strict=True)]
        for bound, bounded in sides
    )
    return {"low": low, "high": high, "dtype": space.dtype.name}


def box_from_json(data: Mapping[str, Any]) -> spaces.Box:
    """The inverse of :func:`box_to_json`.

    Raises:
        FileFormatError: For another type than Box has, bounds that it cannot hold, or bounds that cross.
    """
    dtype = np.dtype(data["dtype"])
    if dtype.name not in _BOX_TYPES:
        raise FileFormatError("space", expected=f"a Box of {', '.join(_BOX_TYPES)}", actual=str(dict(data)))
    kinds: set[type] = {float, int}
    least, most = -math.inf, math.inf
    if dtype.kind in "iu":
        kinds, least, most = {int}, int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)
    elif dtype.kind == "b":
        kinds, least, most = {bool}, False, True
    bounds = [[none if v is None else v for v in data[name]] for name, none in (("low", least), ("high", most))]
    fits = all(type(v) in kinds for side in bounds for v in side) and len(bounds[0]) == len(bounds[1])
    if not fits or not all(least <= a <= b <= most for a, b in zip(*bounds, strict=True)):
        raise FileFormatError("space", expected=f"a Box of {dtype} with low <= high", actual=str(dict(data)))
    with np.errstate(over="ignore"):  # what a small type cannot hold is no bound
        low, high = (np.array(side, dtype=dtype) for side in bounds)
        space: spaces.Box = spaces.Box(low, high, dtype=dtype.type)
    space.bounded_below &= np.array([v is not None for v in data["low"]])
    space.bounded_above &= np.array([v is not None for v in data["high"]])
    return space
