"""Reading the columns of many short episodes out of Minari's HDF5 file, without opening an object for each.

Opening a group and its four arrays takes HDF5 far longer than copying a hundred transitions. Where an array lies in the
file follows from a few fixed records (HDF5 File Format Specification 3.0: object headers and B-trees of
version 1, which the library writes by default), and these are read here. Whatever is not of this plain form, such as
compression, is left to h5py, episode by episode, and so are all questions of data types.
"""

from __future__ import annotations

import functools
import math
import mmap
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError

COLUMNS = ("observations", "actions", "rewards", "terminations")
_RELEASE = 256  # episodes after which the pages that were read are given back
_UNDEFINED = 2**64 - 1
_WORD, _PAIR, _NODE = struct.Struct("<Q"), struct.Struct("<QQ"), struct.Struct("<BBH")
_MESSAGE, _HEADER = struct.Struct("<HHB"), struct.Struct("<BBHII")
_DATASPACE, _DATATYPE, _FILTERS, _LAYOUT, _EXTERNAL = 0x01, 0x03, 0x0B, 0x08, 0x07
_CONTINUED, _SYMBOL_TABLE = 0x10, 0x11


class EpisodeColumns(NamedTuple):
    """What learning reads of an episode: ``(T+1, ny)``, ``(T, nu)``, ``(T,)``, ``(T,)``; possibly views of a file."""

    observations: NDArray[Any]
    actions: NDArray[Any]
    rewards: NDArray[Any]
    terminations: NDArray[Any]


@functools.cache
def _chunk_key(rank: int) -> struct.Struct:
    """A chunk's entry in a B-tree: its size, which filters it skips, where it begins, an address."""
    return struct.Struct(f"<II{rank + 1}QQ")


class _OtherLayoutError(Exception):
    """An object is not of the plain form."""


def read_episodes(path: Path, indices: Iterable[int]) -> Iterator[tuple[int, EpisodeColumns]]:
    """Yields episodes in the order of ``indices``; the arrays must not be used after the next one is asked for.

    Raises:
        FileFormatError: For a file that is damaged, or an episode that is not in it.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file, path.open("rb") as raw:
            places: dict[bytes, int] = {}
            file.id.links.iterate(lambda name, info: places.__setitem__(name, info.u), info=True)
            # Not closed here: arrays that are views of it may still be around.
            content = mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ)
            yield from _read(_PlainFile(content, file), file, places, indices)
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(
            f"file {path}", expected="an intact HDF5 file of Minari episodes", actual=f"{type(error).__name__}: {error}"
        ) from error


def _read(
    plain: _PlainFile, file: Any, places: dict[bytes, int], indices: Iterable[int]
) -> Iterator[tuple[int, EpisodeColumns]]:
    for number, index in enumerate(indices):
        if number % _RELEASE == 0:
            plain.release()
        name = f"episode_{index}"
        place = places.get(name.encode())
        if place is None:
            raise FileFormatError(f"file {file.filename}", expected=f"a group {name}", actual="none")
        try:
            columns = plain.episode(name, place)
        except (_OtherLayoutError, struct.error, ValueError, IndexError, OverflowError):
            # h5py says what is wrong, if anything is.
            columns = EpisodeColumns(*(file[name][column][()] for column in COLUMNS))
        yield int(index), columns


class _PlainFile:
    """Finds the arrays of episodes in the bytes of a file."""

    def __init__(self, content: mmap.mmap, file: Any) -> None:
        self._content, self._file = content, file
        self._types: dict[bytes, np.dtype[Any]] = {}
        self._spans: dict[str, tuple[int, int]] = {}
        self._forms: dict[bytes, tuple[tuple[int, ...], int, np.dtype[Any]]] = {}
        # Version 0 or 1, addresses and lengths of 8 bytes, from the beginning of the file.
        self._plain = content[8] <= 1 and content[13:15] == b"\x08\x08"
        base = 24 + 4 * (content[8] == 1)
        self._plain = self._plain and _WORD.unpack_from(content, base)[0] == 0

    def release(self) -> None:
        """Gives back the memory of the pages that were read."""
        if hasattr(mmap, "MADV_DONTNEED"):
            self._content.madvise(mmap.MADV_DONTNEED)

    def episode(self, name: str, place: int) -> EpisodeColumns:
        if not self._plain:
            raise _OtherLayoutError
        table = self._messages(place).get(_SYMBOL_TABLE)
        if table is None:
            raise _OtherLayoutError
        members = self._members(*_PAIR.unpack_from(self._content, table[0]))
        try:
            return EpisodeColumns(*(self._array(name, column, members[column.encode()]) for column in COLUMNS))
        except KeyError as error:
            raise _OtherLayoutError from error

    def _messages(self, place: int) -> dict[int, tuple[int, int]]:
        """Kind to position and length of an object header's messages."""
        content = self._content
        version, _, count, _, size = _HEADER.unpack_from(content, place)
        if version != 1:
            raise _OtherLayoutError
        found: dict[int, tuple[int, int]] = {}
        blocks = [(place + 16, size)]
        while blocks and count > 0:
            offset, length = blocks.pop(0)
            end = offset + length
            while offset + 8 <= end and count > 0:
                kind, length, flags = _MESSAGE.unpack_from(content, offset)
                if flags & 2:  # shared: its content is elsewhere
                    raise _OtherLayoutError
                if kind == _CONTINUED:
                    blocks.append(_PAIR.unpack_from(content, offset + 8))
                found[kind] = (offset + 8, length)
                offset += 8 + length
                count -= 1
        return found

    def _members(self, tree: int, heap: int) -> dict[bytes, int]:
        """Name to place of a group's members."""
        content = self._content
        kind, level, entries = self._node(tree)
        if kind != 0 or level != 0 or content[heap : heap + 4] != b"HEAP":
            raise _OtherLayoutError
        (names,) = _WORD.unpack_from(content, heap + 24)
        members = {}
        for i in range(entries):
            (node,) = _WORD.unpack_from(content, tree + 24 + 16 * i + 8)
            if content[node : node + 5] != b"SNOD\x01":
                raise _OtherLayoutError
            for j in range(int.from_bytes(content[node + 6 : node + 8], "little")):
                name, place = _PAIR.unpack_from(content, node + 8 + 40 * j)
                members[content[names + name : content.find(b"\0", names + name)]] = place
        return members

    def _node(self, tree: int) -> tuple[int, int, int]:
        if self._content[tree : tree + 4] != b"TREE":
            raise _OtherLayoutError
        kind, level, entries = _NODE.unpack_from(self._content, tree + 4)
        return kind, level, entries

    def _array(self, name: str, column: str, place: int) -> NDArray[Any]:
        """An array by the header at ``place``; one that differs from an earlier one only in its address is quick."""
        content = self._content
        if column in self._spans:
            size, address = self._spans[column]
            form = self._forms.get(content[place : place + address] + content[place + address + 8 : place + size])
            if form is not None:
                return self._chunks(_WORD.unpack_from(content, place + address)[0], *form)
        messages = self._messages(place)
        if _FILTERS in messages or _EXTERNAL in messages:
            raise _OtherLayoutError
        try:
            (space, _), (kind, length), (layout, _) = (messages[k] for k in (_DATASPACE, _DATATYPE, _LAYOUT))
        except KeyError as error:
            raise _OtherLayoutError from error
        if content[space] != 1 or content[layout] != 3:
            raise _OtherLayoutError
        rank = content[space + 1]
        shape = struct.unpack_from(f"<{rank}Q", content, space + 8)
        code = content[kind : kind + length]
        if code not in self._types:
            self._types[code] = self._file[f"{name}/{column}"].dtype
        dtype = self._types[code]
        if content[layout + 1] == 1:  # contiguous
            return self._view(_WORD.unpack_from(content, layout + 2)[0], shape, dtype)
        if content[layout + 1] != 2 or content[layout + 2] != rank + 1:
            raise _OtherLayoutError
        (tree,) = _WORD.unpack_from(content, layout + 3)
        rows, *others = struct.unpack_from(f"<{rank}I", content, layout + 11)
        if tuple(others) != shape[1:] or rows == 0:
            raise _OtherLayoutError
        if _CONTINUED not in messages:  # the header is one piece
            size = 16 + _HEADER.unpack_from(content, place)[-1]
            address = layout + 3 - place
            self._spans[column] = (size, address)
            header = content[place : place + address] + content[place + address + 8 : place + size]
            self._forms[header] = (shape, rows, dtype)
        return self._chunks(tree, shape, rows, dtype)

    def _chunks(self, tree: int, shape: tuple[int, ...], rows: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """An array that lies in chunks of ``rows`` whole rows."""
        kind, level, entries = self._node(tree)
        if kind != 1 or level != 0 or entries != -(-shape[0] // rows):
            raise _OtherLayoutError
        rank, parts = len(shape), []
        key = _chunk_key(rank)
        width = dtype.itemsize * math.prod(shape[1:])
        for i in range(entries):
            size, mask, *start, place = key.unpack_from(self._content, tree + 24 + i * key.size)
            if mask or start != [i * rows] + [0] * rank or size != rows * width:
                raise _OtherLayoutError
            parts.append(self._view(place, (min(rows, shape[0] - i * rows), *shape[1:]), dtype))
        return parts[0] if entries == 1 else np.concatenate(parts)

    def _view(self, place: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        count = math.prod(shape)
        if place == _UNDEFINED or count == 0:
            raise _OtherLayoutError
        return np.frombuffer(self._content, dtype, count, place).reshape(shape)
