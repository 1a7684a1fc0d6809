"""Downloads and uploads over loopback HTTP against a stand-in hub: whole, cut, flipped, pinned, offline."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
from pendulum_data import recorded, stored
from stand_in_hub import Hub, stand_in_hub

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, InvalidDataError, StorageError, UnknownIdError
from mpcoffline.datasets.hub import remotes, transfer as hub_module
from mpcoffline.datasets.hub.loading import load_dataset
from mpcoffline.datasets.hub.remotes import RemoteError
from mpcoffline.datasets.hub.transfer import download_dataset, find_source, upload_dataset
from mpcoffline.datasets.store.manifest import MANIFEST, write_manifest

pytest.importorskip("huggingface_hub", reason='downloads from Hugging Face need pip install "mpcoffline[hub]"')

ID = "test/short/set-v0"
REPOSITORY = "lab/test"
DATA = "short/set-v0/data/main_data.hdf5"
SUMS = f"short/set-v0/{MANIFEST}"


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    """An empty stand-in that this process takes for the hub, and ``hf://lab`` for Minari's remote."""
    from huggingface_hub import constants

    for name in ("http_proxy", "https_proxy", "all_proxy", "HF_HUB_OFFLINE", "HF_TOKEN"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("MINARI_REMOTE", "hf://lab")
    with stand_in_hub() as running:
        monkeypatch.setattr(constants, "ENDPOINT", running.url)
        monkeypatch.setattr(
            constants, "HUGGINGFACE_CO_URL_TEMPLATE", running.url + "/{repo_id}/resolve/{revision}/{filename}"
        )
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hf"))
        monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no-token"))
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        yield running


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a data set, by their path within it."""
    root = tmp_path_factory.mktemp("content")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        stored(ID, episodes=recorded(length=100, episodes=3))
    write_manifest(root / ID)
    return files_of(root / ID)


@pytest.fixture
def filled(hub: Hub, move: Callable[[], Path], content: dict[str, bytes]) -> Hub:
    """The hub with one data set on it; the store of this test is empty."""
    hub.commit(REPOSITORY, {"namespace_metadata.json": json.dumps({"datasets": [ID]}).encode()})
    hub.commit(REPOSITORY, {f"short/set-v0/{name}": data for name, data in content.items()})
    move()
    return hub


@pytest.fixture
def move(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], Path]:
    """Turns to another, empty store, as on another machine."""

    def to_elsewhere() -> Path:
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "elsewhere"))
        return tmp_path / "elsewhere"

    return to_elsewhere


def files_of(root: Path) -> dict[str, bytes]:
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def assert_absent(root: Path) -> None:
    """Neither Minari nor we take what there is for a data set."""
    assert minari.list_local_datasets() == {}
    assert not (root / ID).exists()


@pytest.mark.parametrize("dataset_id", [ID, "plain-v3", "ab/cd/ef/deep-v12"])
def test_there_and_back_is_the_same(hub: Hub, store: Path, move: Callable[[], Path], dataset_id: str) -> None:
    original = stored(dataset_id)
    receipt = upload_dataset(dataset_id)
    assert receipt.source.remote == "hf://lab"
    elsewhere = move()
    copy = download_dataset(dataset_id)
    assert files_of(elsewhere / dataset_id) == files_of(store / dataset_id)
    assert MANIFEST in files_of(elsewhere / dataset_id)
    for a, b in zip(original.iterate_episodes(), copy.iterate_episodes(), strict=True):
        np.testing.assert_array_equal(a.observations, b.observations)
    assert not list(elsewhere.rglob("*.part"))
    assert not list((elsewhere / ".downloading").glob("*/*"))
    hub.log.clear()
    assert download_dataset(dataset_id).total_steps == 10  # it is here: nobody is asked
    assert load_dataset(dataset_id).total_steps == 10
    assert hub.log == []


def test_minari_itself_reads_what_was_uploaded(hub: Hub, store: Path, move: Callable[[], Path]) -> None:
    stored(ID)
    upload_dataset(ID)
    elsewhere = move()
    assert list(minari.list_remote_datasets()) == [ID]
    minari.download_dataset(ID)
    assert minari.load_dataset(ID).total_steps == 10
    assert files_of(elsewhere / ID) == files_of(store / ID)


def test_what_minari_uploads_is_downloaded_unchecked_only(hub: Hub, store: Path, move: Callable[[], Path]) -> None:
    stored(ID)
    (store / ID / MANIFEST).unlink(missing_ok=True)
    minari.upload_dataset(ID, token="secret")
    elsewhere = move()
    with pytest.raises(FileFormatError, match=r"manifest SHA256SUMS .* got none.*unchecked"):
        download_dataset(ID)
    assert_absent(elsewhere)
    assert download_dataset(ID, unchecked=True).total_steps == 10


@pytest.mark.parametrize("ranges", [True, False])
def test_a_connection_cut_mid_file_goes_on_where_it_broke(filled: Hub, ranges: bool) -> None:
    size = len(filled.repositories[REPOSITORY][-1][1][DATA])
    filled.cuts[DATA], filled.ranges = [size // 3, 5], ranges
    assert download_dataset(ID).total_steps == 300
    asked = filled.fetched(DATA)
    assert asked[:2] == ["", f"bytes={size // 3}-"]
    assert len(asked) == 3


def test_an_interrupted_download_is_no_data_set_and_goes_on_at_the_next_attempt(filled: Hub, tmp_path: Path) -> None:
    size = len(filled.repositories[REPOSITORY][-1][1][DATA])
    filled.cuts[DATA] = [size // 2, *[0] * remotes.ATTEMPTS]
    with pytest.raises(RemoteError, match=r"remote hf://lab: expected an answer.*goes on where it stopped"):
        download_dataset(ID)
    assert_absent(tmp_path / "elsewhere")
    (part,) = (tmp_path / "elsewhere").rglob("*.part")
    assert part.stat().st_size == size // 2
    filled.log.clear()
    assert load_dataset(ID).total_steps == 300
    assert filled.fetched(DATA) == [f"bytes={size // 2}-"]
    assert filled.fetched(SUMS) == []


def test_a_new_revision_begins_anew(filled: Hub) -> None:
    size = len(filled.repositories[REPOSITORY][-1][1][DATA])
    filled.cuts[DATA] = [size // 2, *[0] * remotes.ATTEMPTS]
    with pytest.raises(RemoteError):
        download_dataset(ID)
    filled.commit(REPOSITORY, {"README.md": b"new"})
    filled.log.clear()
    assert download_dataset(ID).total_steps == 300
    assert filled.fetched(DATA) == [""]


@pytest.mark.parametrize("file", [DATA, SUMS, "short/set-v0/data/metadata.json"])
def test_a_flipped_byte_is_noticed_and_mended_at_the_next_attempt(
    filled: Hub, content: dict[str, bytes], tmp_path: Path, file: str
) -> None:
    filled.flips[file] = len(filled.repositories[REPOSITORY][-1][1][file]) // 2
    with pytest.raises(FileFormatError, match=f"({Path(file).name}|{MANIFEST})"):
        download_dataset(ID)
    assert_absent(tmp_path / "elsewhere")
    filled.flips.clear()
    try:
        download_dataset(ID)
    except FileFormatError:  # a flipped digest condemned the file that it stood for; both are fetched again
        assert file == SUMS
        download_dataset(ID)
    assert files_of(tmp_path / "elsewhere" / ID) == content


def test_a_pinned_revision_is_what_comes(filled: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commit, files = filled.repositories[REPOSITORY][-1]
    digest = hashlib.sha256(files[SUMS]).hexdigest()
    filled.commit(REPOSITORY, {DATA: b"something else", SUMS: b"0" * 64 + b"  data/main_data.hdf5\n"})
    entry = tmp_path / "set.toml"

    def pin(revision: str, manifest: str) -> None:
        entry.write_text(
            f'[dataset]\nid = "{ID}"\n[download]\nremote = "hf://lab"\nrevision = "{revision}"\n'
            f'manifest_sha256 = "{manifest}"\n'
        )

    monkeypatch.setattr(hub_module, "_catalogue_files", lambda: [entry])
    monkeypatch.delenv("MINARI_REMOTE")
    pin("0" * 40, digest)
    with pytest.raises(UnknownIdError, match=f"at revision {'0' * 40}, which is not there"):
        load_dataset(ID)
    pin(commit, "1" * 64)
    with pytest.raises(FileFormatError, match=f"expected sha256 {'1' * 64}, as in the catalogue, got {digest}"):
        load_dataset(ID)
    assert_absent(tmp_path / "elsewhere")
    pin(commit, digest)
    assert load_dataset(ID).total_steps == 300
    assert find_source(ID, revision="main") == hub_module.Source("hf://lab", "main")
    with pytest.raises(FileFormatError, match=r"main_data\.hdf5"):
        download_dataset(ID, revision="main", overwrite=True)
    assert load_dataset(ID).total_steps == 300  # what was there is intact


def test_the_receipt_is_the_catalogue_entry(filled: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored("test/other-v0")
    receipt = upload_dataset("test/other-v0")
    (tmp_path / "entry.toml").write_text(receipt.catalogue_entry)
    monkeypatch.setattr(hub_module, "_catalogue_files", lambda: [tmp_path / "entry.toml"])
    assert find_source("test/other-v0") == receipt.source
    assert receipt.source.revision == filled.repositories[REPOSITORY][-1][0]
    assert receipt.source.revision in str(receipt)


def test_a_finished_download_needs_no_connection(filled: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(hub_module, "publish", killed)
        with pytest.raises(KeyboardInterrupt):
            download_dataset(ID)
    assert_absent(tmp_path / "elsewhere")
    filled.repositories.clear()
    filled.log.clear()
    assert load_dataset(ID).total_steps == 300
    assert filled.log == []


def test_offline_says_what_to_do(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")  # nobody listens there
    with pytest.raises(
        RemoteError, match=r"remote hf://lab: expected an answer.*Check the connection to http://127.0.0.1:9"
    ):
        download_dataset(ID)
    with pytest.raises(RemoteError, match="Check the connection"):
        load_dataset(ID)
    assert load_dataset("mpcoffline/pendulum/ddpg-v0").total_steps == 50_000  # shipped: nobody is asked


def test_without_a_remote_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MINARI_REMOTE", raising=False)
    with pytest.raises(InvalidArgumentError, match=r"remote: expected one that is configured.*MINARI_REMOTE=hf://"):
        download_dataset(ID)
    with pytest.raises(UnknownIdError, match="data set id"):
        load_dataset(ID)
    stored(ID)
    with pytest.raises(InvalidArgumentError, match="remote: expected one that is configured"):
        upload_dataset(ID)
    for wrong in ("lab", "s3://lab", "hf://", "hf://lab/set"):
        with pytest.raises(InvalidArgumentError, match="hf://ORGANISATION or gcp://BUCKET"):
            upload_dataset(ID, remote=wrong)


def test_an_unknown_id_is_named(filled: Hub) -> None:
    for dataset_id in ("test/short/set-v1", "nobody/set-v0"):
        with pytest.raises(UnknownIdError, match=f"{dataset_id}.*which is not there"):
            download_dataset(dataset_id)
    with pytest.raises(UnknownIdError, match="data set id"):
        load_dataset("test/short/set-v1", download=False)
    with pytest.raises(InvalidArgumentError, match="namespace"):
        download_dataset("../set-v0")


@pytest.mark.parametrize("damage", ["spaces", "version", "id", "text"])
def test_what_minari_cannot_read_is_refused(hub: Hub, store: Path, move: Callable[[], Path], damage: str) -> None:
    """The hashes are right, the content is not; a data set without spaces would make Minari import its environment."""
    stored(ID)
    path = store / ID / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    if damage == "spaces":
        del metadata["action_space"]
        metadata["env_spec"] = metadata["env_spec"].replace("mpcoffline.envs.pendulum_swing_up", "evil_module")
    metadata |= {"version": {"minari_version": "9.9.9"}, "id": {"dataset_id": "test/other-v0"}}.get(damage, {})
    path.write_text("{" if damage == "text" else json.dumps(metadata))
    write_manifest(store / ID)
    hub.commit(REPOSITORY, {f"short/set-v0/{name}": data for name, data in files_of(store / ID).items()})
    elsewhere = move()
    with pytest.raises(FileFormatError, match=r"complete Minari|stored action_space|of that id"):
        download_dataset(ID)
    assert_absent(elsewhere)
    assert "evil_module" not in sys.modules


@pytest.mark.parametrize("path", ["../../outside.txt", "/etc/outside.txt", "data/../../../outside.txt"])
def test_a_manifest_does_not_lead_out_of_the_folder(filled: Hub, tmp_path: Path, path: str) -> None:
    filled.commit(REPOSITORY, {SUMS: f"{'0' * 64}  {path}\n".encode(), "outside.txt": b"x"})
    with pytest.raises(FileFormatError, match="inside the folder"):
        download_dataset(ID)
    assert not list(tmp_path.rglob("outside.txt"))


def test_a_file_that_the_manifest_lists_must_be_there(filled: Hub) -> None:
    filled.commit(REPOSITORY, {SUMS: f"{'0' * 64}  data/absent.bin\n".encode()})
    with pytest.raises(FileFormatError, match=r"no data/absent\.bin"):
        download_dataset(ID)


def test_a_full_disk_leaves_nothing_that_looks_like_a_data_set(
    filled: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(remotes.os, "fsync", full)
        with pytest.raises(StorageError, match="No space left on device"):
            download_dataset(ID)
    assert_absent(tmp_path / "elsewhere")
    assert download_dataset(ID).total_steps == 300


def test_two_downloads_of_one_data_set(filled: Hub, tmp_path: Path) -> None:
    folder = tmp_path / "elsewhere" / ".downloading"
    folder.mkdir(parents=True)
    with (folder / f"{ID.replace('/', '--')}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(StorageError, match="another process that downloads it now"):
            download_dataset(ID)
    assert download_dataset(ID).total_steps == 300


def test_uploads_are_checked_and_never_replace(hub: Hub) -> None:
    episodes = recorded()
    episodes[1].actions[2] = 7.0  # type: ignore[index]
    stored("test/bad-v0", episodes=episodes)
    with pytest.raises(InvalidDataError, match=r"(?s)test/bad-v0.*episode 1, step 2: actions\[0\]"):
        upload_dataset("test/bad-v0")
    assert hub.log == []
    stored(ID)
    hub.token = "secret"
    with pytest.raises(RemoteError, match=r"to take the data set.*token"):
        upload_dataset(ID)
    upload_dataset(ID, token="secret")
    with pytest.raises(InvalidArgumentError, match=r"hf://lab does not hold.*next version"):
        upload_dataset(ID, token="secret")


def test_the_progress_bar_counts_every_byte(filled: Hub, capsys: pytest.CaptureFixture[str]) -> None:
    filled.cuts[DATA] = [1000]
    download_dataset(ID, progress=True)
    assert "main_data.hdf5" in capsys.readouterr().out


def test_the_settings_of_the_environment_are_enough(filled: Hub, tmp_path: Path) -> None:
    """A process of its own, configured as a user does: by HF_ENDPOINT and MINARI_REMOTE."""
    environment: dict[str, Any] = {
        **os.environ,
        "HF_ENDPOINT": filled.url,
        "HF_HOME": str(tmp_path / "home"),
        "HF_HUB_DISABLE_XET": "1",
    }
    code = f"import mpcoffline; print(mpcoffline.load_dataset({ID!r}).total_steps)"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["300"], done.stderr
