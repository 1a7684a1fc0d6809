"""Tables from Parquet files: one of a disk, or many on any file system that fsspec knows."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError, StorageError

from .numbers import checked_episode_ids, floats
from .transitions import TransitionTable

if TYPE_CHECKING:
    import polars

_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]*)(::|://)", re.IGNORECASE)
_OF_POLARS = ("s3", "s3a", "gs", "gcs", "az", "azure", "abfs", "abfss", "adl", "http", "https", "hf")


def read_parquet(
    path: str | PathLike[str],
    *,
    observations: Sequence[str],
    actions: Sequence[str],
    cost: str,
    episode: str | None = None,
    terminated: str | None = None,
) -> TransitionTable:
    """A table from a Parquet file that has a row for each step, in the order of time.

    s+ is the s of the next row of the same episode; the last row of an episode, after which nothing is known, is left
    out. For logs as historians write them (times, units, gaps) use :meth:`mpcoffline.Plant.read` instead.

    Args:
        path: The file, or an address that ``polars.read_parquet`` takes, or ``fsspec.open``.
        observations: Columns of s.
        actions: Columns of a.
        cost: Column of L(s, a).
        episode: Column of whole numbers, of which each tells an episode; without, all rows are one.
        terminated: Column that is true where the episode terminated in s+; without, nothing terminated.

    Raises:
        InvalidArgumentError: If polars is not installed, or what the address needs.
        InvalidDataError: For columns that are not there, or numbers that a table refuses.
        StorageError: If it cannot be read.
    """
    name = str(path)
    frame = _frame(name, [*observations, *actions, cost, *(each for each in (episode, terminated) if each is not None)])

    def numbers(columns: Iterable[str]) -> NDArray[Any]:
        found = [floats(name, column, frame[column].to_numpy(), 1) for column in columns]
        return np.stack(found, axis=1)

    s, n = numbers(observations), len(frame)
    ids = np.zeros(n, dtype=np.int64) if episode is None else frame[episode].to_numpy()
    ids = checked_episode_ids(name, ids, n)
    going = np.flatnonzero(ids[1:] == ids[:-1])
    ended = np.zeros(n, dtype=bool) if terminated is None else frame[terminated].to_numpy()
    table = TransitionTable.from_arrays(
        s[going], numbers(actions)[going], numbers([cost])[going, 0], s[going + 1], ended[going], ids[going], name=name
    )
    table.names = (*observations, *actions)
    return table


def parquet_sources(paths: str | PathLike[str], **columns: Any) -> list[Callable[[], TransitionTable]]:
    """What reads Parquet files, a function each: sources for :func:`~mpcoffline.datasets.write_shards`.

    Example:
        >>> sources = parquet_sources("s3://plant/2026-*.parquet", observations=["h"], actions=["valve"], cost="cost")

    Args:
        paths: A pattern as ``"runs/*.parquet"``, or of a file system that fsspec knows, as ``"s3://plant/*.parquet"``
            or ``"sftp://host/runs/*.parquet"``. Files come in the order of their names.
        **columns: As of :func:`read_parquet`.

    Raises:
        InvalidArgumentError: If fsspec does not know the file system, or what it needs is not installed.
        StorageError: If nobody can be asked, or no file is there.
    """
    with _asking(str(paths)):
        import fsspec

        files, address = fsspec.open_files(str(paths), "rb"), _ADDRESS.match(str(paths))
        names = [file.path if address is None else file.full_name for file in files]
    if not names:
        raise StorageError(f"files {paths}", expected="one at least", actual="none")
    _, chained, within = str(paths).partition("::")  # as of files in an archive
    return [partial(read_parquet, f"{name}{chained}{within}", **columns) for name in sorted(names)]


def _frame(name: str, columns: list[str]) -> polars.DataFrame:
    """Some columns of a file."""
    try:
        import polars
    except ImportError as error:
        hint = 'pip install "mpcoffline[logs]"'
        raise InvalidArgumentError("read_parquet", expected="polars", actual="not installed", hint=hint) from error
    with ExitStack() as ending:
        source = _source(name, ending)
        try:
            return polars.read_parquet(source, columns=list(dict.fromkeys(columns)))
        except polars.exceptions.ColumnNotFoundError as error:
            expected, actual = f"columns {', '.join(columns)}", str(error).splitlines()[0]
            raise InvalidDataError(name, expected=expected, actual=actual) from error
        except (OSError, polars.exceptions.PolarsError) as error:
            expected, actual = "to be read as Parquet", str(error).splitlines()[0]
            raise StorageError(f"file {name}", expected=expected, actual=actual) from error


def _source(name: str, ending: ExitStack) -> Any:
    """What polars takes: the name of what it finds by itself, else a file of fsspec, closed in the end."""
    address = _ADDRESS.match(name)
    if address is None or (address[2] == "://" and address[1].lower() in _OF_POLARS):
        return name
    with _asking(name):
        import fsspec

        return ending.enter_context(fsspec.open(name, "rb"))


@contextmanager
def _asking(name: str) -> Iterator[None]:
    """Names a file system that does not answer; each has errors of its own."""
    try:
        yield
    except (ImportError, ValueError) as error:  # of its package; of one that fsspec does not know
        expected, hint = "a file system that can be read here", "fsspec's documentation says what each one needs."
        raise InvalidArgumentError(f"address {name}", expected=expected, actual=str(error), hint=hint) from error
    except Exception as error:
        actual = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise StorageError(f"file {name}", expected="to be read", actual=actual) from error
