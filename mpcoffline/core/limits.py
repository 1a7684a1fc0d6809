"""How large things in files may be: one table, asked before anything in a file is believed.

A file says how large its contents are; a small file can say so of contents that no machine holds. Each reader compares
with these limits before it allocates, and refuses by a :class:`~mpcoffline.FileFormatError`. What can be written can
be read: the same limits hold where objects are made.
"""

from __future__ import annotations

from .errors import FileFormatError, InvalidArgumentError

# JSON documents. One of a model of EXPRESSION_NODES operations is as large as this.
JSON_BYTES = 32 << 20
JSON_CONTAINERS = 1_200_000  # lists and objects, of which an empty one takes 30 times as much memory as text
JSON_TEXTS = 1_400_000
JSON_VALUES = 6_000_000

# Archives: the arrays may be ARRAY_BYTES in all, or so many times the file; random weights are smaller than the file.
ARCHIVE_BYTES = 1 << 30
ARRAY_BYTES = 64 << 20
ARRAY_RATIO = 8
ARRAYS = 10_000
DIRECTORY_BYTES = 2 << 20  # the list of a zip's members

# Models: what is larger is neither compiled nor solved in any reasonable time.
STATES = 1_000
INPUTS = 1_000
PARAMETERS = 200_000
EXPRESSION_NODES = 1_000_000
HORIZON = 10_000
PLAN_NUMBERS = 1_000_000  # horizon times states and inputs; 64 input sequences are tried

# Of what is compiled: a compiler takes its five minutes for half of this.
COMPILED_NODES = 100_000  # operations of model and costs
COMPILED_PRODUCTS = 1_000_000  # of the model's derivatives with the value function's, a step of the Riccati recursion

# Logs: what a column is called.
HEADER = 200

# Solvers.
ITERATIONS = 100_000
THREADS = 1_024
CACHED = 10_000


def check_limit(
    name: str,
    what: str,
    found: int,
    limit: int,
    *,
    hint: str = "",
    error: type[FileFormatError | InvalidArgumentError] = FileFormatError,
) -> None:
    """Refuses what a file says of itself where it is more than the limit.

    Args:
        name: The file, or the thing in it.
        what: What is counted, e.g. ``"bytes of JSON"``.
        found: How many there are, or are said to be.
        limit: How many there may be.
        hint: What to do next.
        error: What to raise; :class:`InvalidArgumentError` where it is no file that says so.

    Raises:
        FileFormatError: Where there are more.
    """
    if found > limit:
        shown = str(found) if found < 10**18 else "more than 10^18"  # a number of a file may have thousands of digits
        raise error(name, expected=f"at most {limit} {what}", actual=shown, hint=hint)


# Data sets: what is read of Minari's folders, of packed files and of table caches.
METADATA_BYTES = 4 << 20  # of metadata.json; the bounds of a space of images take half a megabyte
MANIFEST_BYTES = 1 << 20  # of SHA256SUMS
TABLE_META_BYTES = 16 << 20  # of a cached table's table.json: a terabyte of rows has that many checksums
SPACE_ELEMENTS = 1_000_000  # of a space: the numbers of its bounds
SPACE_DEPTH = 16  # of spaces within spaces
EPISODE_BYTES = 64  # of an HDF5 file, at least, for each episode that is declared
LINK_BYTES = 16  # of an HDF5 file, at least, for each member of a group
GROUP_DEPTH = 16  # of groups within groups of an HDF5 file
EXPANSION = 100  # bytes of all arrays for each byte of their file, beyond the allowance: measured data reach 20
EXPANSION_ALLOWANCE = 64 << 20  # bytes
FOLDER_ENTRIES = 1_000_000  # files and folders of a data set
HOLES = 1000  # bytes that a file claims for each one that it occupies on the disk
