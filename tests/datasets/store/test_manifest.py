"""The sha256 manifest: written, checked, damaged, fuzzed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from mpcoffline.core.errors import FileFormatError
from mpcoffline.datasets.store.manifest import MANIFEST, differences, parse_manifest, read_manifest, write_manifest

DIGEST = "0" * 64


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "set" / "data").mkdir(parents=True)
    (tmp_path / "set" / "data" / "main_data.hdf5").write_bytes(bytes(range(256)) * 100)
    (tmp_path / "set" / "data" / "metadata.json").write_text("{}")
    write_manifest(tmp_path / "set")
    return tmp_path / "set"


def test_a_manifest_is_what_sha256sum_reads(folder: Path) -> None:
    assert list(read_manifest(folder)) == ["data/main_data.hdf5", "data/metadata.json"]
    assert differences(folder) == []
    if shutil.which("sha256sum"):
        subprocess.run(["sha256sum", "-c", "--strict", MANIFEST], cwd=folder, check=True, capture_output=True)
    before = (folder / MANIFEST).read_bytes()
    assert write_manifest(folder).read_bytes() == before
    assert sorted(path.name for path in folder.iterdir()) == [MANIFEST, "data"]


def test_a_link_in_its_place_leads_nothing_elsewhere(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("kept")
    (folder / MANIFEST).unlink()
    (folder / MANIFEST).symlink_to(tmp_path / "precious")
    write_manifest(folder)
    assert (tmp_path / "precious").read_text() == "kept"
    assert not (folder / MANIFEST).is_symlink()
    assert differences(folder) == []


def test_only_what_is_named_is_listed(folder: Path) -> None:
    write_manifest(folder, ["data/metadata.json"])
    assert list(read_manifest(folder)) == ["data/metadata.json"]


def test_each_difference_is_named(folder: Path) -> None:
    content = bytearray((folder / "data" / "main_data.hdf5").read_bytes())
    content[77] ^= 1
    (folder / "data" / "main_data.hdf5").write_bytes(content)
    (folder / "data" / "metadata.json").unlink()
    (folder / "data" / "stray.txt").write_text("")
    assert [(d.path, d.actual.split()[0]) for d in differences(folder)] == [
        ("data/main_data.hdf5", "sha256"),
        ("data/metadata.json", "no"),
        ("data/stray.txt", "one"),
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "at least one file"),
        (b"\n", "line 1"),
        (f"{DIGEST}  data/a".encode(), "cut off"),
        (f"{DIGEST[1:]}  data/a\n".encode(), "64 hexadecimal"),
        (f"{DIGEST}  ../a\n".encode(), "inside the folder"),
        (f"{DIGEST}  /etc/passwd\n".encode(), "inside the folder"),
        (f"{DIGEST}  data//a\n".encode(), "inside the folder"),
        (f"{DIGEST}  a\n{DIGEST}  a\n".encode(), "line 2.*listed once"),
        (f"{DIGEST}  {MANIFEST}\n".encode(), "inside the folder"),
        (b"\xff\n", "UTF-8"),
        (b"x" * (1 << 20) + b"\n", "at most 1048576 bytes"),
    ],
)
def test_a_damaged_manifest_is_refused(folder: Path, content: bytes, message: str) -> None:
    (folder / MANIFEST).write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        differences(folder)


@given(st.binary(max_size=200) | st.text(alphabet="0a /.*\n\\", max_size=200).map(str.encode))
def test_any_bytes_are_a_manifest_or_a_clear_error(content: bytes) -> None:
    try:
        sums = parse_manifest(content)
    except FileFormatError:
        return
    assert all(len(digest) == 64 and not path.startswith("/") for path, digest in sums.items())


@given(st.integers(min_value=0), st.binary(min_size=1, max_size=1))
def test_a_changed_manifest_never_passes_for_the_original(position: int, byte: bytes) -> None:
    original = f"{'1' * 64}  data/main_data.hdf5\n{'2' * 64}  data/metadata.json\n".encode()
    place = position % len(original)
    changed = original[:place] + byte + original[place + 1 :]
    try:
        sums = parse_manifest(changed)
    except FileFormatError:
        return
    assert changed == original or sums != parse_manifest(original)
