"""The project's files: whatever is in them, reading gives the content or a FileFormatError; nothing is executed."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pickle
import stat
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings, strategies as st
from lq_plant import make_mpc, random_log

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.archive import box_from_json, box_to_json, file_errors, plain, read_archive, write_archive
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, StorageError
from mpcoffline.learner.learner import OfflineMPCLearner

DOCUMENT = {"text": "phi", "numbers": [0.1, 1e-300, -7], "nothing": None}
ARRAYS = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.array(3.0)}


def content(path: Path) -> tuple[str, bytes]:
    """The document's text and the npz inside."""
    with zipfile.ZipFile(path) as archive:
        return archive.read("mpcoffline.json").decode(), archive.read("arrays.npz")


def rebuilt(path: Path, text: str | bytes, arrays: bytes) -> Path:
    """A zip with the given parts and matching checksums."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mpcoffline.json", text)
        archive.writestr("arrays.npz", arrays)
    return path


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x.zip"
    write_archive(path, "thing", DOCUMENT, ARRAYS)
    document, arrays = read_archive(path, "thing")
    assert {key: document[key] for key in DOCUMENT} == DOCUMENT
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)
        assert arrays[name].dtype == array.dtype


@pytest.mark.parametrize("order", [">", "<"])
def test_arrays_of_another_machine_are_read_in_this_ones_order_of_bytes(tmp_path: Path, order: str) -> None:
    """Of a file from a machine that keeps numbers the other way round; torch takes no such arrays."""
    path = tmp_path / "x.zip"
    write_archive(path, "thing", DOCUMENT, {name: a.astype(a.dtype.newbyteorder(order)) for name, a in ARRAYS.items()})
    for name, array in read_archive(path, "thing")[1].items():
        assert array.dtype == ARRAYS[name].dtype
        assert array.dtype.isnative
        np.testing.assert_array_equal(torch.from_numpy(np.atleast_1d(array)), np.atleast_1d(ARRAYS[name]))


def test_equal_contents_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("x.zip", "y.zip"):
        write_archive(tmp_path / name, "thing", DOCUMENT, ARRAYS)
    assert (tmp_path / "x.zip").read_bytes() == (tmp_path / "y.zip").read_bytes()


def test_files_get_the_users_ordinary_permissions(tmp_path: Path) -> None:
    (tmp_path / "ordinary").touch()
    write_archive(tmp_path / "x.zip", "thing", DOCUMENT)
    modes = [stat.S_IMODE(os.stat(tmp_path / name).st_mode) for name in ("ordinary", "x.zip")]
    assert modes[0] == modes[1]


def test_a_link_goes_on_pointing_to_the_file(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "link.zip").symlink_to(tmp_path / "folder" / "x.zip")
    write_archive(tmp_path / "link.zip", "thing", DOCUMENT)
    assert (tmp_path / "link.zip").is_symlink()
    assert read_archive(tmp_path / "folder" / "x.zip", "thing")[0]["text"] == "phi"


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_write_that_fails_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException
) -> None:
    path = tmp_path / "x.zip"
    write_archive(path, "thing", DOCUMENT)
    before = path.read_bytes()
    honest: Callable[..., None] = zipfile.ZipFile.writestr
    written: list[object] = []

    def failing(self: zipfile.ZipFile, *arguments: Any) -> None:
        if written:
            raise failure
        written.append(arguments)
        honest(self, *arguments)

    monkeypatch.setattr(zipfile.ZipFile, "writestr", failing)
    with pytest.raises(type(failure)):
        write_archive(path, "thing", {"text": "new"})
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["x.zip"]


def test_what_is_plain_is_what_json_can_say() -> None:
    given = {
        1: np.array([1.5, np.nan]),
        "a": (np.int64(2), np.float32(0.5), np.bool_(True)),
        "p": Path("x"),
        "n": -np.inf,
    }
    assert plain(given) == {"1": [1.5, None], "a": [2, 0.5, True], "p": "x", "n": None}
    assert json.loads(json.dumps(plain(given), allow_nan=False)) == plain(given)


def test_a_folder_that_is_missing_is_named_not_a_temporary_file(tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / "x.zip"
    with pytest.raises(StorageError, match=r"nowhere/x\.zip: expected to be written, got No such file") as caught:
        write_archive(path, "thing", DOCUMENT)
    assert "/." not in str(caught.value)


def test_what_json_cannot_say_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        write_archive(tmp_path / "x.zip", "thing", {"path": tmp_path})
    assert os.listdir(tmp_path) == []


# ---------------------------------------------------------------- what must be refused


def test_a_missing_file_stays_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_archive(tmp_path / "none.zip", "thing")


class Payload:
    """Executes code when unpickled."""

    executed = False

    def __reduce__(self) -> tuple[Callable[[str], Any], tuple[str]]:
        return _execute, ("",)


def _execute(_: str) -> None:
    Payload.executed = True


def foreign_files(tmp_path: Path) -> dict[str, Path]:
    """Files that are no archive, by what is wrong with them."""
    write_archive(tmp_path / "good.zip", "thing", DOCUMENT, ARRAYS)
    text, arrays = content(tmp_path / "good.zip")
    data = (tmp_path / "good.zip").read_bytes()
    objects = io.BytesIO()
    np.savez(objects, a=np.array([Payload()], dtype=object))
    document = json.loads(text)

    def changed(**changes: Any) -> str:
        return json.dumps(document | changes)

    def stored(name: str, given: bytes) -> Path:
        (tmp_path / name).write_bytes(given)
        return tmp_path / name

    def zipped(name: str, text: str | bytes, arrays: bytes = arrays) -> Path:
        return rebuilt(tmp_path / name, text, arrays)

    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("data", pickle.dumps(Payload()))
    (tmp_path / "folder").mkdir()
    return {
        "empty": stored("empty", b""),
        "text": stored("text", b"not a zip at all"),
        "pickle": stored("pickle", pickle.dumps(Payload())),
        "truncated": stored("truncated", data[:-30]),
        "half": stored("half", data[: len(data) // 2]),
        "folder": tmp_path / "folder",
        "other zip": tmp_path / "other.zip",
        "pickled arrays": zipped("objects", text, objects.getvalue()),
        "bare pickle for arrays": zipped("bare", text, pickle.dumps(Payload())),
        "no json": zipped("nojson", b"\xff\xfe{"),
        "deep json": zipped("deep", "[" * 100_000),
        "a list": zipped("list", "[1, 2]"),
        "a number": zipped("number", "3"),
        "format": zipped("format", changed(format="other")),
        "kind": zipped("kind", changed(kind="policy")),
        "version": zipped("version", changed(version=99)),
        "older version": zipped("older", changed(version=1)),
        "no version": zipped("noversion", json.dumps({"format": "mpcoffline", "kind": "thing"})),
    }


def test_foreign_and_damaged_files_are_refused_and_left_alone(tmp_path: Path) -> None:
    for problem, path in foreign_files(tmp_path).items():
        before = path.read_bytes() if path.is_file() else b""
        with pytest.raises(FileFormatError) as caught:
            read_archive(path, "thing")
        assert str(path) in str(caught.value), problem
        assert (path.read_bytes() if path.is_file() else b"") == before
    assert not Payload.executed


def test_messages_say_what_was_found(tmp_path: Path) -> None:
    files = foreign_files(tmp_path)
    with pytest.raises(FileFormatError, match=r"expected an mpcoffline thing file, got .*'policy'"):
        read_archive(files["kind"], "thing")
    for name, version in (("version", 99), ("older version", 1)):
        message = f"file version 2, got {version}. Use the version of mpcoffline that wrote it"
        with pytest.raises(FileFormatError, match=message):
            read_archive(files[name], "thing")


# ---------------------------------------------------------------- fuzzing


@cache
def originals() -> dict[str, bytes]:
    """A small learner and a policy as files."""
    import tempfile

    learner = OfflineMPCLearner(make_mpc(), seed=0, hidden=(4,), value_n_steps=2, fit_n_steps=2, refit_iterations=2)
    learner.fit(random_log(20), show_progress=False)
    with tempfile.TemporaryDirectory() as folder:
        learner.save(Path(folder) / "learner")
        learner.policy.save(Path(folder) / "policy")
        return {name: (Path(folder) / name).read_bytes() for name in ("learner", "policy")}


LOADERS: dict[str, Callable[[Path], Any]] = {"learner": OfflineMPCLearner.load, "policy": MPCPolicy.load}


def load_bytes(folder: Path, kind: str, data: bytes) -> None:
    """Loads the bytes; only the one error may come out, and the file stays as it is."""
    path = folder / "fuzzed.zip"
    path.write_bytes(data)
    with contextlib.suppress(FileFormatError):
        LOADERS[kind](path)
    assert path.read_bytes() == data


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@settings(max_examples=250)
@given(data=st.data(), kind=st.sampled_from(["learner", "policy"]))
def test_flipped_bytes(folder: Path, data: st.DataObject, kind: str) -> None:
    damaged = bytearray(originals()[kind])
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    load_bytes(folder, kind, bytes(damaged))


@settings(max_examples=100)
@given(data=st.data(), kind=st.sampled_from(["learner", "policy"]))
def test_flipped_bytes_in_the_directory_of_the_zip(folder: Path, data: st.DataObject, kind: str) -> None:
    damaged = bytearray(originals()[kind])
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[-1 - data.draw(st.integers(0, 140))] ^= data.draw(st.integers(1, 255))
    load_bytes(folder, kind, bytes(damaged))


@settings(max_examples=60)
@given(data=st.data(), kind=st.sampled_from(["learner", "policy"]))
def test_truncations_and_insertions(folder: Path, data: st.DataObject, kind: str) -> None:
    original = originals()[kind]
    cut = data.draw(st.integers(0, len(original)))
    extra = data.draw(st.binary(max_size=64))
    load_bytes(folder, kind, original[:cut] + extra + (original[cut:] if data.draw(st.booleans()) else b""))


def places(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths to all values of a JSON document."""
    children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [path, *(place for key, child in children for place in places(child, (*path, key)))]


ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**30), 10**30),
    st.integers(-3, 12),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.integers(-2, 9), max_size=4),
    st.dictionaries(st.text(max_size=4), st.integers(), max_size=2),
    st.just([[[]]]),
)


@pytest.mark.slow
@settings(max_examples=250)
@given(data=st.data(), kind=st.sampled_from(["learner", "policy"]))
def test_wrong_values_in_a_valid_zip(folder: Path, data: st.DataObject, kind: str) -> None:
    """The checksums match; what is said makes no sense."""
    (folder / "original").write_bytes(originals()[kind])
    text, arrays = content(folder / "original")
    document = json.loads(text)
    *parents, last = data.draw(st.sampled_from(places(document)[1:]))
    node = document
    for key in parents:
        node = node[key]
    if isinstance(node, dict) and data.draw(st.booleans()):
        del node[last]
    else:
        node[last] = data.draw(ANYTHING)
    load_bytes(folder, kind, rebuilt(folder / "changed", json.dumps(document), arrays).read_bytes())


@settings(max_examples=100)
@given(data=st.data())
def test_damaged_arrays_in_a_valid_zip(folder: Path, data: st.DataObject) -> None:
    (folder / "original").write_bytes(originals()["learner"])
    text, arrays = content(folder / "original")
    with zipfile.ZipFile(io.BytesIO(arrays)) as archive:
        members = {name: bytearray(archive.read(name)) for name in archive.namelist()}
    member = members[data.draw(st.sampled_from(sorted(members)))]
    member[data.draw(st.integers(0, len(member) - 1))] ^= data.draw(st.integers(1, 255))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content_of in members.items():
            archive.writestr(name, bytes(content_of))
    load_bytes(folder, "learner", rebuilt(folder / "changed", text, buffer.getvalue()).read_bytes())


# ---------------------------------------------------------------- parts


@pytest.mark.parametrize("error", [KeyError("m"), ValueError("x"), RuntimeError("x"), OverflowError(), IndexError()])
def test_what_goes_wrong_while_rebuilding_names_the_file(error: Exception) -> None:
    with pytest.raises(FileFormatError, match=r"x\.zip: expected a complete mpcoffline file"), file_errors("x.zip"):
        raise error
    with pytest.raises(FileFormatError, match="horizon"), file_errors("x.zip"):
        raise InvalidArgumentError("horizon", expected="a positive integer", actual="0")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_spaces_come_back(dtype: Any) -> None:
    low, high = np.array([-1.5, -np.inf], dtype), np.array([0.1, np.inf], dtype)
    space = spaces.Box(low, high, dtype=dtype)
    assert box_from_json(json.loads(json.dumps(box_to_json(space), allow_nan=False))) == space


@pytest.mark.parametrize(
    "data",
    [
        {"low": [0.0], "high": [1.0], "dtype": "int64"},
        {"low": [2.0], "high": [1.0], "dtype": "float32"},
        {"low": [0.0, 0.0], "high": [1.0], "dtype": "float32"},
        {"low": [[0.0]], "high": [[1.0]], "dtype": "float32"},
        {"low": [float("nan")], "high": [1.0], "dtype": "float32"},
    ],
)
def test_spaces_that_are_none_are_refused(data: dict[str, Any]) -> None:
    with pytest.raises(FileFormatError, match="space"):
        box_from_json(data)
