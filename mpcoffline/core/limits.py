"""How large things in files may be: one table, asked before anything in a file is believed.

A file says how large its contents are; a small file can say so of contents that no machine holds. Each reader compares
with these limits before it allocates, and refuses by a :class:`~mpcoffline.errors.FileFormatError`.
"""

from __future__ import annotations

from mpcoffline.errors import FileFormatError


def check_limit(name: str, what: str, found: int, limit: int, *, hint: str = "") -> None:
    """Refuses what a file says of itself where it is more than the limit.

    Args:
        name: The file, or the thing in it.
        what: What is counted, e.g. ``"bytes of JSON"``.
        found: How many there are, or are said to be.
        limit: How many there may be.
        hint: What to do next.

    Raises:
        FileFormatError: Where there are more.
    """
    if found > limit:
        raise FileFormatError(name, expected=f"at most {limit} {what}", actual=str(found), hint=hint)
