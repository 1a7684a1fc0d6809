"""HDF5 files that point elsewhere, declare what is not there or never end: refused before they are read."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, strategies as st
from pendulum_data import recorded, resealed, stored

from mpcoffline.core.errors import FileFormatError
from mpcoffline.datasets import TransitionTable, load_dataset, repair, verify
from mpcoffline.datasets.store.hdf5_guard import check_episodes, check_hdf5
from mpcoffline.datasets.store.opening import DATA_FILE

ID = "test/set-v0"
Change = Callable[[Any, Path], None]


def _replaced(name: str, **arguments: Any) -> Change:
    """An array in the place of another in the second episode."""

    def change(file: Any, folder: Path) -> None:
        del file[f"episode_1/{name}"]
        made = {key: value(folder) if callable(value) else value for key, value in arguments.items()}
        file["episode_1"].create_dataset(name, **made)

    return change


def _fifo(folder: Path) -> str:
    os.mkfifo(folder / "fifo")
    return str(folder / "fifo")


def _linked(name: str, link: Callable[[Path], Any]) -> Change:
    def change(file: Any, folder: Path) -> None:
        if name in file:
            del file[name]
        file[name] = link(folder)

    return change


def _loop(file: Any, folder: Path) -> None:
    file["episode_1/infos/again"] = file["episode_1/infos"]


def _diamonds(file: Any, folder: Path) -> None:
    group = file["episode_1/infos"]
    for i in range(10):  # 2^10 ways down
        inner = file["episode_1"].create_group(f"g{i}")
        group["a"] = group["b"] = inner
        group = inner


def _deep(file: Any, folder: Path) -> None:
    file.create_group("episode_1/infos/" + "/".join("x" * 500))


def _virtual(file: Any, folder: Path) -> None:
    layout = h5py.VirtualLayout((5,), "f8")
    layout[:] = h5py.VirtualSource(_fifo(folder), "x", (5,))
    del file["episode_1/rewards"]
    file["episode_1"].create_virtual_dataset("rewards", layout)


def _zeros(file: Any, folder: Path) -> None:
    """Sixty million zeros in some hundred kilobytes."""
    made = file["episode_1"].create_dataset(
        "infos/zeros", (6 * 10**7,), "f4", chunks=(10**7,), compression="gzip", compression_opts=1
    )
    made[:] = 0.0


def _texts(file: Any, folder: Path) -> None:
    """Texts that all stand in the same place: a chunk of references to one of a megabyte."""
    texts = file["episode_1"].create_dataset("infos/texts", (300,), h5py.string_dtype(), chunks=(300,))
    texts[0] = "x" * (1 << 20)
    file.flush()
    place = texts.id.get_chunk_info(0).byte_offset
    with open(file.filename, "r+b") as raw:
        raw.seek(place)
        first = raw.read(16)
        file.close()
        raw.seek(place)
        raw.write(first * 300)


CHANGES: dict[str, tuple[Change, str]] = {
    "chunks that were never written": (_replaced("rewards", shape=(10**8,), dtype="f8", chunks=True), "stored parts"),
    "compressed ones": (_replaced("rewards", shape=(10**8,), dtype="f8", compression="gzip"), "stored parts"),
    "one piece that was never written": (_replaced("rewards", shape=(10**8,), dtype="f8"), "bytes of data in this"),
    "a chunk far larger than its array": (
        _replaced(
            "rewards",
            data=np.ones(5, "f4"),
            maxshape=(None,),
            chunks=(6 * 10**7,),
            compression="gzip",
            compression_opts=1,
        ),
        "arrays of at most",
    ),
    "zeros": (_zeros, "arrays of at most"),
    "texts": (_texts, "texts of the size of their file"),
    "a raw file": (
        _replaced("rewards", shape=(5,), dtype="f8", external=lambda folder: [(_fifo(folder), 0, 40)]),
        "expected data in this file",
    ),
    "a virtual array": (_virtual, "expected data in this file"),
    "an external array": (
        _linked("episode_1/rewards", lambda folder: h5py.ExternalLink(_fifo(folder), "x")),
        "expected data in this file, got a link",
    ),
    "an external episode": (
        _linked("episode_1", lambda folder: h5py.ExternalLink(_fifo(folder), "x")),
        "expected data in this file, got a link",
    ),
    "an external info": (
        _linked("episode_1/infos/x", lambda folder: h5py.ExternalLink(_fifo(folder), "x")),
        "expected data in this file, got a link",
    ),
    "a soft link": (_linked("episode_1/rewards", lambda folder: h5py.SoftLink("/episode_0/rewards")), "got a link"),
    "a soft link to itself": (
        _linked("episode_1/infos/x", lambda folder: h5py.SoftLink("/episode_1/infos/x")),
        "got a link",
    ),
    "a group within itself": (_loop, "each part of the file once"),
    "groups reached in many ways": (_diamonds, "each part of the file once"),
    "groups without end": (_deep, "groups within each other"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_refused_found_and_left_out(store: Path, tmp_path: Path, name: str) -> None:
    change, message = CHANGES[name]
    stored(episodes=recorded(episodes=3))
    with h5py.File(store / ID / "data" / DATA_FILE, "a") as file:
        change(file, tmp_path)
    resealed()
    for read in (load_dataset, TransitionTable.from_minari):
        with pytest.raises(FileFormatError, match=f"episode_1.*{message}"):
            read(ID)
    assert any(finding.episode == 1 and message in finding.message for finding in verify(ID).findings)
    report = repair(ID)
    assert (report.action, report.episodes, report.steps) == ("rebuilt", 2, 10)
    assert verify(ID).ok


def _walls(path: Path, level: int) -> None:
    """Gives the second episode a tree of 65,535 entries, which are the same leaf of as many, or the tree itself."""
    with h5py.File(path) as file:
        places: dict[bytes, int] = {}
        file.id.links.iterate(lambda name, info: places.__setitem__(name, info.u), info=True)
    content = bytearray(path.read_bytes())
    table = content.index(struct.pack("<HHI", 0x11, 16, 0), places[b"episode_1"]) + 8
    (tree,) = struct.unpack_from("<Q", content, table)
    (leaf,) = struct.unpack_from("<Q", content, tree + 32)
    entry = bytes(content[leaf + 8 : leaf + 48])
    content += bytes(-len(content) % 8)
    begin = len(content)
    content += b"SNOD\x01\x00" + struct.pack("<H", 65_535) + entry * 65_535
    node = len(content)
    child = begin if level == 0 else node
    content += b"TREE\x00" + bytes([level]) + struct.pack("<H", 65_535) + b"\xff" * 16
    content += struct.pack("<QQ", 0, child) * 65_535 + bytes(8)
    struct.pack_into("<Q", content, table, node)
    struct.pack_into("<Q", content, 40, len(content))  # the end of the file
    path.write_bytes(content)


@pytest.mark.parametrize("level", [0, 1])
def test_trees_without_end(store: Path, level: int) -> None:
    stored()
    _walls(store / ID / "data" / DATA_FILE, level)
    resealed()
    for read in (load_dataset, TransitionTable.from_minari):
        with pytest.raises(FileFormatError, match=r"each part of the file once|no more members"):
            read(ID)
    assert not verify(ID).ok
    assert repair(ID).episodes == 1


def test_what_is_honest_passes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for i in range(12):
            group = file.create_group(f"episode_{i}")
            group.create_dataset("observations", data=rng.normal(size=(101, 3)), compression="gzip", shuffle=True)
            group.create_dataset("actions", data=rng.normal(size=(100, 2)), chunks=(7, 2), compression="lzf")
            group.create_dataset("rewards", data=rng.normal(size=100))
            group.create_dataset("terminations", data=np.zeros(100, bool), compression="gzip")
            group.create_dataset("infos/none", data=np.zeros((0, 3)), maxshape=(None, 3))
            group.create_dataset("infos/text", data=["a", "bc"])
            group["infos/number"] = 3.0
            group["infos/empty"] = h5py.Empty("f8")
    assert check_hdf5(tmp_path / "a.h5") == {f"episode_{i}": 100 for i in range(12)}
    for version in ("v108", "latest"):
        with h5py.File(tmp_path / "a.h5") as old, h5py.File(tmp_path / "b.h5", "w", libver=version) as new:
            for name in old:
                old.copy(name, new)
        assert check_hdf5(tmp_path / "b.h5") == {f"episode_{i}": 100 for i in range(12)}
        assert set(check_episodes(tmp_path / "b.h5").values()) == {""}


@pytest.mark.parametrize("version", ["earliest", "latest"])
@given(data=st.data())
def test_mutations_are_refused_or_read(version: str, data: st.DataObject) -> None:
    """Whatever a few changed bytes say, the walk ends, and in our error or a count."""
    content = bytearray(_SMALL[version])
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(content) - 8))
        value = data.draw(st.sampled_from([b"\xff" * 8, bytes(8), b"\x00\x00\x01", b"\x40", b"\xff\x7f"]))
        content[place : place + len(value)] = value
    path = _FOLDER / f"{version}.h5"
    path.write_bytes(content)
    try:
        found = check_hdf5(path)
    except FileFormatError:
        return
    assert all(isinstance(rows, int) for rows in found.values())


def _small(folder: Path, version: str) -> bytes:
    path = folder / f"small-{version}.h5"
    with h5py.File(path, "w", libver=version) as file:
        for i in range(3):
            file.create_dataset(f"episode_{i}/rewards", data=np.arange(5.0), chunks=True, maxshape=(None,))
            file[f"episode_{i}/infos/text"] = ["a", "b"]
    return path.read_bytes()


@pytest.fixture(autouse=True, scope="module")
def _small_files(tmp_path_factory: pytest.TempPathFactory) -> None:
    global _FOLDER
    _FOLDER = tmp_path_factory.mktemp("small")
    _SMALL.update({version: _small(_FOLDER, version) for version in ("earliest", "latest")})


_FOLDER = Path()
_SMALL: dict[str, bytes] = {}


@pytest.mark.parametrize("column", ["observations", "actions", "rewards", "terminations", "truncations"])
@pytest.mark.parametrize("nothing", [h5py.Empty("f8"), 3.0])
def test_a_column_without_rows_is_refused(column: str, nothing: object, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("episode_0")
        for name in ("observations", "actions", "rewards", "terminations", "truncations"):
            group[name] = nothing if name == column else np.zeros((3, 1))
    with pytest.raises(FileFormatError, match=f"/episode_0/{column}: expected an array of rows"):
        check_hdf5(path)
