"""Writes shards: from tables, Minari data sets and other files, one after another, in the memory of one of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.atomic import publish
from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError, MPCOfflineError, StorageError
from mpcoffline.core.ranks import Ranks
from mpcoffline.core.scratch import scratch_folder

from .cache import TableFile, write_table
from .math import CHUNK
from .shard_folders import NAMES
from .transitions import TransitionTable

if TYPE_CHECKING:
    from minari import MinariDataset

SHARD_ROWS = 1 << 26  # some gigabytes: a process may have about a thousand files open, and has three of each shard


def write_shards(
    folder: str | PathLike[str],
    sources: Iterable[TransitionTable | MinariDataset | str | Callable[[], TransitionTable | MinariDataset | str]],
    *,
    rows: int = SHARD_ROWS,
    ranks: Ranks | None = None,
) -> list[Path]:
    """Writes transitions as packed shards, of which a process of a job can read its part.

    Each source becomes one shard, or several where it has more rows. A shard appears complete or not at all, and one
    that is there already stays: what was interrupted goes on. In a program that ``torchrun`` starts, processes take
    the sources in turns.

    Example:
        >>> write_shards("shards/", ["mine/plant-a-v0", "mine/plant-b-v0"])
        >>> write_shards("shards/", parquet_sources("s3://plant/2026-*.parquet", **columns))

    Args:
        folder: Where to; made if it is not there.
        sources: Tables, Minari data sets or their ids, all with the same columns; or functions that give one, which
            are called one after the other, each by the process that packs what it gives.
        rows: The most rows of a shard.
        ranks: The processes of this job; those that ``torchrun`` started by default.

    Returns:
        The shards, in their order, of all processes.

    Raises:
        InvalidDataError: For a source with other columns than the first one, or what a table refuses.
        StorageError: If it cannot be written; what was finished is there.
    """
    check_integers(1, rows=rows)
    target, ranks = Path(folder), Ranks.current() if ranks is None else ranks
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError.of(target, error) from error
    first: tuple[int, int, tuple[str, ...]] | None = None
    for number, source in enumerate(sources):
        if number % ranks.size != ranks.rank:
            continue
        table = TransitionTable.of(source() if callable(source) else source)
        columns = (table.ny, table.nu, table.names)
        first = first or columns
        if columns != first:
            expected, actual = (f"{ny} observations, {nu} actions, names {names}" for ny, nu, names in (first, columns))
            raise InvalidDataError(f"{table.name}: columns", expected=f"{expected}, as before", actual=actual)
        for part, some in enumerate(_parts(table, rows)):
            _write(target / f"{number:06d}-{part:04d}", table, some)
    ranks.largest([0.0])  # nobody goes on before all are there
    return sorted(path for path in target.iterdir() if path.is_dir() and not path.name.startswith("."))


def _parts(table: TransitionTable, rows: int) -> Iterator[slice]:
    """So many rows of a table at most, one after another; cut between two episodes, where these are not longer."""
    start, firsts = 0, np.sort(table.episodes.firsts)
    while start < len(table):
        stop = min(start + rows, len(table))
        if stop < len(table):
            between = int(firsts[np.searchsorted(firsts, stop, side="right") - 1])
            stop = between if between > start else stop
        yield slice(start, stop)
        start = stop


def _write(target: Path, table: TransitionTable, part: slice) -> None:
    """Writes some rows of a table as a shard; what is there already stays where it has as many."""
    if target.exists():
        found = TableFile(target)
        sizes = (found.ny, found.nu, len(found))
        if sizes != (table.ny, table.nu, part.stop - part.start):
            raise InvalidArgumentError(
                f"shard {target}",
                expected=f"{part.stop - part.start} rows of {table.name}, as of a call that was interrupted",
                actual=f"{sizes[2]} rows with {sizes[0]} observations and {sizes[1]} actions",
                hint="Name an empty folder.",
            )
        return
    parts = (slice(i, min(i + CHUNK, part.stop)) for i in range(part.start, part.stop, CHUNK))
    try:
        with scratch_folder(target.parent) as building:
            blocks = ((table.rows[some], table.episode_ids[some]) for some in parts)
            write_table(building, table.ny, table.nu, blocks, table.centring)
            if table.names:
                (building / NAMES).write_text(json.dumps(table.names), encoding="utf-8")
            publish(building, target, overwrite=False)
    except OSError as error:
        raise error if isinstance(error, MPCOfflineError) else StorageError.of(target, error) from error
