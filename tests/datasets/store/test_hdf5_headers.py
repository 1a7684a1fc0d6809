"""HDF5 files whose records say one thing to HDF5 and another to who reads only the last, or all, of them."""

from __future__ import annotations

import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from mpcoffline.datasets.store.hdf5_guard import check_episodes, check_hdf5

COLUMNS = ("observations", "actions", "rewards", "terminations", "truncations")
Message = tuple[int, int, bytes]  # kind, flags, content
SPACE, LAYOUT, CONTINUED, SYMBOL_TABLE = 0x01, 0x08, 0x10, 0x11


def made(path: Path, episodes: int = 3, **options: object) -> bytearray:
    with h5py.File(path, "w") as file:
        for i in range(episodes):
            for name in COLUMNS:
                file.create_dataset(f"episode_{i}/{name}", data=np.arange(5.0), **options)
            file[f"episode_{i}/infos/x"] = np.arange(6.0)
    return bytearray(path.read_bytes())


def place_of(path: Path, name: str) -> int:
    with h5py.File(path) as file:
        return int(h5py.h5o.get_info(file[name].id).addr)


def messages(content: bytearray, place: int) -> list[Message]:
    """Those of an object header of version 1 that is in one piece."""
    found, at = [], place + 16
    end = at + struct.unpack_from("<I", content, place + 8)[0]
    while at + 8 <= end:
        kind, length, flags = struct.unpack_from("<HHB", content, at)
        found.append((kind, flags, bytes(content[at + 8 : at + 8 + length])))
        at += 8 + length
    return found


def header(parts: list[Message]) -> bytes:
    body = b"".join(struct.pack("<HHB3x", kind, len(data), flags) + data for kind, flags, data in parts)
    return struct.pack("<BBHIIxxxx", 1, 0, len(parts), 1, len(body)) + body


def appended(content: bytearray, block: bytes) -> int:
    """Where a block lies now, at the end of the file."""
    content += bytes(-len(content) % 8)
    place = len(content)
    content += block
    struct.pack_into("<Q", content, 40, len(content))
    return place


def moved(content: bytearray, old: int, new: int) -> None:
    """The one member of a group that was at a place is at another."""
    (entry,) = [
        entry
        for at in range(0, len(content), 8)
        if content[at : at + 4] == b"SNOD"
        for entry in range(at + 8, at + 8 + 40 * int.from_bytes(content[at + 6 : at + 8], "little"), 40)
        if content[entry + 8 : entry + 16] == struct.pack("<Q", old)
    ]
    content[entry + 8 : entry + 40] = struct.pack("<Q", new) + bytes(24)


def space(*shape: int) -> Message:
    return SPACE, 0, struct.pack(f"<BBB5x{len(shape)}Q", 1, len(shape), 0, *shape)


def two_shapes(path: Path) -> None:
    """An array of 10^9 rows to HDF5, which takes the first, and of five to who takes the last."""
    content, place = made(path), place_of(path, "episode_1/rewards")
    moved(content, place, appended(content, header([space(10**9), *messages(content, place)])))
    path.write_bytes(content)


def group_that_is_an_array(path: Path) -> None:
    """A group to HDF5, with a link to elsewhere in it, and all that makes an array."""
    made(path)
    with h5py.File(path, "a") as file:
        del file["episode_1/infos/x"]
        file["episode_1/infos/x"] = h5py.ExternalLink("/etc/passwd", "x")
    content, place = bytearray(path.read_bytes()), place_of(path, "episode_1/infos")
    array = messages(content, place_of(path, "episode_1/rewards"))
    moved(content, place, appended(content, header([*messages(content, place), *(m for m in array if m[0] < 9)])))
    path.write_bytes(content)


def two_of_a_name(path: Path) -> None:
    """The second of one name is sound; HDF5 finds the first."""
    two_shapes(path)
    path.write_bytes(path.read_bytes().replace(b"episode_2\0", b"episode_1\0"))


def two_infos_of_a_name(path: Path) -> None:
    made(path)
    with h5py.File(path, "a") as file:
        file["episode_1/infos/y"] = 3.0
    content = bytearray(path.read_bytes())
    names = content.index(b"x\0\0\0\0\0\0\0y\0")
    content[names + 8] = ord("x")
    path.write_bytes(content)


def pieces_that_are_one(path: Path) -> None:
    """A header in 250 pieces, all of which are the same megabyte."""
    content, place = made(path), place_of(path, "episode_1/rewards")
    piece = CONTINUED, 0, struct.pack("<QQ", appended(content, bytes(1 << 20)), 1 << 20)
    moved(content, place, appended(content, header([*[piece] * 250, *messages(content, place)])))
    path.write_bytes(content)


def trees_that_overlap(path: Path) -> None:
    """A tree of 5,000 leaves, each of 65,535 entries, in some hundred kilobytes."""
    content, place = made(path), place_of(path, "episode_1")
    leaves = appended(content, (b"TREE\0\0\xff\xff" + b"\xff" * 16) * 5_000)
    children = b"".join(struct.pack("<QQ", 0, leaves + 24 * i) for i in range(5_000))
    root = appended(content, b"TREE\0\1" + struct.pack("<H", 5_000) + b"\xff" * 16 + children + bytes(8))
    parts = [
        (k, f, struct.pack("<Q", root) + d[8:] if k == SYMBOL_TABLE else d) for k, f, d in messages(content, place)
    ]
    moved(content, place, appended(content, header(parts)))
    path.write_bytes(content)


def chunks_of_no_rows(path: Path) -> None:
    content, place = made(path, chunks=(5,)), place_of(path, "episode_1/rewards")
    parts = [(k, f, d[:11] + bytes(4) + d[15:] if k == LAYOUT else d) for k, f, d in messages(content, place)]
    moved(content, place, appended(content, header(parts)))
    path.write_bytes(content)


def texts_never_written(path: Path) -> None:
    made(path)
    with h5py.File(path, "a") as file:
        file.create_dataset("episode_1/infos/t", (10**9,), h5py.string_dtype(), chunks=(10**6,))


CHANGES: dict[str, tuple[Callable[[Path], None], str]] = {
    "two shapes": (two_shapes, "each part of its header once"),
    "a group that is an array": (group_that_is_an_array, "data in this file, got a link"),
    "two of a name": (two_of_a_name, "each name once"),
    "two infos of a name": (two_infos_of_a_name, "each name once"),
    "pieces that are one": (pieces_that_are_one, "beside each other"),
    "trees that overlap": (trees_that_overlap, "beside each other"),
    "chunks of no rows": (chunks_of_no_rows, "ZeroDivisionError"),
    "texts never written": (texts_never_written, "stored parts of its shape"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_refused_at_once_and_alone(name: str, tmp_path: Path) -> None:
    change, message = CHANGES[name]
    change(tmp_path / "a.h5")
    start = time.process_time()
    found = check_episodes(tmp_path / "a.h5")
    assert time.process_time() - start < 2.0
    assert message in found.pop("episode_1")
    assert set(found.values()) == {""}


def test_missing_chunks_of_newer_arrays_are_missed(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        array = file.create_dataset("episode_0/infos/x", (5, 5), "f8", chunks=(4, 4), maxshape=(None, None))
        array[:4] = 1.0  # two of four chunks: as many bytes as the array has, and more
        assert array.id.get_storage_size() > array.size * 8
    assert "all of its shape (5, 5)" in check_episodes(tmp_path / "a.h5")["episode_0"]


def test_newer_headers_take_no_more_than_older_ones(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w", libver=("v108", "v108")) as file:
        for i in range(60):
            for name in COLUMNS:
                file.create_dataset(f"episode_{i}/{name}", data=np.arange(50.0), chunks=(50,), track_times=True)
    tracemalloc.start()
    try:
        assert len(check_hdf5(tmp_path / "a.h5")) == 60
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()
