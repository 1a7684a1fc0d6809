"""Looks an HDF5 file over before anybody reads it: all of it is there, in this file, and no larger than it can be.

HDF5 follows links into other files, opens raw files of any kind, allocates what an array declares and walks trees
without end; a small file can make it do so for hours. Where things lie is read here from the records themselves (HDF5
File Format Specification 3.0: object headers of versions 1 and 2, B-trees of version 1), each of them once. Members of
groups in HDF5's newer form, which has checksums and no such trees, are asked of the library.
"""

from __future__ import annotations

import math
import mmap
import re
import struct
from pathlib import Path
from typing import Any

from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.files import check_regular
from mpcoffline.core.limits import EXPANSION, EXPANSION_ALLOWANCE, GROUP_DEPTH, LINK_BYTES

_UNDEFINED = 2**64 - 1
_WORD, _PAIR = struct.Struct("<Q"), struct.Struct("<QQ")
_SPACE, _LINKS, _TYPE, _EXTERNAL, _LAYOUT, _FILTERS = 0x01, 0x02, 0x03, 0x07, 0x08, 0x0B
_CONTINUED, _SYMBOL_TABLE = 0x10, 0x11
_GROUP = {_LINKS, _SYMBOL_TABLE}
_SINGLE = {_SPACE, _TYPE, _EXTERNAL, _LAYOUT, _FILTERS, *_GROUP}  # of two, HDF5 would take the first
_VLEN_CLASSES = (6, 9, 10)  # compound, variable length, array: may hold what is stored elsewhere
_NAME_BYTES = 1024
_NULL = (0,)  # a null array, like a single number, has no shape
_ROWS = ("observations", "actions", "rewards", "terminations", "truncations")
_ONE_LEAF = (b"TREE\0\0\1\0", b"TREE\1\0\1\0")  # a tree of one entry, of a group and of chunks
_RECORDS_ALLOWANCE = 2 << 20  # bytes that a few flipped bits may add to lengths before it counts as an attack

_EPISODE = re.compile(r"episode_(0|[1-9][0-9]{0,17})")
_FAULTS = (OSError, RuntimeError, KeyError, TypeError, ValueError, IndexError, ArithmeticError, struct.error)

_Messages = dict[int, int]


def check_hdf5(path: Path) -> dict[str, int]:
    """Refuses an HDF5 file that points elsewhere, is damaged in its structure, or declares more than it can hold.

    Args:
        path: The file.

    Returns:
        For each member of its root the number of rows of ``rewards`` in it; -1 where there is none.

    Raises:
        FileFormatError: Naming the file and the place in it.
    """
    found = {}
    for name, (rows, fault) in _looked_over(path).items():
        if fault is not None:
            raise fault
        found[name] = rows
    return found


def check_episodes(path: Path) -> dict[str, str]:
    """Like :func:`check_hdf5`, member by member.

    Returns:
        For each member of its root, why it must not be read; empty where nothing speaks against it.

    Raises:
        FileFormatError: Where the root itself cannot be read.
    """
    return {name: "" if fault is None else str(fault).rstrip(".") for name, (_, fault) in _looked_over(path).items()}


def episode_number(group: str) -> int | None:
    """The number of an episode's group; None for a group of another name."""
    match = _EPISODE.fullmatch(group)
    return None if match is None else int(match[1])


def _looked_over(path: Path) -> dict[str, tuple[int, FileFormatError | None]]:
    import h5py

    check_regular(path)
    try:
        with (
            h5py.File(path, "r") as file,
            path.open("rb") as raw,
            mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ) as content,
        ):
            return _Walk(f"file {path}", content, file).members()
    except _FAULTS as error:
        raise _fault(f"file {path}", error) from error


def _fault(name: str, error: Exception) -> FileFormatError:
    if isinstance(error, FileFormatError):
        return error
    return FileFormatError(name, expected="an intact HDF5 file", actual=f"{type(error).__name__}: {error}")


class _Walk:
    """Visits every object of a file, once."""

    def __init__(self, name: str, content: mmap.mmap, file: Any) -> None:
        self._name, self._content, self._file = name, content, file
        self._nodes: set[int] = set()  # groups, trees and their leaves: none may come again
        self._arrays: dict[int, tuple[int, ...]] = {}
        self._forms: dict[bytes, tuple[tuple[int, ...], tuple[int, ...], int, bool]] = {}
        self._cuts: dict[str, tuple[int, int]] = {}  # by name: length of the header, where the address stands
        self._bytes_left = EXPANSION_ALLOWANCE + EXPANSION * len(content)
        self._members_left = len(content) // LINK_BYTES
        self._records_left = len(content) + _RECORDS_ALLOWANCE

    def members(self) -> dict[str, tuple[int, FileFormatError | None]]:
        """For each member of the root its rows, as :meth:`_visit` counts them, and what is wrong with it."""
        place = self._root()
        found: dict[str, tuple[int, FileFormatError | None]] = {}
        for name, target in self._members("/", place, self._messages("/", place)):
            try:
                if name in found:
                    raise self._refused("/", "each name once", repr(name))
                found[name] = (self._visit(f"/{name}", target, GROUP_DEPTH), None)
            except _FAULTS as error:
                found[name] = (-1, _fault(f"{self._name}: /{name}", error))
        return found

    def _root(self) -> int:
        """Where the root group is, in a file that begins with its superblock and counts from there."""
        content = self._content
        version = content[8]
        old = version in (0, 1)
        sizes, base = (content[13:15], 24 + 4 * version) if old else (content[9:11], 12)
        if content[:8] != b"\x89HDF\r\n\x1a\n" or version > 3 or sizes != b"\x08\x08" or self._word(base) != 0:
            raise self._refused("/", "a superblock at the beginning, addresses of 8 bytes", "another form")
        return self._word(base + 40 if old else base + 24)

    def _visit(self, where: str, place: int, depth: int) -> int:
        """The rows of an array, or of a group's array ``rewards``; -1 where there are none."""
        if place == _UNDEFINED:
            raise self._refused(where, "data in this file", "a link")
        if place in self._arrays:
            return self._declare(where, place)
        column = where[where.rfind("/") :]
        if column in self._cuts and (form := self._forms.get(self._header(place, *self._cuts[column]))) is not None:
            self._arrays[place] = self._chunked(where, self._word(place + self._cuts[column][1]), *form)
            return self._declare(where, place)
        messages = self._messages(where, place)
        if _SPACE in messages and messages.keys().isdisjoint(_GROUP):  # else HDF5 takes it for a group
            array = self._arrays[place] = self._array(where, place, messages)
            rows = self._declare(where, place)
            if array != _NULL and (_TYPE not in messages or self._content[messages[_TYPE]] & 15 in _VLEN_CLASSES):
                self._check_texts(where)  # only now: reading them takes as long as there are rows
            return rows
        if depth == 0:
            raise self._refused(where, f"at most {GROUP_DEPTH} groups within each other", "more")
        members = self._members(where, place, messages)
        if len(dict(members)) < len(members):
            raise self._refused(where, "each name once", "one of them again")
        rows = -1
        for name, target in members:
            found = self._visit(f"{where}/{name}", target, depth - 1)
            if depth == GROUP_DEPTH and name in _ROWS and found < 0 and target in self._arrays:
                raise self._refused(f"{where}/{name}", "an array of rows", "one without")
            rows = found if name == "rewards" else rows
        return rows

    def _declare(self, where: str, place: int) -> int:
        """Counts an array's bytes, each time that it is reached; returns its rows."""
        *shape, size = self._arrays[place]
        if size > self._bytes_left:
            limit = EXPANSION_ALLOWANCE + EXPANSION * len(self._content)
            raise self._refused(where, f"arrays of at most {limit} bytes in a file of {len(self._content)}", "more")
        self._bytes_left -= size
        return shape[0] if shape else -1

    # Groups

    def _members(self, where: str, place: int, messages: _Messages) -> list[tuple[str, int]]:
        """Names and places of a group's members; the place of a link to elsewhere is undefined."""
        self._once(where, place)
        if _SYMBOL_TABLE in messages and _LINKS not in messages:
            tree, heap = _PAIR.unpack_from(self._content, messages[_SYMBOL_TABLE])
            names = self._word(heap + 24)
            leaves = self._leaves(where, tree, kind=0, width=16)
            return [member for leaf in leaves for member in self._symbols(where, self._word(leaf + 8), names)]
        import h5py

        found: list[tuple[str, int]] = []

        def collect(name: bytes, info: Any) -> bool | None:
            found.append((self._text(where, name), int(info.u) if info.type == h5py.h5l.TYPE_HARD else _UNDEFINED))
            return True if len(found) > self._members_left else None

        group = h5py.h5g.open(self._file.id, where.encode())  # its links do not keep it open
        group.links.iterate(collect, info=True)
        self._spend(where, len(found))
        return found

    def _symbols(self, where: str, leaf: int, names: int) -> list[tuple[str, int]]:
        content, found = self._content, []
        self._once(where, leaf)
        if content[leaf : leaf + 5] != b"SNOD\x01":
            raise self._refused(where, "a list of members", f"something else at byte {leaf}")
        count = int.from_bytes(content[leaf + 6 : leaf + 8], "little")
        self._spend(where, count)
        for entry in range(leaf + 8, leaf + 8 + 40 * count, 40):
            offset, target = _PAIR.unpack_from(content, entry)
            start = names + offset
            name = self._text(where, content[start : max(start, content.find(b"\0", start, start + _NAME_BYTES))])
            found.append((name, _UNDEFINED if content[entry + 16] == 2 else target))
        return found

    def _leaves(self, where: str, tree: int, kind: int, width: int) -> list[int]:
        """Where the entries of a tree's leaves stand, in order."""
        if self._content[tree : tree + 8] == _ONE_LEAF[kind]:
            self._once(where, tree)
            return [tree + 24]
        nodes, level, found = [tree], -1, []
        while nodes:
            below: list[int] = []
            for node in nodes:
                self._once(where, node)
                if self._content[node : node + 4] != b"TREE" or self._content[node + 4] != kind:
                    raise self._refused(where, "a tree of its parts", f"something else at byte {node}")
                here, entries = self._content[node + 5], int.from_bytes(self._content[node + 6 : node + 8], "little")
                if level not in (-1, here + 1):
                    raise self._refused(where, "a tree whose levels go down by one", f"level {here}")
                self._claim(where, node + 24, entries * width)
                places = [node + 24 + i * width for i in range(entries)]
                if here == 0:
                    found += places
                else:
                    below += [self._word(place + width - 8) for place in places]
            level, nodes = self._content[nodes[0] + 5], below
        return found

    # Arrays

    def _array(self, where: str, place: int, messages: _Messages) -> tuple[int, ...]:
        """Shape of an array, and the bytes that reading it takes."""
        content = self._content
        if _EXTERNAL in messages:
            raise self._refused(where, "data in this file", "some in another")
        if not {_SPACE, _TYPE, _LAYOUT} <= messages.keys() or content[messages[_LAYOUT]] != 3:
            return self._other_array(where)
        space, kind, layout = (messages[key] for key in (_SPACE, _TYPE, _LAYOUT))
        if content[space] == 2 and content[space + 3] == 2:  # a null array
            return _NULL
        rank, begin = content[space + 1], space + (8 if content[space] == 1 else 4)
        shape = struct.unpack_from(f"<{rank}Q", content, begin)
        (itemsize,) = struct.unpack_from("<I", content, kind + 4)
        size = math.prod(shape) * itemsize
        if content[layout + 1] == 0 or size == 0:  # compact: within the header
            return (*shape, size)
        if content[layout + 1] == 1:
            self._check_stored(where, self._word(layout + 2), size)
            return (*shape, size)
        if content[layout + 1] != 2 or content[layout + 2] != rank + 1:
            return self._other_array(where)
        chunk = struct.unpack_from(f"<{rank}I", content, layout + 11)
        form = (shape, chunk, itemsize, _FILTERS in messages)
        if content[place] == 1 and _CONTINUED not in messages and content[kind] & 15 not in _VLEN_CLASSES:
            size, cut = self._uint(place + 8, 4) + 16, layout + 3 - place
            self._cuts[where[where.rfind("/") :]] = (size, cut)
            self._forms[self._header(place, size, cut)] = form
        return self._chunked(where, self._word(layout + 3), *form)

    def _header(self, place: int, size: int, cut: int) -> bytes:
        """An array's header without the address of its data: most arrays differ from earlier ones in that alone."""
        return self._content[place : place + cut] + self._content[place + cut + 8 : place + size]

    def _chunked(
        self, where: str, tree: int, shape: tuple[int, ...], chunk: tuple[int, ...], itemsize: int, filtered: bool
    ) -> tuple[int, ...]:
        """Shape and bytes of an array that lies in chunks, all of which are there."""
        size = math.prod(chunk) * itemsize
        wanted = math.prod(-(-rows // part) for rows, part in zip(shape, chunk, strict=True))
        leaves = [] if tree == _UNDEFINED else self._leaves(where, tree, kind=1, width=8 * len(shape) + 24)
        if len(leaves) != wanted:
            raise self._refused(where, f"{wanted} stored parts of its shape {shape}", str(len(leaves)))
        for leaf in leaves:
            (stored,) = struct.unpack_from("<I", self._content, leaf)
            if not filtered and stored != size:
                raise self._refused(where, f"parts of {size} bytes", str(stored))
            self._check_stored(where, self._word(leaf + 8 * len(shape) + 16), stored)
        return (*shape, wanted * size)

    def _check_stored(self, where: str, place: int, size: int) -> None:
        if place == _UNDEFINED or place + size > len(self._content):
            raise self._refused(where, f"{size} bytes of data in this file", "fewer, or none that were ever written")

    def _check_texts(self, where: str) -> None:
        """Counts the bytes of texts, which stand elsewhere in the file, and may all be the same."""
        import h5py

        array = self._file[where]
        kind = array.id.get_type()
        if kind.get_class() not in (h5py.h5t.VLEN, h5py.h5t.STRING):
            if kind.detect_class(h5py.h5t.VLEN):
                raise self._refused(where, "numbers or texts", str(array.dtype))
            return
        if array.ndim > 1:
            raise self._refused(where, "one text a row", f"shape {array.shape}")
        first, left, n = 0, self._bytes_left, len(array) if array.ndim else 0  # one text is no larger than its file
        while first < n:
            count = min(4096, max(1, left // (4 * len(self._content))))
            left -= sum(len(text) for text in array[first : first + count])
            first += count
            if left < 0:
                raise self._refused(where, "texts of the size of their file", "more")
        self._bytes_left = left

    def _other_array(self, where: str) -> tuple[int, ...]:
        """The same for an array in another of HDF5's forms."""
        array = self._file[where]
        if array.is_virtual or array.external:
            raise self._refused(where, "data in this file", "some in another")
        if array.shape is None:
            return _NULL
        size = array.size * array.id.get_type().get_size()
        if array.chunks is not None:
            wanted = math.prod(-(-rows // part) for rows, part in zip(array.shape, array.chunks, strict=True))
            missing = wanted - array.id.get_num_chunks()
            size = max(size, wanted * math.prod(array.chunks) * array.id.get_type().get_size())
        else:
            missing = size - array.id.get_storage_size()
        if size and missing > 0:
            raise self._refused(where, f"all of its shape {array.shape} in this file", "less")
        return (*array.shape, size)

    # Records

    def _messages(self, where: str, place: int) -> _Messages:
        """Kind to position of an object header's messages; a shared one, whose content is elsewhere, is left out."""
        content = self._content
        blocks = [(place + 16, self._uint(place + 8, 4))]
        size, checksum, seen = 8, 0, set()
        if content[place : place + 4] == b"OHDR":
            flags = content[place + 5]
            start = place + 6 + 16 * (flags >> 5 & 1) + 4 * (flags >> 4 & 1)
            width = 1 << (flags & 3)
            blocks = [(start + width, self._uint(start, width))]
            size, checksum = 4 + 2 * (flags >> 2 & 1), 4
        elif content[place] != 1:
            raise self._refused(where, "an object", f"something else at byte {place}")
        found: _Messages = {}
        while blocks:
            offset, length = blocks.pop()
            self._claim(where, offset, length)
            end = offset + length
            while offset + size <= end:
                if checksum:
                    kind, length, shared = content[offset], self._uint(offset + 1, 2), content[offset + 3] & 2
                else:
                    kind, length, shared = self._uint(offset, 2), self._uint(offset + 2, 2), content[offset + 4] & 2
                offset += size
                if kind == _CONTINUED:
                    begin, room = _PAIR.unpack_from(content, offset)
                    blocks.append((begin + checksum, room - 2 * checksum))
                if kind in _SINGLE and kind in seen:
                    raise self._refused(where, "each part of its header once", f"one of kind {kind} again")
                seen.add(kind)
                if not shared:
                    found[kind] = offset
                offset += length
        return found

    def _claim(self, where: str, place: int, size: int) -> None:
        """Counts the bytes of a record: in all no more than the file has, for no two records share any."""
        if place + size > len(self._content) or size > self._records_left:
            raise self._refused(where, "records that lie in this file, beside each other", f"{size} bytes at {place}")
        self._records_left -= max(0, size)

    def _once(self, where: str, place: int) -> None:
        if place in self._nodes:
            raise self._refused(where, "each part of the file once", f"the one at byte {place} again")
        self._nodes.add(place)

    def _spend(self, where: str, members: int) -> None:
        self._members_left -= members
        if self._members_left < 0:
            raise self._refused(where, f"no more members than a file of {len(self._content)} bytes can hold", "more")

    def _text(self, where: str, name: bytes) -> str:
        try:
            text = name.decode()
        except UnicodeDecodeError as error:
            raise self._refused(where, "names in UTF-8", repr(name)) from error
        if not text or "/" in text or text == ".":
            raise self._refused(where, "members with names", repr(text))
        return text

    def _word(self, place: int) -> int:
        return int(_WORD.unpack_from(self._content, place)[0])

    def _uint(self, place: int, width: int) -> int:
        return int.from_bytes(self._content[place : place + width], "little")

    def _refused(self, where: str, expected: str, actual: str) -> FileFormatError:
        return FileFormatError(f"{self._name}: {where}", expected=expected, actual=actual)
