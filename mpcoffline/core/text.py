"""Names that may stand in files, and text made safe for where it goes: one function for each place."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import lru_cache

import numpy as np

from .errors import FileFormatError, InvalidArgumentError, visible

__all__ = [
    "LONGEST",
    "as_name",
    "c_comment",
    "c_identifiers",
    "check_name",
    "check_unit",
    "figure",
    "listed",
    "markdown",
    "markdown_code",
    "visible",
]

LONGEST = 100  # characters of a name or a unit
_SMALLEST, _LARGEST = 1e-4, 1e7  # of a number that needs no exponent
_SIGNS = frozenset(" _-.,^*/()[]+%°µ·0123456789⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻")
_BLANK_LETTERS = frozenset("\u115f\u1160\u3164\uffa0")  # letters by their class, of which nothing is seen
_ALPHABET = "letters, digits, blanks and _ - . , ^ * / ( ) [ ] + % ° µ · ² ³"
# Of C99 to C23 and C++ to C++20.
_KEYWORD = re.compile(
    "alignas|alignof|and|and_eq|asm|atomic_cancel|atomic_commit|atomic_noexcept|auto|bitand|"
    "bitor|bool|break|case|catch|char|char8_t|char16_t|char32_t|class|co_await|co_return|"
    "co_yield|compl|concept|const|const_cast|consteval|constexpr|constinit|continue|decltype|"
    "default|delete|do|double|dynamic_cast|else|enum|explicit|export|extern|false|float|for|"
    "friend|goto|if|inline|int|long|mutable|namespace|new|noexcept|not|not_eq|nullptr|"
    "operator|or|or_eq|private|protected|public|register|reinterpret_cast|requires|restrict|"
    "return|short|signed|sizeof|static|static_assert|static_cast|struct|switch|synchronized|"
    "template|this|thread_local|throw|true|try|typedef|typeid|typename|typeof|typeof_unqual|"
    "union|unsigned|using|virtual|void|volatile|wchar_t|while|xor|xor_eq"
)


def check_name(
    what: str,
    name: object,
    *,
    longest: int = LONGEST,
    error: type[InvalidArgumentError | FileFormatError] = InvalidArgumentError,
) -> str:
    """A name of the alphabet of names: letters of any script, digits, blanks and ``_-.,^*/()[]+%°µ·²³``.

    Args:
        what: What it names, e.g. ``"parameter name"``.
        name: The name.
        longest: How many characters it may have.
        error: What to raise; :class:`FileFormatError` for one out of a file.

    Returns:
        The name.

    Raises:
        InvalidArgumentError: For what is no text, blank, too long, or of other characters.
    """
    if not isinstance(name, str):
        raise error(what, expected="a text", actual=repr(name)[:LONGEST])
    if not name.strip() or len(name) > longest:
        shown = repr(name[:LONGEST]) + ("..." if len(name) > LONGEST else "")
        raise error(what, expected=f"from 1 to {longest} characters, not all blank", actual=f"{len(name)}: {shown}")
    if foreign := _foreign(name):
        raise error(what, expected=_ALPHABET, actual=f"{name!r} with {foreign!r}")
    return name


def check_unit(
    what: str, unit: object, *, error: type[InvalidArgumentError | FileFormatError] = InvalidArgumentError
) -> str:
    """A unit, of the alphabet of names; or nothing. As :func:`check_name`."""
    return "" if unit == "" else check_name(what, unit, error=error)


def as_name(text: str) -> str:
    """A text as a name that :func:`check_name` takes: ``_`` for characters that no name has, and not too long."""
    plain = "".join("_" if _foreign(c) else c for c in text.strip())[:LONGEST]
    return plain.strip() or "_"


@lru_cache(maxsize=4096)
def _foreign(name: str) -> str:
    """The first character that is not of the alphabet."""
    return next((c for c in name if not (c in _SIGNS or (c.isalpha() and c not in _BLANK_LETTERS))), "")


def c_identifiers(names: Iterable[str]) -> dict[str, str]:
    """An identifier of C and C++ for each name, no two alike.

    Names that are identifiers but for dots keep their letters (``model.m`` is ``model_m``); of others, what has a plain
    form takes it (``m²`` is ``m2``), any other letter its number, and what is left becomes ``_``. Where that is taken,
    a number follows.

    Args:
        names: Names of the alphabet of :func:`check_name`, all different.
    """
    found: dict[str, str] = {}
    taken: set[str] = set()
    alike: Counter[str] = Counter()  # where the search goes on, which must not begin anew for each of thousands
    for name in sorted(names, key=lambda name: re.fullmatch(r"[A-Za-z0-9_.]+", name) is None):  # in order otherwise
        plain = "".join(c if c.isascii() else _spelled(c) for c in name)
        stem = re.sub(r"_+", "_", re.sub(r"\W", "_", plain, flags=re.ASCII)).strip("_") or "p"
        if not stem[0].isalpha() or _KEYWORD.fullmatch(stem):
            stem = f"p_{stem}"
        identifier = stem
        while identifier in taken:
            alike[stem] += 1
            identifier = f"{stem}_{alike[stem] + 1}"
        taken.add(identifier)
        found[name] = identifier
    return found


def _spelled(character: str) -> str:
    """A character without ASCII form in letters and digits."""
    plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
    return plain if plain.isalnum() else f"u{ord(character):04x}" if character.isalpha() else "_"


def listed(names: Sequence[str], most: int = 6, *, joint: str = ", ") -> str:
    """Names in a sentence, the first few of many: ``"a, b, c and 37 more"``.

    Args:
        names: The names.
        most: How many are named.
        joint: What stands between them.
    """
    told = joint.join(names[:most])
    return f"{told} and {len(names) - most} more" if len(names) > most else told


def figure(value: float, digits: int = 3, *, sign: bool = False) -> str:
    """A number for people, with some significant digits: ``1060`` rather than ``1.06e+03``.

    Args:
        value: The number.
        digits: How many of its digits count.
        sign: Whether one that is not negative has a plus.
    """
    shown = f"{value:{'+' if sign else ''}.{digits}g}"
    if "e" not in shown or not _SMALLEST <= abs(value) < _LARGEST:
        return shown
    return np.format_float_positional(float(shown), trim="-", sign=sign)


def c_comment(text: str) -> str:
    """Text inside a comment of C that neither ends it, nor begins another, nor continues on the next line."""
    line = visible(text.replace("\n", " ")).replace("\\", "|")  # a backslash, and "??/", may join lines
    return re.sub(r"\*(?=/)|/(?=\*)|\?(?=\?)", r"\g<0> ", line)


def markdown(text: str) -> str:
    """Text in a line of Markdown that stays text: no markup, no HTML, no link, no other cell of a table."""
    line = " ".join(visible(text).split("\n"))
    return re.sub(r"[\\`*\[\]<>#|&~$]|(?<!\w)_|_(?!\w)", r"\\\g<0>", line)


def markdown_code(text: str) -> str:
    """Text as a piece of code in Markdown."""
    return "`" + " ".join(visible(text).split("\n")).replace("`", "'").replace("|", "\\|") + "`"
