"""A full disk, a quota and Ctrl-C while HDF5 writes: an exception, the process alive, nothing left behind."""

from __future__ import annotations

import errno
import os
import resource
import signal
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
from crashing import ACTIONS, DATASET, SPACE, check_survivors, episode, recording
from hypothesis import given, strategies as st
from pendulum_data import recorded, stored

from mpcoffline.core.errors import StorageError
from mpcoffline.datasets import dataset_from_arrays, repair
from mpcoffline.datasets.recording.session import Recording
from mpcoffline.datasets.store import hdf5_writing
from mpcoffline.datasets.store.hdf5_writing import SteadyFile, write_steadily
from mpcoffline.datasets.store.packed import pack, packed_size
from mpcoffline.datasets.store.recording_lock import log_files


@pytest.fixture
def limit() -> Iterator[Any]:
    """Sets the size that a file of this process may have, which the system treats like a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(params=["in memory", "steadily"])
def route(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Data sets are made in memory, or (as large ones are) through a file that takes everything."""
    if request.param == "steadily":
        monkeypatch.setattr(hdf5_writing, "IN_MEMORY", 0)
    return str(request.param)


def files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*"))


@pytest.mark.usefixtures("route")
@pytest.mark.parametrize("size", [0, 100, 2_000, 20_000, 200_000])
def test_storing_arrays_leaves_nothing_behind(size: int, limit: Any, store: Path) -> None:
    rng = np.random.default_rng(0)
    episodes = [(rng.normal(size=(21, 3)), rng.normal(size=(20, 1)), rng.normal(size=20))] * 40
    store.mkdir()
    limit(size)
    with pytest.raises(StorageError, match=r"test/full-v0: expected to be written, got File too large.*Free some"):
        dataset_from_arrays("test/full-v0", episodes)
    assert not files(store)


@pytest.mark.usefixtures("route")
@pytest.mark.parametrize("mode", ["new", "extend"])
def test_sealing_keeps_the_logs_and_repair_gives_everything(mode: str, limit: Any, store: Path) -> None:
    before = 0
    if mode == "extend":
        first = recording()
        for before in range(3):
            first.append(0, episode(before), complete=True)
        first.seal()
        before = 3
    recorded = recording(mode=mode)
    for number in range(before, before + 40):
        recorded.append(0, episode(number), complete=True)
    size = log_files(DATASET)[0].stat().st_size
    limit(3 * size)
    with pytest.raises(StorageError):
        recorded.seal()
    limit(resource.RLIM_INFINITY)
    assert {path.name for path in files(store / ".recording") if path.is_file()} == {"env-0000.log", "lock"}
    assert (store / DATASET).exists() == (mode == "extend")
    assert check_survivors(before + 40) == before + 40


@pytest.mark.usefixtures("route")
def test_a_replaced_data_set_stays(limit: Any) -> None:
    first = recording()
    first.append(0, episode(0), complete=True)
    first.seal()
    second = recording(mode="replace")
    second.append(0, episode(7), complete=True)
    limit(10_000)
    with pytest.raises(StorageError):
        second.seal()
    limit(resource.RLIM_INFINITY)
    for name in log_files(DATASET):
        name.unlink()
    assert check_survivors(1) == 1


def test_a_packed_file_stays(limit: Any, tmp_path: Path) -> None:
    dataset = stored(episodes=recorded(length=1_000))
    path = tmp_path / "packed.h5"
    path.write_bytes(b"before")
    limit(10_000)
    with pytest.raises(StorageError):
        pack(dataset, path)
    assert path.read_bytes() == b"before"
    limit(resource.RLIM_INFINITY)
    pack(dataset, path)
    assert packed_size(path) == (dataset.total_episodes, dataset.total_steps)
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["packed.h5"]


def test_ctrl_c_comes_to_the_main_thread_alone(tmp_path: Path) -> None:
    with suppress(ImportError):
        import polars  # noqa: F401, has the system take up waits again that Ctrl-C ended
    path = tmp_path / "a.h5"
    path.touch()
    seen = threading.Event()

    def job(file: SteadyFile) -> None:
        with h5py.File(file, "w") as content:
            for number in range(10**5):
                content.create_dataset(str(number), data=np.zeros(100), chunks=True)
                if number == 50:
                    os.kill(os.getpid(), signal.SIGINT)
                    seen.set()
                file.check()

    with pytest.raises(KeyboardInterrupt):
        write_steadily(path, job)
    assert seen.is_set()


STEPS = st.lists(
    st.tuples(st.sampled_from(["write", "read", "truncate", "flush"]), st.integers(0, 900), st.binary(max_size=300)),
    max_size=30,
)


@given(steps=STEPS, refused_from=st.integers(0, 30), window=st.sampled_from([16, 400]))
def test_it_reads_back_what_was_written_whatever_the_disk_says(
    steps: list[tuple[str, int, bytes]], refused_from: int, window: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("steady") / "file"
    path.write_bytes(b"at first")
    wanted = bytearray(b"at first")
    calls = 0

    def pwrite(descriptor: int, data: Any, offset: int) -> int:
        nonlocal calls
        calls += 1
        if calls > refused_from:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(descriptor, data, offset)

    real = os.pwrite
    with pytest.MonkeyPatch.context() as patch, SteadyFile(path) as file:
        patch.setattr(os, "pwrite", pwrite)
        patch.setattr(hdf5_writing, "WINDOW", window)
        for kind, place, data in steps:
            file.seek(place)
            if kind == "write" and data:
                wanted.extend(bytes(max(0, place - len(wanted))))
                wanted[place : place + len(data)] = data
                assert file.write(data) == len(data)
            elif kind == "read":
                assert file.read(200) == bytes(wanted[place : place + 200])
            elif kind == "truncate" and place >= len(wanted):
                file.truncate(place)
                wanted.extend(bytes(place - len(wanted)))
            elif kind == "flush":
                file.flush()
        file.flush()
        file.seek(0)
        assert file.read() == bytes(wanted)
        if calls <= refused_from:
            file.check()
            assert path.read_bytes() == bytes(wanted)
        else:
            with pytest.raises(OSError, match="No space"):
                file.check()


@pytest.mark.usefixtures("route")
def test_repair_needs_room_too(limit: Any, store: Path) -> None:
    recorded = recording()
    for number in range(5):
        recorded.append(0, episode(number), complete=True)
    recorded.close()
    limit(5_000)
    with pytest.raises(StorageError):
        repair(DATASET)
    limit(resource.RLIM_INFINITY)
    assert check_survivors(5) == 5


@pytest.mark.parametrize("size", [0, 3_000, 20_000])
def test_a_rebuild_needs_room_too(size: int, limit: Any, store: Path) -> None:
    recorded = recording()
    for number in range(20):
        recorded.append(0, episode(number), complete=True)
    recorded.seal()
    (store / DATASET / "data" / "metadata.json").unlink()
    before = {path: path.read_bytes() for path in files(store) if path.is_file()}
    limit(size)
    with pytest.raises(StorageError, match=r"expected to be written, got File too large.*Free some"):
        repair(DATASET)
    limit(resource.RLIM_INFINITY)
    assert {path: path.read_bytes() for path in files(store) if path.is_file()} == before
    assert repair(DATASET).episodes == 20


def test_both_routes_store_the_same(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for version, limit in enumerate((hdf5_writing.IN_MEMORY, 2_000, 0)):
        monkeypatch.setattr(hdf5_writing, "IN_MEMORY", limit)
        name = f"test/routes-v{version}"
        for first in (0, 5):  # new, then more of it
            more = recording_of(name, "extend" if first else "new")
            for number in range(first, first + 5):
                more.append(0, episode(number), complete=True)
            more.seal()
    contents = [content(store / f"test/routes-v{version}" / "data" / "main_data.hdf5") for version in range(3)]
    assert contents[0] == contents[1] == contents[2]
    assert len(contents[0]) > 10 * 7


def recording_of(name: str, mode: str) -> Recording:
    spec = gym.spec("mpcoffline/PendulumSwingUp-v0")
    return Recording(name, mode=mode, env_spec=spec, observation_space=SPACE, action_space=ACTIONS)


def content(path: Path) -> dict[str, tuple[Any, ...]]:
    """All that an HDF5 file holds, by name and in its order."""
    found: dict[str, tuple[Any, ...]] = {}

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        attributes = tuple((key, str(value)) for key, value in item.attrs.items())
        found[name] = attributes
        if isinstance(item, h5py.Dataset):
            found[name] = (*attributes, item.dtype, item.shape, item.maxshape, item.chunks, item[()].tobytes())

    with h5py.File(path) as file:
        file.visititems(visit)
    return found
