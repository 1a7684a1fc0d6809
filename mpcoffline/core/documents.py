"""JSON out of files: measured before it is parsed, each key once."""

from __future__ import annotations

import json
from collections import Counter
from os import PathLike
from pathlib import Path
from typing import Any

from mpcoffline.core import limits
from mpcoffline.core.files import read_limited
from mpcoffline.core.limits import check_limit

from .errors import FileFormatError


def parsed_json(content: bytes, name: str) -> Any:
    """What a JSON text says.

    Args:
        content: The text, UTF-8.
        name: The file, for messages.

    Raises:
        FileFormatError: If it is larger than :mod:`mpcoffline.core.limits` allow, no JSON, or names a key twice.
    """
    _check_size(content, name)
    try:
        return json.loads(content.decode(), object_pairs_hook=_unique)
    except (ValueError, RecursionError, MemoryError) as error:
        raise FileFormatError(name, expected="JSON", actual=f"{error}"[:300]) from error


def written_json(document: Any, name: str) -> bytes:
    """A document as JSON text that :func:`parsed_json` takes.

    Raises:
        FileFormatError: If it is too large to be read again.
        TypeError: If JSON cannot say it.
    """
    content = json.dumps(document).encode()
    _check_size(content, name)
    return content


def read_json(path: str | PathLike[str], most: int = limits.JSON_BYTES) -> Any:
    """What a JSON file says.

    Args:
        path: The file.
        most: How many bytes it may have.

    Raises:
        FileNotFoundError: If there is no such file.
        FileFormatError: If it is no regular file, too large, or no JSON.
    """
    return parsed_json(read_limited(Path(path), most), str(path))


def _check_size(content: bytes, name: str) -> None:
    """Counts what the parser would make, from above: signs inside texts are counted too."""
    counts = {sign: content.count(sign) for sign in (b"[", b"{", b'"', b",", b":")}
    containers = counts[b"["] + counts[b"{"]
    check_limit(name, "bytes of JSON", len(content), limits.JSON_BYTES)
    check_limit(name, "lists and objects in JSON", containers, limits.JSON_CONTAINERS)
    check_limit(name, "texts in JSON", counts[b'"'] // 2, limits.JSON_TEXTS)
    check_limit(name, "values in JSON", containers + counts[b","] + counts[b":"], limits.JSON_VALUES)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, refused where a key comes twice: readers differ in which of the two they take."""
    found = dict(pairs)
    if len(found) < len(pairs):
        twice, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        raise ValueError(f"the key {twice[:100]!r} twice")
    return found
