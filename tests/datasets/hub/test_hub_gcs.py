"""Downloads and uploads against a stand-in Google Cloud Storage bucket on loopback."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import minari
import pytest
from pendulum_data import recorded, stored
from stand_in_bucket import Bucket, stand_in_bucket

from mpcoffline.core.errors import FileFormatError, UnknownIdError
from mpcoffline.datasets.hub import remotes
from mpcoffline.datasets.hub.remotes import RemoteError
from mpcoffline.datasets.hub.transfer import download_dataset, upload_dataset
from mpcoffline.datasets.store.manifest import write_manifest

pytest.importorskip("google.cloud.storage", reason='buckets need pip install "mpcoffline[gcs]"')

ID = "test/short/set-v1"
DATA = f"{ID}/data/main_data.hdf5"


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bucket]:
    """An empty stand-in that Google's client takes for the service, and ``gcp://lab`` for Minari's remote."""
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("MINARI_REMOTE", "gcp://lab")
    monkeypatch.setattr(remotes, "BLOCK", 10_000)
    with stand_in_bucket() as running:
        monkeypatch.setenv("STORAGE_EMULATOR_HOST", running.url)
        yield running


def files_of(root: Path) -> dict[str, bytes]:
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def content(bucket: Bucket, store: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, bytes]:
    """The files of a data set that the bucket holds, and another whose id begins alike; the store is empty."""
    stored(ID, episodes=recorded(length=100, episodes=3))
    write_manifest(store / ID)
    files = files_of(store / ID)
    for name, data in files.items():
        bucket.put(f"{ID}/{name}", data)
        bucket.put(f"{ID}0/{name}", b"of version 10")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "elsewhere"))
    return files


def test_there_and_back(bucket: Bucket, store: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    stored(ID)
    receipt = upload_dataset(ID)
    assert receipt.source.remote == "gcp://lab"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "elsewhere"))
    assert download_dataset(ID, revision=receipt.source.revision).total_steps == 10
    assert files_of(tmp_path / "elsewhere" / ID) == files_of(store / ID)


def test_a_refusal_midway_is_no_data_set_and_goes_on(bucket: Bucket, content: dict[str, bytes], tmp_path: Path) -> None:
    bucket.failures = 4  # the manifest and three blocks of the data
    with pytest.raises(RemoteError, match=r"remote gcp://lab: expected an answer.*goes on where it stopped"):
        download_dataset(ID)
    assert minari.list_local_datasets() == {}
    bucket.failures = None
    bucket.ranges.clear()
    assert download_dataset(ID).total_steps == 300
    assert bucket.ranges[0] == f"{DATA} bytes=30000-39999"
    assert files_of(tmp_path / "elsewhere" / ID) == content


def test_a_flipped_byte_is_noticed(bucket: Bucket, content: dict[str, bytes]) -> None:
    bucket.flips[DATA] = 12_345
    with pytest.raises(FileFormatError, match=r"main_data\.hdf5: expected sha256"):
        download_dataset(ID)
    assert minari.list_local_datasets() == {}
    bucket.flips.clear()
    assert download_dataset(ID).total_steps == 300


def test_a_revision_that_is_gone_is_named(bucket: Bucket, content: dict[str, bytes]) -> None:
    revision = remotes.open_remote("gcp://lab").listing(ID, None).revision
    bucket.put(DATA, content["data/main_data.hdf5"])
    with pytest.raises(UnknownIdError, match=f"at revision {revision}, which is not there"):
        download_dataset(ID, revision=revision)
    with pytest.raises(UnknownIdError, match="not there"):
        download_dataset("test/short/set-v7")
