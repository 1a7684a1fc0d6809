"""The folder of a tuned controller: what is in it, and how it appears complete or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any

from mpcoffline.core.archive import file_errors, plain
from mpcoffline.core.atomic import publish
from mpcoffline.core.documents import read_json
from mpcoffline.core.errors import FileFormatError, StorageError
from mpcoffline.core.outputs import check_output_folder, make_folder, write_file

RUN, PLANT, LOG, LEARNER, POLICY, PAGE = (
    "run.json", "plant.json", "log.zip", "learner.zip", "policy.zip", "report.html",
)  # fmt: skip
CODE, CHECKPOINT, BEGUN = "controller", "fit.ckpt", "begun.json"
HIDDEN = "hidden"  # the part of plant.json that is about outputs
OUTPUTS = "outputs.zip"  # what a log of outputs held, of which log.zip has the states
_STEP = ".step.json"
_FORMAT, _VERSION = "mpcoffline tuned", 1
_PACKAGES = ("mpcoffline", "numpy", "scipy", "casadi", "torch")


@dataclass(frozen=True)
class Workplace:
    """Where a folder is made: beside it, so that what is unfinished is never taken for a result.

    Attributes:
        folder: The folder that is to be.
        identity: What decides the result, as a SHA-256.
    """

    folder: Path
    identity: str

    @property
    def path(self) -> Path:
        """Where it is made until it is complete."""
        whole = self.folder if self.folder.name.strip(".") else self.folder.resolve()
        return whole.with_name(f"{whole.name}.unfinished")

    @property
    def finished(self) -> dict[str, Any] | None:
        """What was run, if the folder is of this very run already."""
        try:
            document = read_run(self.folder)
        except (FileFormatError, FileNotFoundError, NotADirectoryError):
            return None
        return document if document.get("identity") == self.identity else None

    def begin(self) -> bool:
        """Makes the workplace, and empties it where it is of another run.

        Returns:
            Whether something of this run is there already.

        Raises:
            StorageError: If the folder, or what has the name of the workplace, is something else.
        """
        if self.folder.exists() and not is_tuned(self.folder) and (not self.folder.is_dir() or any_in(self.folder)):
            raise _taken(self.folder, "a tuned one, an empty one or none")
        check_output_folder(self.path)
        mark = self.path / BEGUN
        if self.path.exists() and (not self.path.is_dir() or any_in(self.path)):
            if not mark.is_file() and not is_tuned(self.path):
                raise _taken(self.path, "an unfinished one of tune, or none")
            if mark.is_file() and read_json(mark).get("identity") == self.identity:
                return True
            shutil.rmtree(self.path)
        make_folder(self.path)
        write_file(mark, json.dumps({"identity": self.identity}))
        return False

    def once(self, name: str, step: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What a step gives, which is done once: again by the same command, it is read.

        Args:
            name: Of the step.
            step: Does it; what it gives is JSON-able.
        """
        file = self.path / f"{name}{_STEP}"
        if not file.is_file():
            write_file(file, json.dumps(plain(step()), allow_nan=False))
        return dict(read_json(file))

    def finish(self, document: Mapping[str, Any]) -> Path | None:
        """Gives the folder its name, in one step; what had it becomes a numbered folder inside.

        Args:
            document: What was run.

        Returns:
            Where what was there is now; None where there was nothing.
        """
        write_file(self.path / RUN, json.dumps(plain(dict(document) | self._mark), indent=2, allow_nan=False) + "\n")
        former = None
        if is_tuned(self.folder):
            kept = numbered(self.folder)
            for number, folder in kept.items():
                _link(folder, self.path / str(number))
            former = str(max(kept, default=0) + 1)
            _link(self.folder, self.path / former, frozenset(map(str, kept)))
        for path in (self.path / BEGUN, self.path / CHECKPOINT, *self.path.glob(f"*{_STEP}")):
            path.unlink(missing_ok=True)
        publish(self.path, self.folder, overwrite=True)
        return None if former is None else self.folder / former

    @property
    def _mark(self) -> dict[str, Any]:
        return {"format": _FORMAT, "version": _VERSION, "identity": self.identity}


def _taken(folder: Path, expected: str) -> StorageError:
    hint = "Name another folder, or move that one away."
    return StorageError(f"folder {folder}", expected=expected, actual="something else", hint=hint)


def read_run(folder: str | PathLike[str]) -> dict[str, Any]:
    """What was run to make a folder.

    Raises:
        FileNotFoundError: If there is no such file in it.
        FileFormatError: If it is damaged, or of another kind or version.
    """
    path = Path(folder) / RUN
    document = read_json(path)
    with file_errors(path):
        found = document["format"], document["version"]
    if found != (_FORMAT, _VERSION):
        raise FileFormatError(str(path), expected=f"{_FORMAT}, version {_VERSION}", actual=f"{found}"[:200])
    return dict(document)


def is_tuned(folder: Path) -> bool:
    """Whether a folder is one of ``tune``."""
    try:
        read_run(folder)
    except (FileFormatError, FileNotFoundError, NotADirectoryError):
        return False
    return True


def numbered(folder: Path) -> dict[int, Path]:
    """What a folder was before, by number."""
    found = {int(each.name): each for each in folder.iterdir() if each.is_dir() and each.name.isdecimal()}
    return dict(sorted(found.items()))


def any_in(folder: Path) -> bool:
    """Whether a folder holds anything."""
    return next(folder.iterdir(), None) is not None


def _link(folder: Path, target: Path, without: frozenset[str] = frozenset()) -> None:
    """A copy of a folder that takes no room where the file system can do so: files here are replaced, never written."""

    def linked(source: str, destination: str) -> None:
        try:
            os.link(source, destination)
        except OSError:
            shutil.copy2(source, destination)

    def left_out(parent: str, names: list[str]) -> set[str]:
        return set(without) & set(names) if Path(parent) == folder else set()

    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(folder, target, copy_function=linked, ignore=left_out)


def identity_of(**parts: Any) -> str:
    """What decides a result, of any JSON-able parts, and of versions: as a SHA-256."""
    text = json.dumps(plain(parts | {"versions": versions()}), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def versions() -> dict[str, str]:
    """Versions of what the numbers come from."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}
