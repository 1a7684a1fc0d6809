"""Hostile files made by hand, each with a name."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

from . import hostile_archives, hostile_hdf5, hostile_places
from .cases import Case
from .honest import Honest
from .targets import Read

KINDS = {"archives": hostile_archives.FILES, "data sets": hostile_hdf5.FILES, "places": hostile_places.FILES}

SLOW = ("hostile archives/a chain of 10,000 sines",)  # minutes: in the full run alone


def all_cases(honest: Honest) -> list[Case]:
    """A case for each; 64 MB count as what an honest file takes."""

    def make(function: Callable[[Honest, Path], Read]) -> Callable[[Path, random.Random], tuple[str, Read]]:
        return lambda folder, rng: ("by hand", function(honest, folder))

    return [
        Case(f"hostile {kind}/{name}", make(function), 64 << 20)
        for kind, files in KINDS.items()
        for name, function in files.items()
    ]
