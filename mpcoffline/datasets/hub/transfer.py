"""Downloading and uploading data sets over Minari's remotes: checked, resumable, atomic.

The remote is Minari's setting (the environment variable ``MINARI_REMOTE``, ``hf://ORGANISATION`` or ``gcp://BUCKET``);
without it there is none. The layout is Minari's too: what is uploaded here, ``minari download`` reads.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

from mpcoffline.core.atomic import publish
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, InvalidDataError, StorageError, UnknownIdError
from mpcoffline.core.outputs import write_file
from mpcoffline.core.progress import Bars
from mpcoffline.datasets.recipes import catalog_file
from mpcoffline.datasets.store.ids import check_dataset_id, dataset_path, is_local
from mpcoffline.datasets.store.manifest import MANIFEST, differences, read_manifest, sha256_of, write_manifest
from mpcoffline.datasets.store.opening import open_dataset
from mpcoffline.datasets.store.recording_lock import check_not_recorded
from mpcoffline.datasets.store.verification import verify
from mpcoffline.datasets.store.writing import declare_namespace

from .remotes import SETTING, Listing, Remote, RemoteError, fetch, open_remote, remote_errors

if TYPE_CHECKING:
    from minari import MinariDataset

__all__ = ["Source", "UploadReceipt", "download_dataset", "find_source", "upload_dataset"]


@dataclass(frozen=True)
class Source:
    """Where a data set comes from.

    Attributes:
        remote: ``hf://ORGANISATION`` or ``gcp://BUCKET``.
        revision: The revision that is meant; None for the newest.
        manifest_sha256: The sha256 that its manifest must have; None for any.
    """

    remote: str
    revision: str | None = None
    manifest_sha256: str | None = None


@dataclass(frozen=True)
class UploadReceipt:
    """What an upload amounts to.

    Attributes:
        dataset_id: Minari id.
        source: Where it is now, pinned.
    """

    dataset_id: str
    source: Source

    def __str__(self) -> str:
        return f"{self.dataset_id} is at {self.source.remote}. To pin it:\n{self.catalogue_entry}"

    @property
    def catalogue_entry(self) -> str:
        """The lines of TOML that pin it in the catalogue."""
        lines = [f'{key} = "{value}"' for key, value in asdict(self.source).items()]
        return "\n".join(["[dataset]", f'id = "{self.dataset_id}"', "[download]", *lines, ""])


def find_source(dataset_id: str, remote: str | None = None, revision: str | None = None) -> Source | None:
    """Where a data set would be downloaded from.

    What the caller names comes first, then the catalogue's entry, then Minari's setting.

    Args:
        dataset_id: Minari id.
        remote: Overrides catalogue and setting.
        revision: Overrides the catalogue's revision, and with it its hash.

    Returns:
        The source; None where neither the caller nor the catalogue nor the setting names one.
    """
    entry = _catalogue_entry(dataset_id)
    if remote is None and entry is not None:
        return entry if revision in (None, entry.revision) else Source(entry.remote, revision)
    remote = remote or os.environ.get(SETTING)
    return Source(remote, revision) if remote else None


def download_dataset(
    dataset_id: str,
    *,
    remote: str | None = None,
    revision: str | None = None,
    token: str | None = None,
    overwrite: bool = False,
    unchecked: bool = False,
    progress: bool = False,
) -> MinariDataset:
    """Brings a data set into the local store, where it appears when all of it is there and its hashes are right.

    A download that was interrupted goes on where it stopped when it is asked for again, within a file too. Nothing
    that the files name is imported.

    Args:
        dataset_id: Minari id.
        remote: ``hf://ORGANISATION`` or ``gcp://BUCKET``; by default the catalogue's, or that of ``MINARI_REMOTE``.
        revision: A commit, tag or branch (Hugging Face); by default the catalogue's, or the newest.
        token: For private data.
        overwrite: Whether a local data set of this id is replaced; otherwise it is returned as it is.
        unchecked: Whether a data set without a manifest is accepted, as most that were uploaded with Minari alone.
        progress: Whether to show a progress bar.

    Raises:
        InvalidArgumentError: For an id against Minari's grammar, a malformed remote or none at all.
        UnknownIdError: Where the remote does not hold the data set.
        RemoteError: Where it does not answer, or breaks off; what has come is kept for the next attempt.
        FileFormatError: Where a hash is wrong, there is none, or Minari cannot read what came.
        StorageError: For a full disk, or where another process downloads the same data set.
    """
    check_dataset_id(dataset_id)
    if is_local(dataset_id) and not overwrite:
        return open_dataset(dataset_path(dataset_id))
    source = find_source(dataset_id, remote, revision)
    if source is None:
        raise _no_remote()
    check_not_recorded(dataset_id)
    with _download_folder(dataset_id) as folder:
        staged = folder / "dataset"
        if not _is_complete(folder, source):
            place = open_remote(source.remote, token)
            listing = place.listing(dataset_id, source.revision)
            _begin(folder, source.remote, listing.revision)
            _fetch_all(place, listing, staged, unchecked=unchecked, progress=progress)
        _check(staged, dataset_id, source, unchecked=unchecked)
        try:
            declare_namespace(dataset_id)
            publish(staged, dataset_path(dataset_id), overwrite=overwrite)
        except OSError as error:
            if not is_local(dataset_id) or overwrite:
                raise StorageError.of(dataset_path(dataset_id), error) from error
        shutil.rmtree(folder, ignore_errors=True)
    return open_dataset(dataset_path(dataset_id))


def upload_dataset(dataset_id: str, *, remote: str | None = None, token: str | None = None) -> UploadReceipt:
    """Puts a local data set on a remote, with its manifest, and reads the manifest back.

    Args:
        dataset_id: Minari id of a data set in the local store, or shipped.
        remote: ``hf://ORGANISATION`` or ``gcp://BUCKET``; by default that of ``MINARI_REMOTE``.
        token: A Hugging Face token, or the path of a service account's key file; None for that of ``hf auth login``.

    Returns:
        Where it is now, with the revision and the hash that pin it.

    Raises:
        InvalidDataError: Where :func:`~mpcoffline.datasets.verify` finds something serious.
        InvalidArgumentError: Where the remote holds that id already, or none is configured.
        RemoteError: Where it does not answer, or refuses.
    """
    report = verify(dataset_id)
    if not report.ok:
        raise InvalidDataError(f"data set {dataset_id!r}", expected="no finding of `verify`", actual=str(report))
    url = remote or os.environ.get(SETTING)
    if not url:
        raise _no_remote()
    place = open_remote(url, token)
    try:
        place.listing(dataset_id, None)
    except UnknownIdError:
        pass
    else:
        raise InvalidArgumentError(
            "dataset_id",
            expected=f"one that {url} does not hold",
            actual=repr(dataset_id),
            hint="Data sets do not change: upload it as the next version.",
        )
    folder = dataset_path(dataset_id)
    if not (folder / MANIFEST).exists():
        write_manifest(folder)
    _upload(url, token, dataset_id)
    listing = place.listing(dataset_id, None)
    digest = hashlib.sha256(_remote_manifest(place, listing) or b"").hexdigest()
    if digest != sha256_of(folder / MANIFEST):
        raise RemoteError(f"remote {url}: {MANIFEST}", expected="what was uploaded", actual=f"sha256 {digest}")
    return UploadReceipt(dataset_id, Source(url, listing.revision, digest))


def _no_remote() -> InvalidArgumentError:
    hint = f"Set {SETTING}=hf://ORGANISATION (or gcp://BUCKET) to where data sets are, or pass remote=."
    return InvalidArgumentError("remote", expected="one that is configured", actual="none", hint=hint)


def _upload(url: str, token: str | None, dataset_id: str) -> None:
    """What ``minari.upload_dataset`` does, to a remote that may be another than the environment's."""
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.namespace import namespace_hierarchy
    from minari.storage.remotes import get_cloud_storage

    with remote_errors(url, "Is the token given, and may it write there?", "to take the data set"):
        storage = get_cloud_storage(remote_path=url, token=token)
        known = set(storage.list_namespaces())
        for namespace in namespace_hierarchy(parse_dataset_id(dataset_id)[0]):
            if namespace not in known:
                storage.upload_namespace(namespace)
        storage.upload_dataset(dataset_id)


def _remote_manifest(place: Remote, listing: Listing) -> bytes | None:
    file = next((file for file in listing.files if file.path == MANIFEST), None)
    return b"".join(block for _, block in place.read(listing, file, 0)) if file is not None else None


def _fetch_all(place: Remote, listing: Listing, staged: Path, *, unchecked: bool, progress: bool) -> None:
    """All files of the manifest; without one all of the folder ``data``."""
    files = {file.path: file for file in listing.files}
    name = f"remote {place.url}"
    if MANIFEST in files:
        fetch(place, listing, files[MANIFEST], staged)
        wanted = list(_own_manifest(staged))
    elif unchecked:
        wanted = [path for path in files if path.startswith("data/") and ".." not in path.split("/")]
    else:
        raise FileFormatError(
            name,
            expected=f"a manifest {MANIFEST} to check the files with",
            actual="none",
            hint="Pass unchecked=True (--unchecked) if you accept the data as they come.",
        )
    missing = [path for path in wanted if path not in files]
    if missing:
        raise FileFormatError(name, expected=f"the files of its {MANIFEST}", actual=f"no {missing[0]}")
    with Bars(progress, of_bytes=True) as bars:
        for path in wanted:
            bars.show(path, 0, files[path].size)
            fetch(place, listing, files[path], staged, partial(bars.advance, path))


def _own_manifest(staged: Path) -> dict[str, str]:
    try:
        return read_manifest(staged)
    except FileFormatError:
        (staged / MANIFEST).unlink()  # the next attempt fetches it again
        raise


def _check(staged: Path, dataset_id: str, source: Source, *, unchecked: bool) -> None:
    """Refuses files that are not those of the manifest, or no data set of this id; what is wrong is removed."""
    manifest = staged / MANIFEST
    if source.manifest_sha256 is not None and sha256_of(manifest) != source.manifest_sha256:
        actual = sha256_of(manifest)
        shutil.rmtree(staged)
        raise FileFormatError(
            f"{source.remote}: {dataset_id}: {MANIFEST}",
            expected=f"sha256 {source.manifest_sha256}, as in the catalogue",
            actual=actual,
            hint="The remote does not hold what this package was released with.",
        )
    if manifest.exists() or not unchecked:
        wrong = differences(staged)
        for difference in wrong:
            (staged / difference.path).unlink(missing_ok=True)
        if wrong:
            raise FileFormatError(
                f"{source.remote}: {dataset_id}: {wrong[0].path}",
                expected=wrong[0].expected,
                actual=wrong[0].actual,
                hint="Run it again to fetch it once more; if that repeats, the remote's copy is damaged.",
            )
    try:
        if (found := open_dataset(staged).spec.dataset_id) != dataset_id:
            name = f"{source.remote}: {dataset_id}"
            raise FileFormatError(name, expected="a data set of that id", actual=repr(found))
    except FileFormatError:
        shutil.rmtree(staged)
        raise


@contextmanager
def _download_folder(dataset_id: str) -> Iterator[Path]:
    """A folder of this process alone, hidden from Minari, that is still there at the next attempt."""
    root = dataset_path("") / ".downloading"
    label = dataset_id.replace("/", "--")
    if len(os.fsencode(label)) > 200:  # names of files end at 255 bytes
        label = hashlib.sha256(os.fsencode(dataset_id)).hexdigest()
    folder, lock = root / label, FileLock(root / f"{label}.lock", thread_local=False)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0.0)
    except Timeout as error:
        raise StorageError(
            f"data set {dataset_id!r}",
            expected="one download at a time",
            actual="another process that downloads it now",
            hint="Wait for it to finish.",
        ) from error
    except OSError as error:
        raise StorageError.of(folder, error) from error
    try:
        yield folder
    finally:
        lock.release()


def _begin(folder: Path, remote: str, revision: str) -> None:
    """Keeps what a former attempt left if it was of the same revision, else begins anew."""
    label, content = folder / "source.json", json.dumps({"remote": remote, "revision": revision})
    if not label.exists() or label.read_text(encoding="utf-8") != content:
        shutil.rmtree(folder / "dataset", ignore_errors=True)
        write_file(label, content)


def _is_complete(folder: Path, source: Source) -> bool:
    """Whether a former attempt brought everything, so that no connection is needed."""
    try:
        label = json.loads((folder / "source.json").read_text(encoding="utf-8"))
        same = label["remote"] == source.remote and source.revision in (None, label["revision"])
        return same and not differences(folder / "dataset")
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _catalogue_entry(dataset_id: str) -> Source | None:
    for file in _catalogue_files():
        content = tomllib.loads(file.read_text(encoding="utf-8"))
        if "download" in content and content["dataset"]["id"] == dataset_id:
            entry = content["download"]
            return Source(entry["remote"], entry.get("revision"), entry.get("manifest_sha256"))
    return None


def _catalogue_files() -> list[Traversable]:
    return [file for file in catalog_file(".").iterdir() if file.name.endswith(".toml")]
