"""From the episodes of a Minari data set to packed rows, block by block."""

from __future__ import annotations

import functools
import shutil
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import FileFormatError, InvalidDataError, StorageError
from mpcoffline.datasets.store.opening import DATA_FILE, check_stored

from .cache import TableFile, cached_table, content_key, scratch_table, table_folder
from .centring import Centring, Digits
from .hdf5_episodes import EpisodeColumns, read_episodes
from .math import CHUNK
from .numbers import check_finite

if TYPE_CHECKING:
    from minari import MinariDataset

BLOCK_BYTES = 1 << 24
CACHED_ROWS = 500_000

Rows = tuple[NDArray[np.float32], NDArray[np.int64]]


class BuiltRows(NamedTuple):
    """A table in memory: packed rows ``(n, 2 ny + nu + 2)``, the episode of each ``(n,)``, sizes and centring."""

    rows: NDArray[np.float32]
    episode_ids: NDArray[np.int64]
    ny: int
    nu: int
    centring: Centring


def joined(
    tables: Iterable[tuple[NDArray[np.float32], NDArray[np.int64], Centring]], centring: Centring
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.int64]]]:
    """The rows of several tables, packed anew, block by block; episodes are numbered from 0, each table's apart.

    Args:
        tables: Of each its packed rows ``(n, 2 ny + nu + 2)``, their episodes ``(n,)``, and what it was packed without.
        centring: What the result is packed without.
    """
    offset = 0
    for rows, ids, old in tables:
        episodes, numbers = np.unique(ids, return_inverse=True)
        for part in (slice(i, i + CHUNK) for i in range(0, len(rows), CHUNK)):
            yield centring.repacked(rows[part], old), numbers[part] + offset
        offset += len(episodes)


def read_minari(dataset: MinariDataset, name: str, memory: int, cache: Path | None) -> BuiltRows | TableFile:
    """The packed rows of a data set, in memory or, if larger than ``memory`` bytes, in a file.

    From :data:`CACHED_ROWS` on they come from the cache (None: the user's), where it holds them intact, and are put
    there otherwise.

    Raises:
        InvalidDataError: For data that must not be learned from.
        FileFormatError: For a damaged file.
        StorageError: Where the cache cannot be written.
    """
    ny, nu = (
        _size(name, kind, space)
        for kind, space in (("observation", dataset.observation_space), ("action", dataset.action_space))
    )
    check_stored(Path(dataset.spec.data_path).parent)
    steps = int(dataset.total_steps)
    if steps == 0:
        raise InvalidDataError(name, expected="at least one episode", actual="none")
    mapped = steps * 4 * (2 * ny + nu + 2) > memory
    path = _hdf5_file(dataset)
    source = _Source(dataset, name, ny, nu)
    if mapped and path is None:
        file = scratch_table(ny, nu, source.blocks(), table_folder(cache))
        again = source.again()
        return file if again is None else scratch_table(ny, nu, again[0], table_folder(cache), again[1])
    if path is not None and (mapped or steps >= CACHED_ROWS):
        cache = table_folder(cache)
        try:
            file = _cached(source, path, cache)
            if mapped:
                return file
            return _loaded(file) or _in_memory(_cached(source, path, cache))
        except StorageError as error:
            if mapped:
                raise
            warnings.warn(f"The table is not kept in the cache. {error}", stacklevel=4)
    rows, ids = _assemble(name, source.blocks(), steps, 2 * ny + nu + 2)
    again = source.again()
    if again is None:
        return BuiltRows(rows, ids, ny, nu, Centring.none(ny, nu))
    return BuiltRows(*_assemble(name, again[0], steps, 2 * ny + nu + 2), ny, nu, again[1])


class _Source:
    """The packed rows of a data set, as they are, and then perhaps again, centred."""

    def __init__(self, dataset: MinariDataset, name: str, ny: int, nu: int) -> None:
        self.dataset, self.ny, self.nu = dataset, ny, nu
        self._name, self._digits = name, Digits(ny, nu)

    def blocks(self) -> Iterator[Rows]:
        self._digits = Digits(self.ny, self.nu)
        return row_blocks(self.dataset, self._name, self.ny, self.nu, digits=self._digits)

    def again(self) -> tuple[Iterator[Rows], Centring] | None:
        """The rows centred, where those that were read lost digits."""
        centring = self._digits.centring
        if centring.is_none:
            return None
        return row_blocks(self.dataset, self._name, self.ny, self.nu, centring=centring), centring


def _cached(source: _Source, path: Path, cache: Path) -> TableFile:
    indices = np.asarray(source.dataset.episode_indices)
    whole = len(indices) == source.dataset.storage.total_episodes and bool((np.diff(indices) == 1).all())
    key = content_key(path, None if whole else indices, cache)
    return cached_table(key, source.ny, source.nu, source.blocks(), cache, source.again)


def _in_memory(file: TableFile) -> BuiltRows:
    return BuiltRows(*file.load(), file.ny, file.nu, file.centring)


def _loaded(file: TableFile) -> BuiltRows | None:
    """The table in memory; None, and the file is gone, where it is damaged."""
    try:
        return _in_memory(file)
    except FileFormatError as error:
        warnings.warn(f"{error} It is built again.", stacklevel=5)
        shutil.rmtree(file.folder, ignore_errors=True)
        return None


def _size(name: str, kind: str, space: Any) -> int:
    shape = tuple(space.shape or ())
    if len(shape) != 1:
        raise InvalidDataError(f"{name}: {kind} space", expected="a Box of shape (n,)", actual=str(space))
    return int(shape[0])


def _hdf5_file(dataset: MinariDataset) -> Path | None:
    path = Path(dataset.spec.data_path) / DATA_FILE
    return path if path.is_file() else None


def _assemble(
    name: str, blocks: Iterable[Rows], steps: int, width: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """All blocks in memory, where there are as many rows as the metadata say."""
    rows, ids, filled = np.empty((steps, width), np.float32), np.empty(steps, np.int64), 0
    for block, episodes in blocks:
        if filled + len(block) <= steps:
            rows[filled : filled + len(block)], ids[filled : filled + len(block)] = block, episodes
        filled += len(block)
    if filled != steps:
        raise InvalidDataError(
            name,
            expected=f"{steps} steps, as its metadata say",
            actual=str(filled),
            hint="Try `mpcoffline datasets repair`.",
        )
    return rows, ids


def row_blocks(
    dataset: MinariDataset,
    name: str,
    ny: int,
    nu: int,
    block_bytes: int = BLOCK_BYTES,
    *,
    centring: Centring | None = None,
    digits: Digits | None = None,
) -> Iterator[Rows]:
    """Yields the packed rows ``(B, 2 ny + nu + 2)`` of a data set and their episodes ``(B,)``, in its order.

    The arrays are used again for the next block. Their size, ``block_bytes`` at most, bounds the memory needed (thrice
    that where the data are of more digits than float32 has).

    Args:
        dataset: The data set.
        name: What error messages call it.
        ny: Number of observation coordinates.
        nu: Number of action coordinates.
        block_bytes: Size of a block.
        centring: What the rows are packed without; nothing by default.
        digits: Is shown what packing does to the numbers.

    Raises:
        InvalidDataError: For episodes that do not hold one observation more than actions, other shapes,
            NaN or inf, or terminations that are not boolean.
        FileFormatError: For a damaged file.
    """
    width = 2 * ny + nu + 2
    size = max(1, block_bytes // (4 * width + 8))
    rows, ids = np.empty((size, width), dtype=np.float32), np.empty(size, dtype=np.int64)
    exact: NDArray[np.float64] | None = None  # a second copy, only where float32 may lose digits
    costs = np.empty(size)
    filled, before = 0, 0

    def block() -> Rows:
        if exact is not None:
            with np.errstate(over="ignore"):
                rows[:filled] = exact[:filled]
        check_finite(name, rows[:filled], ny, nu, ids[:filled], before)
        if exact is not None and digits is not None:
            digits.add(exact[:filled], rows[:filled])
        elif digits is not None:
            digits.add_costs(costs[:filled], rows[:filled, ny + nu])
        if exact is not None and centring is not None:
            rows[:filled] = centring.packed(exact[:filled])
        return rows[:filled], ids[:filled]

    for episode_id, columns in _episodes(dataset):
        where = f"{name}, episode {episode_id}"
        _check_shapes(where, columns, ny, nu)
        if exact is None and (centring is not None or _is_wide(columns.observations.dtype, columns.actions.dtype)):
            exact = np.empty((size, width))
            exact[:filled] = rows[:filled]
            exact[:filled, ny + nu] = costs[:filled]
        steps, done = len(columns.actions), 0
        while done < steps:
            count = min(steps - done, size - filled)
            if filled == 0:
                before = done
            part = slice(filled, filled + count)
            _pack((rows if exact is None else exact)[part], columns, done, ny, nu)
            _negated(columns.rewards[done : done + count], costs[part])
            ids[part] = episode_id
            filled, done = filled + count, done + count
            if filled == size:
                yield block()
                filled = 0
    if filled:
        yield block()


@functools.cache
def _is_wide(*dtypes: np.dtype[Any]) -> bool:
    """Whether numbers of some of these types may have more digits than float32 has."""
    return not all(np.can_cast(dtype, np.float32) for dtype in dtypes)


def _episodes(dataset: MinariDataset) -> Iterator[tuple[int, EpisodeColumns]]:
    path = _hdf5_file(dataset)
    if path is not None:
        yield from read_episodes(path, (int(i) for i in dataset.episode_indices))
        return
    for episode in dataset.iterate_episodes():  # another storage format
        parts = (episode.observations, episode.actions, episode.rewards, episode.terminations)
        yield int(episode.id), EpisodeColumns(*(np.asarray(part) for part in parts))


def _pack(rows: NDArray[np.floating[Any]], columns: EpisodeColumns, start: int, ny: int, nu: int) -> None:
    """Writes the steps from ``start`` on into ``rows``; the one place where a reward becomes a cost."""
    end, after = start + len(rows), ny + nu + 1
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes inf, and is refused
        rows[:, :ny] = columns.observations[start:end]
        rows[:, ny : ny + nu] = columns.actions[start:end]
        _negated(columns.rewards[start:end], rows[:, ny + nu])
        rows[:, after : after + ny] = columns.observations[start + 1 : end + 1]
        rows[:, after + ny] = columns.terminations[start:end]


def _negated(rewards: NDArray[Any], costs: NDArray[np.floating[Any]]) -> None:
    """Writes minus the rewards, of any type of number: unsigned ones and booleans have no minus of their own."""
    np.negative(rewards, out=costs, dtype=costs.dtype, casting="same_kind")


def _check_shapes(where: str, columns: EpisodeColumns, ny: int, nu: int) -> None:
    steps = len(columns.actions)
    wanted: dict[str, tuple[int, ...]] = {
        "observations": (steps + 1, ny),
        "actions": (steps, nu),
        "rewards": (steps,),
        "terminations": (steps,),
    }
    for column, shape in wanted.items():
        found: NDArray[Any] = getattr(columns, column)
        if found.shape != shape or found.dtype.kind not in "fiub":
            raise InvalidDataError(
                f"{where}: {column}",
                expected=f"the length that belongs to {steps} actions, numbers of shape {shape}",
                actual=f"{found.dtype} of shape {found.shape}",
            )
    if columns.terminations.dtype != np.bool_ and not np.isin(columns.terminations, (0, 1)).all():
        raise InvalidDataError(
            f"{where}: terminations", expected="booleans", actual=f"values such as {columns.terminations.max()}"
        )
