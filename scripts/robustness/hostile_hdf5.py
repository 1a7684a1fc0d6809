"""Hostile HDF5 files of data sets."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from .hostile_data import FILES, changed, hdf5

__all__ = ["FILES"]  # those of hostile_data, with what is registered here


def replaced(name: str, column: str = "observations") -> Callable[..., Any]:
    """Registers a file in which a column of an episode is something else, made by a function."""

    def register(make: Callable[[Any, str, Path], None]) -> Callable[..., None]:
        @changed(f"HDF5: {name}", numbers=False)
        def change(place: Path, folder: Path) -> None:
            with h5py.File(hdf5(place), "r+") as file:
                del file[f"episode_2/{column}"]
                make(file, f"episode_2/{column}", folder)

        return make

    return register


@replaced("an external link")
def external_link(file: Any, name: str, folder: Path) -> None:
    with h5py.File(folder / "elsewhere.h5", "w") as other:
        other["x"] = np.zeros((9, 4), np.float32)
    file[name] = h5py.ExternalLink(str(folder / "elsewhere.h5"), "x")


@replaced("an external link to a pipe")
def external_pipe(file: Any, name: str, folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    file[name] = h5py.ExternalLink(str(folder / "pipe"), "x")


@replaced("an external raw file")
def external_raw(file: Any, name: str, folder: Path) -> None:
    (folder / "raw").write_bytes(bytes(9 * 4 * 4))
    file.create_dataset(name, (9, 4), "f4", external=[(str(folder / "raw"), 0, 9 * 4 * 4)])


@replaced("an external raw file that is a pipe")
def external_raw_pipe(file: Any, name: str, folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    file.create_dataset(name, (9, 4), "f4", external=[(str(folder / "pipe"), 0, 9 * 4 * 4)])


@replaced("a virtual data set")
def virtual(file: Any, name: str, folder: Path) -> None:
    with h5py.File(folder / "elsewhere.h5", "w") as other:
        other["x"] = np.zeros((9, 4), np.float32)
    layout = h5py.VirtualLayout((9, 4), "f4")
    layout[:] = h5py.VirtualSource(str(folder / "elsewhere.h5"), "x", (9, 4))
    file.create_virtual_dataset(name, layout)


@replaced("a soft link")
def soft_link(file: Any, name: str, folder: Path) -> None:
    file[name] = h5py.SoftLink("/episode_0/observations")


@replaced("a soft link to itself")
def soft_loop(file: Any, name: str, folder: Path) -> None:
    file[name] = h5py.SoftLink(f"/{name}")


@replaced("an empty chunked array of 100 million rows")
def hollow(file: Any, name: str, folder: Path) -> None:
    file.create_dataset(name, (10**8, 4), "f4", chunks=(10**5, 4))


@replaced("a compressed array of 100 million rows", "rewards")
def bomb(file: Any, name: str, folder: Path) -> None:
    data = file.create_dataset(name, (10**8,), "f4", chunks=(10**6,), compression="gzip", compression_opts=1)
    data[: 2 * 10**6] = 0.0


@replaced("object references", "rewards")
def references(file: Any, name: str, folder: Path) -> None:
    file.create_dataset(name, data=np.array([file.ref] * 8, dtype=h5py.ref_dtype))


@replaced("a compound type", "rewards")
def compound(file: Any, name: str, folder: Path) -> None:
    file[name] = np.zeros(8, dtype=[("a", "f8"), ("b", "S3")])


@replaced("texts", "rewards")
def texts(file: Any, name: str, folder: Path) -> None:
    file.create_dataset(name, data=["text"] * 8)


@replaced("complex numbers", "rewards")
def complex_numbers(file: Any, name: str, folder: Path) -> None:
    file[name] = np.full(8, 1 + 1j)


@replaced("a row of 1e9 dimensions that takes no room", "actions")
def wide(file: Any, name: str, folder: Path) -> None:
    file.create_dataset(name, (8, 10**9), "f4", chunks=(1, 10**6))


def symbol_table(data: bytearray, header: int) -> int:
    """Where the message is that names a group's B-tree, by the group's object header of version 1."""
    blocks = [(header + 16, struct.unpack_from("<I", data, header + 8)[0])]
    for at, length in blocks:
        end = at + length
        while at + 8 <= end:
            kind, size = struct.unpack_from("<HH", data, at)
            if kind == 0x11:
                return at
            if kind == 0x10:  # goes on elsewhere
                blocks.append(struct.unpack_from("<QQ", data, at + 8))
            at += 8 + size
    raise ValueError("no symbol table")


def entries(place: Path, folder: Path) -> None:
    """A group whose B-tree names 65,535 times one leaf of 65,535 entries."""
    path = hdf5(place)
    with h5py.File(path, "r") as file:
        header = h5py.h5o.get_info(file["episode_2"].id).addr
    data = bytearray(path.read_bytes())
    at = symbol_table(data, header)
    (tree,) = struct.unpack_from("<Q", data, at + 8)
    (leaf,) = struct.unpack_from("<Q", data, tree + 24 + 8)
    entry = bytes(data[leaf + 8 : leaf + 48])
    struct.pack_into("<Q", data, at + 8, len(data))
    child = struct.pack("<QQ", 0, len(data) + 24 + 16 * 65_535 + 8)
    data += b"TREE" + struct.pack("<BBH", 0, 0, 65_535) + b"\xff" * 16 + child * 65_535 + bytes(8)
    data += b"SNOD\x01\0" + struct.pack("<H", 65_535) + entry * 65_535
    data[40:48] = struct.pack("<Q", len(data))  # the superblock's end of file
    path.write_bytes(bytes(data))


changed("HDF5: a group of 65,535 x 65,535 entries", numbers=False)(entries)


@changed("HDF5: 20,000 empty groups", refuse=False)
def groups(place: Path, folder: Path) -> None:
    with h5py.File(hdf5(place), "r+") as file:
        for number in range(20_000):
            file.create_group(f"x{number}")


@changed("HDF5: one episode under two names", refuse=True)
def doubled(place: Path, folder: Path) -> None:
    with h5py.File(hdf5(place), "r+") as file:
        del file["episode_3"]
        file["episode_3"] = file["episode_2"]
