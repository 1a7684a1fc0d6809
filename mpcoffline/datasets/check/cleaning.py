"""What piles up on this machine, and removing it: caches, what killed processes left, broken-off downloads, backups."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mpcoffline.core.caches import KINDS, disk_size, entries, remove
from mpcoffline.core.errors import MPCOfflineError, UnknownIdError
from mpcoffline.core.places import cache_root, temporary_root
from mpcoffline.core.scratch import abandoned, is_free, remove_abandoned
from mpcoffline.datasets.recording.resuming import sealed_recordings
from mpcoffline.datasets.recording.session import seal
from mpcoffline.datasets.store.ids import BACKUPS, DOWNLOADS, dataset_path
from mpcoffline.datasets.store.manifest import MANIFEST
from mpcoffline.datasets.store.recording_lock import empty_recordings, recording_path, remove_empty

Kind = Literal["leftovers", "caches", "downloads", "backups"]

#: What :func:`clean` looks for, and what becomes of it.
KINDS_OF_WASTE: dict[Kind, str] = {
    "leftovers": "half-built things of killed processes: nobody reads them",
    "caches": "compiled solvers and tables: they are made again when needed",
    "downloads": "downloads that broke off: they begin anew instead of going on",
    "backups": "what repairing kept of damaged data, and recordings that were not continued: gone for good",
}
DEFAULT_KINDS: tuple[Kind, ...] = ("leftovers", "caches")


@dataclass(frozen=True)
class Waste:
    """One thing that can go.

    Attributes:
        kind: ``"leftovers"``, ``"caches"``, ``"downloads"`` or ``"backups"``.
        path: File or folder.
        size: On the disk, in bytes.
        removed: Whether it is gone now.
    """

    kind: Kind
    path: Path
    size: int
    removed: bool = False


@dataclass(frozen=True)
class CleaningReport:
    """What :func:`clean` found.

    Attributes:
        found: Everything, by kind.
    """

    found: tuple[Waste, ...]

    @property
    def size(self) -> int:
        """All of it, in bytes."""
        return sum(waste.size for waste in self.found)

    @property
    def freed(self) -> int:
        """What was removed, in bytes."""
        return sum(waste.size for waste in self.found if waste.removed)

    def __str__(self) -> str:
        """A line for each kind that was found, then a line for each folder that it is in."""
        lines: list[str] = []
        for kind, meaning in KINDS_OF_WASTE.items():
            places: dict[Path, list[Waste]] = {}
            for waste in self.found:
                if waste.kind == kind:
                    places.setdefault(waste.path.parent, []).append(waste)
            if not places:
                continue
            lines.append(f"{kind} ({meaning}):")
            for place, wastes in sorted(places.items()):
                verb = "removed" if all(waste.removed for waste in wastes) else "there"
                size = sum(waste.size for waste in wastes)
                lines.append(f"  {size / 1e6:9.1f} MB in {len(wastes)} {verb}: {place}")
        return "\n".join(lines) if lines else "Nothing to clean."


def clean(kinds: Iterable[Kind] = DEFAULT_KINDS, *, remove_found: bool = False) -> CleaningReport:
    """Finds what can go, and removes it if asked to.

    Data sets and recordings that :func:`repair` can finish are never touched, nor is what a living process builds or
    downloads. Compiled solvers and tables that are in use stay readable for those who use them.

    Args:
        kinds: What to look for; by default ``"leftovers"`` and ``"caches"``, without which nothing is lost. Also
            ``"downloads"`` that broke off, and ``"backups"``: what repairing kept as it was, and recording of
            another recording's logs.
        remove_found: Whether it is removed; otherwise it is only looked at.

    Returns:
        What was found, how large it is, and whether it is gone.

    Raises:
        UnknownIdError: For another kind.
    """
    found: list[Waste] = []
    for kind in dict.fromkeys(kinds):
        if kind not in KINDS_OF_WASTE:
            raise UnknownIdError.of("kind of waste", str(kind), KINDS_OF_WASTE)
        found += _FINDERS[kind]()
    if remove_found:
        found = [_without(waste) for waste in found]
    return CleaningReport(tuple(found))


def _without(waste: Waste) -> Waste:
    if waste.kind == "downloads" and not is_free(waste.path.with_name(f"{waste.path.name}.lock")):
        return waste  # begun again meanwhile
    for name in sealed_recordings():
        if waste.path == recording_path(name):
            with suppress(MPCOfflineError):  # the data set is damaged: the logs are all there is
                seal(name)
    if waste.path in empty_recordings():
        remove_empty(waste.path)
    elif waste.kind == "leftovers":
        remove_abandoned(waste.path)
    else:
        remove(waste.path)
    if waste.kind == "backups":
        with suppress(OSError):  # folders of namespaces that are empty now
            os.removedirs(waste.path.parent)
    return Waste(waste.kind, waste.path, waste.size, removed=not waste.path.exists())


def _leftovers() -> Iterator[Waste]:
    places = [*_folders_of_store(), *(root / kind for root in _roots() for kind in KINDS)]
    for place in places:
        with suppress(OSError):
            for path in abandoned(place):
                yield Waste("leftovers", path, disk_size(path))
    for path in [*empty_recordings(), *map(recording_path, sealed_recordings())]:
        yield Waste("leftovers", path, disk_size(path))


def _caches() -> Iterator[Waste]:
    for root in _roots():
        for entry in entries(root):
            yield Waste("caches", entry.path, entry.size)


def _downloads() -> Iterator[Waste]:
    root = dataset_path("") / DOWNLOADS
    for folder in sorted(root.iterdir()) if root.is_dir() else ():
        if folder.is_dir() and is_free(folder.with_name(f"{folder.name}.lock")):
            yield Waste("downloads", folder, disk_size(folder))


def _backups() -> Iterator[Waste]:
    root = dataset_path("") / BACKUPS
    for folder, below, _ in os.walk(root):
        if "data" in below or Path(folder).joinpath(MANIFEST).exists() or any(Path(folder).glob("env-*.log")):
            below.clear()
            yield Waste("backups", Path(folder), disk_size(Path(folder)))


_FINDERS = {"leftovers": _leftovers, "caches": _caches, "downloads": _downloads, "backups": _backups}


def _roots() -> list[Path]:
    """The folders of all caches that there are."""
    return [root for root in (cache_root(), temporary_root()) if root is not None and root.is_dir()]


def _folders_of_store() -> Iterator[Path]:
    """The store and its namespaces: where data sets are built, but not what is in data sets."""
    for folder, below, _ in os.walk(dataset_path("")):
        if "data" in below:
            below.clear()
            continue
        below[:] = [name for name in below if not name.startswith(".")]
        yield Path(folder)
