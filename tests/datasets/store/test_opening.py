"""The door to a stored data set: nothing is run, no special file is opened, and damage is seen, once for each state."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer
from pendulum_data import recorded, resealed, stored

from mpcoffline.core import files
from mpcoffline.core.errors import (
    FileFormatError,
    InvalidArgumentError,
    InvalidDataError,
    MPCOfflineError,
    UnknownIdError,
)
from mpcoffline.datasets import TransitionTable, list_datasets, load_dataset, repair, show, verify
from mpcoffline.datasets.store import opening, packed
from mpcoffline.datasets.store.manifest import MANIFEST

ID = "test/set-v0"
READERS: dict[str, Callable[[str], Any]] = {
    "load": load_dataset,
    "table": TransitionTable.from_minari,
    "show": show,
}


def box(**changes: Any) -> str:
    return json.dumps({"type": "Box", "dtype": "float32", "shape": [3], "low": [0] * 3, "high": [1] * 3} | changes)


def edited(store: Path, **changes: Any) -> None:
    """Changes the metadata of the stored set, with a manifest of what they are then; None removes an entry."""
    path = store / ID / "data" / "metadata.json"
    metadata = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in metadata.items() if value is not None}))
    resealed(ID)


def flipped(store: Path) -> None:
    """Changes one reward on the disk, as a bit that rots does: no date changes."""
    path = store / ID / "data" / "main_data.hdf5"
    before, reward = path.stat(), np.float64(recorded()[0].rewards[2]).tobytes()
    content = bytearray(path.read_bytes())
    content[content.index(reward) + 6] ^= 0x30
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.fixture
def trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that is there once the module ``evil_door`` was imported."""
    path = tmp_path / "trace"
    (tmp_path / "evil_door.py").write_text(f"import pathlib\npathlib.Path({str(path)!r}).touch()\nclass Env: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    return path


@pytest.mark.parametrize("missing", ["observation_space", "action_space"])
@pytest.mark.parametrize("entry_point", ["evil_door:Env", "os:mkdir"])
def test_no_reader_makes_the_environment_of_a_set_without_spaces(
    store: Path, tmp_path: Path, trace: Path, missing: str, entry_point: str
) -> None:
    stored("test/other-v0")
    spec = json.loads(stored().spec.env_spec.to_json()) | {"id": "evil/Env-v0", "entry_point": entry_point}
    spec["kwargs"] = {"path": str(trace)} if entry_point == "os:mkdir" else {}
    edited(store, **{missing: None, "env_spec": json.dumps(spec)})
    for read in READERS.values():
        with pytest.raises(FileFormatError, match=f"stored {missing}, got none.*datasets repair {ID}"):
            read(ID)
    assert missing in str(verify(ID).findings[0])
    with pytest.warns(UserWarning, match=f"Not listed: '{ID}'"):
        assert "test/other-v0" in {row.id for row in list_datasets()}
    assert repair(ID).action == "rebuilt"
    assert load_dataset(ID).total_episodes == 2
    assert not trace.exists()


def test_a_packed_file_makes_no_environment_but_ours(tmp_path: Path, trace: Path) -> None:
    import h5py

    packed.pack(stored(), tmp_path / "set.h5")
    for changes in ({"entry_point": "evil_door:Env"}, {"id": "evil_door:Evil-v0"}, {"entry_point": "os:getcwd"}):
        with h5py.File(tmp_path / "set.h5", "a") as file:
            given = json.loads(file.attrs["env_spec"])
            file.attrs["env_spec"] = json.dumps(given | changes)
        with pytest.raises(InvalidDataError, match="one of this package's tasks"):
            packed.unpack(tmp_path / "set.h5", "test/new-v0")
        with h5py.File(tmp_path / "set.h5", "a") as file:
            file.attrs["env_spec"] = json.dumps(given)
    assert not trace.exists()
    assert packed.unpack(tmp_path / "set.h5", "test/new-v0").total_steps == 10


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"total_episodes": 2 * 10**9}, "total_episodes"),
        ({"total_steps": 10**9}, "1000000000 steps, as its metadata say, got 2 of 10"),
        ({"total_episodes": 1}, "1 episodes of 10 steps"),
        ({"total_steps": "x"}, "total_steps"),
        ({"total_episodes": True}, "total_episodes"),
        ({"total_episodes": -1}, "total_episodes"),
        ({"dataset_id": "foreign"}, "dataset_id"),
        ({"dataset_id": "a" * 100_000}, "dataset_id"),
        ({"dataset_id": "a/" * 100_000}, "dataset_id"),
        ({"data_format": "pickle"}, "data_format"),
        ({"data_format": "arrow", "total_episodes": 10**9}, "episodes in that many files"),
        ({"minari_version": "9.9"}, "does not support"),
        ({"author": 5}, "TypeError"),
        ({"observation_space": box(shape=[10**10], low=0.0, high=1.0)}, "at most 1000000 numbers"),
        ({"observation_space": box(shape=[-1])}, "observation_space"),
        ({"observation_space": box(dtype="S1000000000")}, "expected numbers"),
        ({"observation_space": box(dtype="O")}, "expected numbers"),
        ({"observation_space": box(low=[0] * 2)}, "Minari data set"),
        ({"action_space": json.dumps({"type": "MultiBinary", "n": 10**11})}, "numbers"),
        ({"action_space": json.dumps({"type": "MultiBinary", "n": [10**5, 10**5]})}, "numbers"),
        ({"action_space": '{"type":"Tuple","subspaces":[' * 20 + box() + "]}" * 20}, "spaces within each other"),
        ({"action_space": '{"type":"Tuple","subspaces":[' * 20_000}, "action_space"),
        ({"action_space": '{"type":"Nothing"}'}, "deserialize_space"),
        ({"action_space": "[]"}, "action_space"),
    ],
)
def test_metadata_beyond_what_is_there_are_refused_and_found(store: Path, changes: dict[str, Any], found: str) -> None:
    stored()
    edited(store, **changes)
    for read in READERS.values():
        with pytest.raises(FileFormatError, match=found) as caught:
            read(ID)
        assert caught.value.hint
    assert not verify(ID).ok


@pytest.mark.parametrize("text", ["", "{", "[]", "5", "[" * 1_000_000, '{"a": ' * 100_000, "\ud800", "9" * 100_000])
def test_metadata_that_are_no_metadata(store: Path, text: str) -> None:
    stored()
    (store / ID / "data" / "metadata.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(FileFormatError, match=r"metadata\.json"):
        load_dataset(ID)
    assert not verify(ID).ok
    assert repair(ID).episodes == 2


def _fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _device(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _holes(path: Path) -> None:
    os.truncate(path, 1 << 40)


@pytest.mark.parametrize("name", ["data/metadata.json", "data/main_data.hdf5", MANIFEST])
@pytest.mark.parametrize("change", [_fifo, _device, _folder, _holes])
def test_special_files_are_refused_unopened(store: Path, name: str, change: Callable[[Path], None]) -> None:
    stored()
    change(store / ID / name)
    for read in (load_dataset, TransitionTable.from_minari):
        with pytest.raises(FileFormatError, match=Path(name).name):
            read(ID)
    assert not verify(ID).ok
    try:
        assert repair(ID).action == "rebuilt"
    except FileFormatError:
        assert name != "data/metadata.json"


def test_a_file_that_grows_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "x").write_bytes(b"12345")
    assert files.read_limited(tmp_path / "x", 5) == b"12345"
    short = os.stat(tmp_path / "x")
    (tmp_path / "x").write_bytes(b"123456")
    monkeypatch.setattr(files, "check_regular", lambda path: short)
    with pytest.raises(FileFormatError, match="at most 5 bytes"):
        files.read_limited(tmp_path / "x", 5)


def test_a_changed_number_is_seen_where_data_are_used(store: Path) -> None:
    dataset = stored()
    flipped(store)
    for read in (*READERS.values(), lambda _: TransitionTable.from_minari(dataset)):
        with pytest.raises(FileFormatError, match=r"main_data\.hdf5: expected sha256 .*Restore it from a copy"):
            read(ID)
    with pytest.raises(FileFormatError, match="expected sha256"):
        repair(ID)
    (store / ID / MANIFEST).unlink()
    assert load_dataset(ID).total_steps == 10  # nothing to compare with


def test_the_files_are_read_once_for_each_state(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opening, "_SETTLED", -(10**15))
    stored()
    counted = []
    plain = opening.differences
    monkeypatch.setattr(opening, "differences", lambda folder: counted.append(folder) or plain(folder))
    for _ in range(3):
        TransitionTable.from_minari(load_dataset(ID))
    assert len(counted) == 1
    flipped(store)
    for _ in range(2):
        with pytest.raises(FileFormatError):
            load_dataset(ID)
    assert len(counted) == 3


def test_a_file_that_has_just_changed_is_not_remembered(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opening, "_SETTLED", 10**15)
    stored()
    load_dataset(ID)
    assert not list(opening.cache_folder("checked").glob("*"))


def test_without_a_cache_the_files_are_read_each_time(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opening, "_SETTLED", -(10**15))
    (tmp_path / "file").touch()
    monkeypatch.setattr(opening, "cache_folder", lambda kind: tmp_path / "file" / kind)
    stored()
    for _ in range(2):
        assert load_dataset(ID).total_steps == 10


def test_what_minaris_own_tools_change_is_accepted_when_asked(store: Path) -> None:
    stored()
    for path in (store / ID).rglob("*"):
        os.utime(path, ns=(10**18, 10**18))
    extra: EpisodeBuffer = recorded(episodes=1, seed=7)[0]
    minari.load_dataset(ID).update_dataset_from_buffer([extra])
    with pytest.raises(FileFormatError, match=rf"changed after {MANIFEST}.*`mpcoffline datasets verify {ID} --accept`"):
        load_dataset(ID)
    assert not verify(ID).ok
    report = verify(ID, accept=True)
    assert report.ok
    assert f"accepted: {MANIFEST} is written anew" in str(report)
    assert (load_dataset(ID).total_steps, verify(ID).findings) == (15, ())
    (store / ID / MANIFEST).write_text("nonsense\n")
    with pytest.raises(FileFormatError, match="--accept"):
        load_dataset(ID)
    assert verify(ID, accept=True).ok
    assert load_dataset(ID).total_steps == 15


def test_nothing_is_accepted_where_the_data_themselves_are_wrong(store: Path) -> None:
    stored()
    flipped(store)
    before = (store / ID / MANIFEST).read_bytes()
    report = verify(ID, accept=True)  # the cost and the reward differ
    assert {finding.check for finding in report.findings} == {"hash", "cost"}
    assert (store / ID / MANIFEST).read_bytes() == before


@pytest.mark.parametrize("given", [None, 5, b"test/set-v0", ["test/set-v0"], Path(ID)])
@pytest.mark.parametrize("read", [load_dataset, verify, repair])
def test_ids_of_other_types_are_named(given: Any, read: Callable[[Any], Any]) -> None:
    with pytest.raises((InvalidArgumentError, UnknownIdError)) as caught:
        read(given)
    assert isinstance(caught.value, MPCOfflineError)
    assert "id" in str(caught.value)


def test_a_damaged_set_is_not_extended(store: Path) -> None:
    from mpcoffline.datasets.store.writing import write_dataset

    dataset = stored()
    flipped(store)
    before = (store / ID / MANIFEST).read_bytes()
    with pytest.raises(FileFormatError, match="expected sha256"):
        write_dataset(
            ID,
            recorded(episodes=1),
            env_spec=None,
            observation_space=dataset.observation_space,
            action_space=dataset.action_space,
            overwrite=True,
            extend=True,
        )
    assert (store / ID / MANIFEST).read_bytes() == before
