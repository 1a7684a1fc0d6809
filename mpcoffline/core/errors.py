"""The project's exceptions: each names the thing, what was expected, what was found, and what to do next."""

from __future__ import annotations

import difflib
import errno
import os
from collections.abc import Iterable


def visible(text: str) -> str:
    """Text for a terminal: what would steer it (escape sequences, marks that reorder a line) is shown by its number.

    Line ends stay.

    Args:
        text: Any text, as one of a file.
    """
    if text.isprintable():
        return text
    return "".join(c if c == "\n" or c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class MPCOfflineError(Exception):
    """Base class of the errors raised on purpose by mpcoffline.

    Args:
        name: What is wrong, as the user knows it (an argument, a file, a dataset id).
        expected: What would have been right.
        actual: What was found.
        hint: What to do next.
    """

    name: str
    expected: str
    actual: str
    hint: str

    def __init__(self, name: str, *, expected: str, actual: str, hint: str = "") -> None:
        self.name, self.expected, self.actual, self.hint = name, expected, actual, hint
        message = f"{name}: expected {expected}, got {actual}."
        super().__init__(visible(f"{message} {hint}".rstrip()))  # parts of it may come from a file


class InvalidArgumentError(MPCOfflineError, ValueError):
    """An argument has the wrong shape, range, type or unit."""


class InvalidDataError(MPCOfflineError, ValueError):
    """A data set holds something that must not be learned from (NaN, wrong spaces, actions out of bounds)."""


class UnknownIdError(MPCOfflineError, LookupError):
    """An environment, data set, solver or preset of this name does not exist."""

    @classmethod
    def of(cls, kind: str, given: object, known: Iterable[str], hint: str = "") -> UnknownIdError:
        """Builds the error with the nearest known names first.

        Args:
            kind: What the name stands for, e.g. ``"dataset id"``.
            given: The unknown name, or whatever was given in place of one.
            known: All names that would have been right.
            hint: What else to do next.
        """
        names = sorted(known)
        nearest = difflib.get_close_matches(given, names, n=3, cutoff=0.4) if isinstance(given, str) else []
        if nearest:
            hint = f"Did you mean {' or '.join(repr(name) for name in nearest)}? {hint}".rstrip()
        return cls(kind, expected=f"one of {', '.join(names) or '(none)'}", actual=f"{given!r:.200}", hint=hint)


class FileFormatError(MPCOfflineError, ValueError):
    """A file is damaged, is of another kind or another version, or holds what it must not hold."""


class StorageError(MPCOfflineError, OSError):
    """The disk or the file system refuses: it is full, read-only, or fails."""

    @classmethod
    def of(cls, path: object, error: OSError | RuntimeError) -> StorageError:
        """Wraps what the system said about a file.

        Args:
            path: The file or folder.
            error: The system's error.
        """
        limits = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        full = next((os.strerror(n) for n in limits if error.args[:1] == (n,) or os.strerror(n) in str(error)), None)
        hint = "Free some space, then run it again: what was written before is intact." if full else ""
        return cls(f"file {path}", expected="to be written", actual=full or str(error), hint=hint)
