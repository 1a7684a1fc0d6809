"""Reading Minari's remotes: what they hold, and each file from any byte on.

Minari's own clients start a file anew after a broken connection, take no revision and check no hash; these read the
same places (a Hugging Face organisation, a Google Cloud Storage bucket, laid out by Minari) with all three.

``huggingface_hub.snapshot_download`` (2.4) takes a revision, but it throws away what a broken attempt has brought,
writes as many bytes as a server sends before it compares them with the size, and knows no other remote.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, MPCOfflineError, StorageError, UnknownIdError

SETTING = "MINARI_REMOTE"
ATTEMPTS = 3
BLOCK = 1 << 20
_GRAMMAR = "hf://ORGANISATION or gcp://BUCKET"


class RemoteError(MPCOfflineError, ConnectionError):
    """A remote does not answer, refuses, or breaks off."""


@dataclass(frozen=True)
class RemoteFile:
    """A file of a data set on a remote.

    Attributes:
        path: Within the data set's folder.
        size: In bytes.
        handle: What the remote knows it by.
    """

    path: str
    size: int
    handle: Any


@dataclass(frozen=True)
class Listing:
    """A data set on a remote at one revision, which never changes.

    Attributes:
        revision: A commit (Hugging Face) or a hash over the generations of all files (Google Cloud Storage).
        files: Its files.
    """

    revision: str
    files: tuple[RemoteFile, ...]


class Remote(Protocol):
    """What a download needs of a remote.

    Attributes:
        url: As in Minari's setting.
    """

    url: str

    def listing(self, dataset_id: str, revision: str | None) -> Listing:
        """The files of a data set.

        Args:
            dataset_id: Minari id.
            revision: As a former listing gave it, or any name that the remote knows; None for the newest.

        Raises:
            UnknownIdError: Where the remote has no such data set or revision.
            RemoteError: Where it does not answer.
        """
        ...

    def read(self, listing: Listing, file: RemoteFile, offset: int) -> Iterator[tuple[int, bytes]]:
        """The file in blocks, from a byte on: pairs of position and bytes.

        Raises:
            RemoteError: Where the connection breaks.
        """
        ...


def open_remote(url: str, token: str | None = None) -> Remote:
    """The remote of a Minari address.

    Args:
        url: ``hf://ORGANISATION`` or ``gcp://BUCKET``.
        token: As Minari takes it: a Hugging Face token, or the path of a service account's key. None for public data.

    Raises:
        InvalidArgumentError: For any other address, or where the package that speaks to it is missing.
    """
    kind, _, name = url.partition("://")
    if kind not in ("hf", "gcp") or not name or "/" in name:
        raise InvalidArgumentError(
            "remote", expected=_GRAMMAR, actual=repr(url), hint=f"It is Minari's setting: the variable {SETTING}."
        )
    try:
        return HuggingFace(name, token) if kind == "hf" else GoogleCloud(name, token)
    except ImportError as error:
        extra, package = ("hub", "huggingface_hub") if kind == "hf" else ("gcs", "google-cloud-storage")
        raise InvalidArgumentError(
            f"remote {url}",
            expected=f"the package {package}",
            actual=str(error),
            hint=f'Install it: pip install "mpcoffline[{extra}]"',
        ) from error


class HuggingFace:
    """An organisation on a Hugging Face hub: the first part of the id is the repository, the rest the path in it.

    Args:
        name: The organisation.
        token: For private data; None for that of ``hf auth login``, if any.
    """

    url: str

    def __init__(self, name: str, token: str | None = None) -> None:
        from huggingface_hub import HfApi

        self.url, self._name, self._api = f"hf://{name}", name, HfApi(token=token)

    def listing(self, dataset_id: str, revision: str | None) -> Listing:
        """See :class:`Remote`."""
        from huggingface_hub.errors import EntryNotFoundError, RepositoryNotFoundError, RevisionNotFoundError

        repository, _, folder = dataset_id.partition("/")
        where: dict[str, Any] = {"repo_id": f"{self._name}/{repository}", "repo_type": "dataset"}
        with remote_errors(self.url, self._hint()):
            try:
                commit = str(self._api.repo_info(**where, revision=revision).sha)
                tree = list(self._api.list_repo_tree(**where, path_in_repo=folder, recursive=True, revision=commit))
            except (RepositoryNotFoundError, RevisionNotFoundError, EntryNotFoundError) as error:
                raise _not_there(self.url, dataset_id, revision, error) from error
        start = f"{folder}/" if folder else ""
        files = [
            RemoteFile(entry.path.removeprefix(start), entry.size, (where, entry.path))
            for entry in tree
            if hasattr(entry, "size")  # the others are folders
        ]
        return Listing(commit, tuple(files))

    def read(self, listing: Listing, file: RemoteFile, offset: int) -> Iterator[tuple[int, bytes]]:
        """See :class:`Remote`."""
        from huggingface_hub import get_session, hf_hub_url
        from huggingface_hub.utils import build_hf_headers, hf_raise_for_status

        where, path = file.handle
        address = hf_hub_url(**where, filename=path, revision=listing.revision, endpoint=self._api.endpoint)
        headers = build_hf_headers(token=self._api.token) | {"Accept-Encoding": "identity"}
        if offset:
            headers["Range"] = f"bytes={offset}-"
        with (
            remote_errors(self.url, self._hint()),
            get_session().stream("GET", address, headers=headers, follow_redirects=True) as response,
        ):
            hf_raise_for_status(response)
            position = offset if response.status_code == 206 else 0  # 200: the whole file, asked for or not
            for block in response.iter_bytes():
                yield position, block
                position += len(block)

    def _hint(self) -> str:
        offline = " HF_HUB_OFFLINE is set." if os.environ.get("HF_HUB_OFFLINE") else ""
        return f"Check the connection to {self._api.endpoint}.{offline}"


class GoogleCloud:
    """A Google Cloud Storage bucket: the id is the path.

    Args:
        name: The bucket.
        token: Path of a service account's key file; None for public data.
    """

    url: str

    def __init__(self, name: str, token: str | None = None) -> None:
        from minari.storage.remotes.gcp import GCPStorage

        self.url, self._bucket = f"gcp://{name}", GCPStorage(name, token).bucket

    def listing(self, dataset_id: str, revision: str | None) -> Listing:
        """See :class:`Remote`."""
        start = f"{dataset_id}/"
        with remote_errors(self.url, "Check the connection."):
            blobs = sorted(self._bucket.list_blobs(prefix=start), key=lambda blob: str(blob.name))
        if not blobs:
            raise _not_there(self.url, dataset_id, None, None)
        state = "\n".join(f"{blob.name} {blob.generation}" for blob in blobs)
        found = hashlib.sha256(state.encode()).hexdigest()
        if revision not in (None, found):
            raise _not_there(self.url, dataset_id, revision, None)
        files = [RemoteFile(blob.name.removeprefix(start), int(blob.size), blob) for blob in blobs]
        return Listing(found, tuple(files))

    def read(self, listing: Listing, file: RemoteFile, offset: int) -> Iterator[tuple[int, bytes]]:
        """See :class:`Remote`."""
        with remote_errors(self.url, "Check the connection."):
            for position in range(offset, file.size, BLOCK):
                last = min(position + BLOCK, file.size) - 1
                generation = file.handle.generation
                yield position, file.handle.download_as_bytes(start=position, end=last, if_generation_match=generation)


def fetch(
    remote: Remote,
    listing: Listing,
    file: RemoteFile,
    folder: Path,
    progress: Callable[[int], object] | None = None,
) -> None:
    """Brings one file into a folder, going on where a former attempt broke off.

    The file has its name only when it is complete. A connection that breaks is taken up again as long as it brings
    anything, and :data:`ATTEMPTS` times without.

    Args:
        remote: Where from.
        listing: What the file belongs to.
        file: Which.
        folder: The data set's folder.
        progress: Told the number of bytes of each block.

    Raises:
        RemoteError: Where the connection breaks for good; what has come is kept.
        StorageError: Where the disk is full or fails.
    """
    target = folder / file.path
    partial = target.with_name(f".{target.name}.part")
    if target.exists():
        return
    failures, name = 0, f"remote {remote.url}: {file.path}"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial.touch()
        with partial.open("r+b") as sink:
            have = sink.seek(0, os.SEEK_END)
            if progress is not None:
                progress(have)
            while have < file.size:
                try:
                    for position, block in remote.read(listing, file, have):
                        if position != sink.tell():
                            sink.seek(position)
                            sink.truncate()
                        sink.write(block)
                        if progress is not None:
                            progress(len(block))
                        if sink.tell() > file.size:
                            break
                except RemoteError:
                    failures = 0 if sink.tell() > have else failures + 1
                    if failures >= ATTEMPTS:
                        raise
                else:
                    if sink.tell() == have:
                        raise RemoteError(name, expected=f"{file.size} bytes", actual=str(have))
                have = sink.tell()
            if have > file.size:
                sink.seek(0)
                sink.truncate()
                raise FileFormatError(name, expected=f"{file.size} bytes", actual="more than that")
            sink.flush()
            os.fsync(sink.fileno())
        partial.replace(target)
    except OSError as error:
        if isinstance(error, MPCOfflineError):
            raise
        raise StorageError.of(target, error) from error


@contextmanager
def remote_errors(url: str, hint: str, expected: str = "an answer") -> Iterator[None]:
    """Whatever a client raises becomes a :class:`RemoteError` that says what to do."""
    try:
        yield
    except (MPCOfflineError, GeneratorExit):
        raise
    except Exception as error:  # the clients' own classes differ between their versions
        raise RemoteError(
            f"remote {url}",
            expected=expected,
            actual=f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}",
            hint=f"{hint} Then run it again: it goes on where it stopped.",
        ) from error


def _not_there(url: str, dataset_id: str, revision: str | None, error: Exception | None) -> UnknownIdError:
    at = f" at revision {revision}" if revision else ""
    said = f" ({type(error).__name__})" if error else ""
    return UnknownIdError(
        f"remote {url}", expected="a data set that it holds", actual=f"{dataset_id!r}{at}, which is not there{said}"
    )
