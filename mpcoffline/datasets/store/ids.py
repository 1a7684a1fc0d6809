"""Which ids a data set may have, those that Minari, the file system and the lists take for the same, and its folder."""

from __future__ import annotations

import os
import re
from pathlib import Path

from mpcoffline.core.errors import InvalidArgumentError

GRAMMAR = (
    "(namespace/)*name-vN of letters, digits, '-' and '_' (no dots; a namespace has two characters or more, is not"
    " 'data' and does not end in -vN itself; at most 255 bytes a part, 1024 in all)"
)
ID_LENGTH = 1024
PART_BYTES = 255  # what file systems take
_VERSION = re.compile(r"-v\d+")
_NUMBER = re.compile(r".*-v(0|[1-9][0-9]*)", re.DOTALL)


def is_valid_id(dataset_id: object) -> bool:
    """Whether Minari can parse the id, and its folder holds nothing else; such an id also stays inside the store.

    Minari takes any folder with a folder ``data`` in it for a data set, so that no namespace may be called that, and
    looks for none inside a data set, so that no namespace may look like one. It reads ``-v00`` as ``-v0``.
    """
    from minari.dataset.minari_dataset import DATASET_ID_RE

    # The length first: Minari's expression takes time quadratic in it.
    if not isinstance(dataset_id, str) or len(dataset_id) > ID_LENGTH or "//" in dataset_id:
        return False
    match = DATASET_ID_RE.fullmatch(dataset_id)
    if match is None or match.group("version") is None or _NUMBER.fullmatch(dataset_id) is None:
        return False
    *namespaces, _ = parts = dataset_id.split("/")
    try:
        fits = max(len(os.fsencode(part)) for part in parts) <= PART_BYTES
    except UnicodeEncodeError:  # a file system of another alphabet
        return False
    taken = any(part.casefold() == "data" or re.search(rf"{_VERSION.pattern}\Z", part) for part in namespaces)
    return fits and not taken


def check_dataset_id(dataset_id: object) -> None:
    """Refuses an id that Minari could not parse, or would take for something else.

    Raises:
        InvalidArgumentError: Naming Minari's grammar.
    """
    if not is_valid_id(dataset_id):
        raise InvalidArgumentError("dataset_id", expected=f"an id {GRAMMAR}", actual=repr(dataset_id))


def dataset_path(dataset_id: str) -> Path:
    """The folder of a data set in the local Minari store, whether it exists or not."""
    from minari.storage import get_dataset_path

    return Path(get_dataset_path(dataset_id))


def is_local(dataset_id: str) -> bool:
    """Whether the local Minari store holds the data set."""
    return (dataset_path(dataset_id) / "data").exists()
