"""The project's files: a zip of one JSON document and one npz of arrays. Loading one never executes code."""

from __future__ import annotations

import io
import lzma
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import IO, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mpcoffline.core import limits
from mpcoffline.core.documents import parsed_json, written_json
from mpcoffline.core.files import check_regular
from mpcoffline.core.limits import check_limit
from mpcoffline.core.outputs import replaced

from .errors import FileFormatError, MPCOfflineError

_VERSION = 2
_DOCUMENT, _ARRAYS = "mpcoffline.json", "arrays.npz"
_LOCAL = struct.Struct("<4s5HL")  # how a member begins: its CRC-32 comes last
_END = struct.Struct("<4s4H2LH")  # the last record of a zip: 22 bytes, and a comment, of which we write none
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
    """Writes an archive; an existing file is replaced only once the new one is complete and on the disk.

    Args:
        path: Where to. What a symbolic link points to is replaced, the link stays.
        kind: What it holds, checked by :func:`read_archive`.
        document: JSON-able content.
        arrays: Numpy arrays by name.

    Raises:
        StorageError: If the disk or the file system refuses, as for a folder that does not exist, or if what is there
            is no regular file.
        FileFormatError: If it is too large to be read again.
    """
    buffer = io.BytesIO()
    np.savez(buffer, **dict(arrays or {}))  # type: ignore[arg-type]
    text = written_json({"format": "mpcoffline", "version": _VERSION, "kind": kind} | dict(document), str(path))
    with replaced(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(_DOCUMENT, _EPOCH), text, zipfile.ZIP_DEFLATED)
        archive.writestr(zipfile.ZipInfo(_ARRAYS, _EPOCH), buffer.getvalue(), zipfile.ZIP_DEFLATED)


def read_archive(path: str | PathLike[str], kind: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Reads what :func:`write_archive` wrote.

    Args:
        path: Where from.
        kind: What it must hold.

    Returns:
        The document and the arrays.

    Raises:
        FileNotFoundError: If there is no such file.
        FileFormatError: If it is damaged, foreign, of another kind or of a newer version, or holds more than
            :mod:`mpcoffline.core.limits` allow.
    """
    name = str(path)
    try:
        check_regular(Path(path))
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            size = file.seek(0, io.SEEK_END)
            check_limit(name, "bytes", size, limits.ARCHIVE_BYTES)
            with _opened(file) as archive:
                members = _members(archive, {_DOCUMENT, _ARRAYS})
                document = parsed_json(_content(archive, members[_DOCUMENT], limits.JSON_BYTES, name), name)
                most = max(limits.ARRAY_BYTES, limits.ARRAY_RATIO * size)
                arrays = _arrays(_content(archive, members[_ARRAYS], most, name))
    except (FileNotFoundError, FileFormatError):
        raise
    except _DAMAGE as error:
        raise FileFormatError(name, expected=f"an mpcoffline {kind} file", actual=f"{error!r}"[:500]) from error
    found = (document.get("format"), document.get("kind")) if isinstance(document, dict) else (None, None)
    if found != ("mpcoffline", kind):
        raise FileFormatError(name, expected=f"an mpcoffline {kind} file", actual=f"format and kind {found}"[:500])
    version = document.get("version")
    if type(version) is not int or version != _VERSION:  # True is equal to 1
        raise FileFormatError(
            name,
            expected=f"file version {_VERSION}",
            actual=repr(version)[:100],
            hint="Use the version of mpcoffline that wrote it.",
        )
    return document, arrays


def _opened(file: IO[bytes]) -> zipfile.ZipFile:
    """A zip of few members, with nothing behind its end; zipfile alone reads a list of members of any length."""
    file.seek(0, io.SEEK_END)
    file.seek(max(0, file.tell() - _END.size - 20))
    tail = file.read()
    signature, *_, bytes_of_list, _, comment = _END.unpack(tail[-_END.size :])
    if signature != b"PK\5\6" or comment or bytes_of_list > limits.DIRECTORY_BYTES or tail.startswith(b"PK\6\7"):
        raise zipfile.BadZipFile("not the end of a zip as mpcoffline writes it")
    size = file.seek(0, io.SEEK_END)
    archive = zipfile.ZipFile(file)
    for member in archive.infolist():
        if member.compress_size > size:  # zipfile would ask for that much memory
            raise zipfile.BadZipFile("a member that is larger than the file")
        file.seek(member.header_offset)
        if _LOCAL.unpack(file.read(_LOCAL.size))[-1] != member.CRC:  # zipfile believes the list alone
            raise zipfile.BadZipFile("a member whose own CRC-32 is not the one in the list")
    return archive


def _members(archive: zipfile.ZipFile, expected: set[str] | None = None) -> dict[str, zipfile.ZipInfo]:
    """The members by name, each once."""
    members = {member.filename: member for member in archive.infolist()}
    if len(members) < len(archive.infolist()):
        raise zipfile.BadZipFile("two members of one name")
    if expected is not None and members.keys() != expected:
        raise zipfile.BadZipFile(f"members {sorted(members)[:5]} instead of {sorted(expected)}")
    return members


def _content(archive: zipfile.ZipFile, member: zipfile.ZipInfo, most: int, name: str) -> bytes:
    """What a member holds, read no further than to the limit."""
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others ask for memory themselves
        raise zipfile.BadZipFile(f"{member.filename}: compression {member.compress_type}")
    check_limit(f"{name}: {member.filename}", "bytes", member.file_size, most)
    with archive.open(member) as stream:
        return stream.read()  # which ends at file_size


def _arrays(content: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of an npz that is not compressed again, each as large as its header says."""
    found: dict[str, NDArray[Any]] = {}
    with _opened(io.BytesIO(content)) as archive:
        members = _members(archive)
        check_limit(_ARRAYS, "arrays", len(members), limits.ARRAYS)
        for name, member in members.items():
            if not name.endswith(".npy") or member.compress_type != zipfile.ZIP_STORED:
                raise zipfile.BadZipFile(f"{name}: no array as numpy.savez stores it")
            with archive.open(member) as stream:
                version = np.lib.format.read_magic(stream)
                if version != (1, 0):
                    raise ValueError(f"{name}: an array of format {version}")
                shape, by_columns, dtype = np.lib.format.read_array_header_1_0(stream)
                data = bytearray(stream.read())  # writable
            if dtype.kind not in "biuf" or min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data):
                raise ValueError(f"{name}: {len(data)} bytes for shape {shape} of {dtype}")
            array = np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C")
            # In this machine's order of bytes: torch and CasADi take no other.
            found[name.removesuffix(".npy")] = array.astype(dtype.newbyteorder("="), copy=False)
    return found


def with_ending(path: str | PathLike[str]) -> Path:
    """The file of a name that may have been given without its ``.zip``."""
    file = Path(path)
    longer = file.with_name(f"{file.name}.zip")
    return longer if not file.suffix and not file.exists() and longer.exists() else file


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
        raise FileFormatError(str(path), expected="a complete mpcoffline file", actual=f"{error!r}"[:1000]) from error


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
