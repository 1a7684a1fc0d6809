"""The sha256 manifest of a data set: a file ``SHA256SUMS`` beside its ``data`` folder, as ``sha256sum`` writes it.

Minari stores no hash. The manifest lists every file of the data set's folder but itself, by its path within, so that
``sha256sum -c SHA256SUMS`` checks it without this package.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.files import check_regular, read_limited
from mpcoffline.core.limits import MANIFEST_BYTES
from mpcoffline.core.outputs import write_file
from mpcoffline.core.text import visible

MANIFEST = "SHA256SUMS"
_NOT_LISTED = "no file that is not listed"
_LINE = re.compile(r"([0-9a-f]{64})  ([^\\\x00-\x1f]+)")


@dataclass(frozen=True)
class Difference:
    """A file that is not as its manifest says.

    Attributes:
        path: Within the data set's folder.
        expected: What the manifest says, in words.
        actual: What was found, in words.
    """

    path: str
    expected: str
    actual: str

    @property
    def concerns_data(self) -> bool:
        """False for a file that nobody listed beside the data, such as notes, or another data set within."""
        return self.expected != _NOT_LISTED or self.path.startswith("data/")

    def __str__(self) -> str:
        return visible(f"{self.path}: expected {self.expected}, got {self.actual}")


def sha256_of(path: Path) -> str:
    """The sha256 of a file as 64 hexadecimal digits, read in blocks.

    Raises:
        FileFormatError: For what is no regular file.
    """
    check_regular(path)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_manifest(folder: Path, names: Iterable[str] | None = None) -> Path:
    """Writes the manifest of a folder, atomically and synced.

    Args:
        folder: The folder that holds ``data``.
        names: The files that it lists, by path within; by default all that are not hidden.

    Returns:
        The manifest's path.

    Raises:
        StorageError: Where the disk refuses.
    """
    lines = [f"{sha256_of(folder / name)}  {name}\n" for name in (_files(folder) if names is None else names)]
    target = folder / MANIFEST
    if target.is_symlink():  # it may be somebody else's, and lead anywhere: it is replaced, not what it leads to
        target.unlink()
    return write_file(target, "".join(lines))


def read_manifest(folder: Path) -> dict[str, str]:
    """The manifest of a data set's folder: path within to sha256.

    Raises:
        FileFormatError: For a file that is not a manifest.
        FileNotFoundError: Where there is none.
    """
    path = folder / MANIFEST
    return parse_manifest(read_limited(path, MANIFEST_BYTES), str(path))


def parse_manifest(content: bytes, name: str = MANIFEST) -> dict[str, str]:
    """Reads the text of a manifest.

    Args:
        content: The file's bytes.
        name: What error messages call it.

    Returns:
        Path within the data set's folder to sha256.

    Raises:
        FileFormatError: For a line that is not one of ``sha256sum``, a path that leaves the folder, a path listed
            twice, or no line at all.
    """
    try:
        lines = content.decode("utf-8").split("\n")
    except UnicodeDecodeError as error:
        raise FileFormatError(name, expected="UTF-8 text", actual=str(error)) from error
    if lines.pop() != "":
        raise FileFormatError(name, expected="a line break at the end", actual="none: the file is cut off")
    sums: dict[str, str] = {}
    for number, line in enumerate(lines, start=1):
        match = _LINE.fullmatch(line)
        if match is None:
            raise FileFormatError(
                f"{name}, line {number}", expected="64 hexadecimal digits and a path", actual=repr(line[:100])
            )
        digest, path = match.groups()
        pure = PurePosixPath(path)
        if pure.is_absolute() or ".." in pure.parts or str(pure) != path or path in sums or path == MANIFEST:
            raise FileFormatError(
                f"{name}, line {number}", expected="a file inside the folder, listed once", actual=repr(path)
            )
        sums[path] = digest
    if not sums:
        raise FileFormatError(name, expected="at least one file", actual="none")
    return sums


def differences(folder: Path) -> list[Difference]:
    """Compares a data set's folder with its manifest.

    Returns:
        The files that are missing, changed or not listed; empty where all is as it was.

    Raises:
        FileFormatError: For a damaged manifest.
        FileNotFoundError: Where there is none.
    """
    sums = read_manifest(folder)
    found = set(_files(folder))
    result = []
    for path, digest in sums.items():
        actual = f"sha256 {sha256_of(folder / path)}" if path in found else "no such file"
        if actual != f"sha256 {digest}":
            result.append(Difference(path, f"sha256 {digest}", actual))
    result += [Difference(path, _NOT_LISTED, "one") for path in sorted(found - set(sums))]
    return result


def _files(folder: Path) -> Iterator[str]:
    """Regular files below the folder, but for the manifest and hidden ones, by path within, sorted."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return iter(sorted(name for name in names if name != MANIFEST and not PurePosixPath(name).name.startswith(".")))
