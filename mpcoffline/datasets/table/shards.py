"""Tables larger than a machine: packed shards, of which each process of a job reads its own rows.

All rows, in the order of the shards, are cut into so many *lanes*; a lane belongs to one process. What is computed is
computed by lane and then put together in an order, or by sums, that do not know how many processes there are: the
lanes decide the result, not who works on them.
"""

from __future__ import annotations

import copy
import errno
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, InvalidDataError, StorageError
from mpcoffline.core.ranks import Ranks

from .cache import TableFile
from .centring import Centring
from .math import Columns, Moments, TableStatistics, merged_moments, split
from .numbers import check_sizes
from .shard_folders import folders_of, names_of
from .transitions import TransitionTable

if TYPE_CHECKING:
    import torch

#: Rows that all processes see, from all over the data.
EXCERPT_ROWS = 200_000
POOL_BYTES = 32 << 20  # of a lane's rows that are mixed; the same on every machine, as it decides what is drawn
_STRETCH = 1_000  # consecutive rows of an excerpt

#: From some rows to those that are learned from, perhaps with other columns.
Change = Callable[[TransitionTable], TransitionTable]


class _Piece(NamedTuple):
    """Some rows of one block of one file."""

    file: int
    block: int
    start: int
    stop: int


class ShardedTable:
    """Transitions in packed shards, read by the processes of a job lane by lane, in bounded memory.

    Example:
        >>> table = ShardedTable.open("shards/")  # in a program that torchrun starts, or by itself
        >>> learner.fit(table, checkpoint="fit.ckpt")

    Args:
        files: The shards, in their order.
        names: Names and units of the columns, observations first; none where nobody said.
        lanes: Into how many parts the rows are cut.
        ranks: The processes of this job.
        name: What error messages call it.

    Attributes:
        ny: Number of observation coordinates.
        nu: Number of action coordinates.
        centring: What its rows are packed without, where shards differ that of all of them.
        lanes: As given.
        ranks: As given.
        name: As given.
        names: As given.
    """

    def __init__(
        self, files: Sequence[TableFile], names: tuple[str, ...], lanes: int, ranks: Ranks, name: str = "shards"
    ) -> None:
        self._files, self.names, self.lanes, self.ranks, self.name = list(files), names, lanes, ranks, name
        lengths = [len(file) for file in files]
        self._ends, self._block_ends = np.cumsum(lengths), np.cumsum([file.n_blocks for file in files])
        self._raw_centring = self.centring = Centring.common([file.centring for file in files], lengths)
        self.ny, self.nu = files[0].ny, files[0].nu
        self._changes: tuple[Change, ...] = ()
        self._statistics: TableStatistics | None = None

    def __len__(self) -> int:
        """Number of rows in the shards, before what :meth:`mapped` leaves out."""
        return int(self._ends[-1])

    def __repr__(self) -> str:
        parts = f"{len(self._files)} shards, {self.lanes} lanes, {self.ranks.size} processes"
        return f"{type(self).__name__}({self.name!r}, n={len(self)}, ny={self.ny}, nu={self.nu}; {parts})"

    @classmethod
    def open(
        cls,
        shards: str | PathLike[str] | Sequence[str | PathLike[str]],
        *,
        lanes: int = 8,
        ranks: Ranks | None = None,
    ) -> ShardedTable:
        """Opens what :func:`~mpcoffline.datasets.write_shards` wrote.

        Every process opens all shards, which reads what describes them; rows are read of its own lanes alone.

        Args:
            shards: The folder with the shards, or the folders of some, in their order.
            lanes: Into how many parts the rows are cut: at least as many as processes, and better a multiple of
                their number. They decide what is learned, as a seed does; the number of processes does not.
            ranks: The processes of this job; those that ``torchrun`` started by default.

        Raises:
            InvalidArgumentError: For no shard at all, or fewer lanes than processes.
            InvalidDataError: For shards with other columns than the first one, or fewer rows than lanes.
            FileFormatError: For a damaged shard.
            StorageError: For more shards than a process may have files open.
            MPCOfflineError: If not all processes come.
        """
        check_integers(1, lanes=lanes)
        ranks = Ranks.current() if ranks is None else ranks
        if lanes < ranks.size:
            hint = "Start fewer processes, or open with more lanes; those are another fit, as another seed is."
            raise InvalidArgumentError("lanes", expected=f"{ranks.size} or more", actual=str(lanes), hint=hint)
        folders = folders_of(shards)
        files, names = [_opened(folder, len(folders)) for folder in folders], [names_of(folder) for folder in folders]
        for folder, file, own in zip(folders, files, names, strict=True):
            sizes = {"observations": (file.ny, files[0].ny), "actions": (file.nu, files[0].nu)}
            check_sizes(f"shard {folder}", sizes, f"shard {folders[0]}")
            if own != names[0]:
                raise InvalidDataError(
                    f"shard {folder}: columns",
                    expected=f"those of shard {folders[0]}, {', '.join(names[0]) or 'without names'}",
                    actual=", ".join(own) or "without names",
                    hint="Write both with the same columns in the same order.",
                )
        where = shards if isinstance(shards, str | PathLike) else folders[0].parent
        table = cls(files, names[0], lanes, ranks, f"shards {where}")
        if len(table) < lanes:
            raise InvalidDataError(table.name, expected=f"a row for each of {lanes} lanes", actual=f"{len(table)} rows")
        ranks.check_alike("shards", table.identity)
        return table

    @property
    def identity(self) -> bytes:
        """What decides the rows and how they are drawn, as a hash; not which process reads them."""
        described = [self.lanes, POOL_BYTES, *(file.identity for file in self._files)]
        return hashlib.sha256(json.dumps(described).encode()).digest()

    @property
    def own_lanes(self) -> range:
        """The lanes of this process."""
        return range(self.ranks.rank, self.lanes, self.ranks.size)

    def mapped(self, change: Change) -> ShardedTable:
        """The same shards with something done to their rows when they are read, a block of some thousands at a time.

        Args:
            change: From some consecutive rows to what is learned of them: rows left out, other columns.
        """
        other = copy.copy(self)
        other._changes, other._statistics = (*self._changes, change), None
        for lane in range(self.lanes):  # sizes and centring are those of any rows that it leaves
            for number in range(self._n_pieces(lane)):
                if (rows := other._rows(self._piece(lane, number))) is not None:
                    other.ny, other.nu, other.centring = rows.ny, rows.nu, rows.centring
                    return other
        raise other._empty(0)

    def columns(self, block: Any) -> Columns:
        """The five columns of a block of rows in units, as :meth:`~mpcoffline.TransitionTable.columns`."""
        return self.centring.columns(block)

    def batches(self, batch_size: int, seed: int) -> Iterator[list[tuple[float, torch.Tensor]]]:
        """Random minibatches, for ever: of each its part in each lane of this process.

        A lane's blocks come in random order, as many as its pool of 32 MB holds, which is then shuffled.

        Args:
            batch_size: Rows a minibatch, in all lanes together.
            seed: Seed of the draw.

        Yields:
            For each own lane its share of the minibatch, and its rows ``(B', 2 ny + nu + 2)``, float32.

        Raises:
            InvalidArgumentError: For fewer rows than lanes.
            InvalidDataError: If nothing of a lane is learned from.
            FileFormatError: For a block that is not what was written.
        """
        if batch_size < self.lanes:
            expected = f"{self.lanes} or more, a row for each lane"
            raise InvalidArgumentError("batch_size", expected=expected, actual=str(batch_size))
        cuts = [lane * batch_size // self.lanes for lane in range(self.lanes + 1)]
        sizes = {lane: cuts[lane + 1] - cuts[lane] for lane in self.own_lanes}
        streams = {lane: self._stream(lane, size, seed) for lane, size in sizes.items()}
        while True:
            yield [(size / batch_size, next(streams[lane])) for lane, size in sizes.items()]

    def statistics(self) -> TableStatistics:
        """Mean, standard deviation and range of every column, in one pass of each process over its lanes."""
        if self._statistics is None:
            found = {lane: self._moments(lane) for lane in self.own_lanes}
            every = [self.ranks.shared(found.get(lane), lane % self.ranks.size) for lane in range(self.lanes)]
            merged = (row[None, :] for row in merged_moments(every))
            self._statistics = TableStatistics(
                *(Columns(*(column[0] for column in split(row, self.ny, self.nu))) for row in merged)
            )
        return self._statistics

    def check_fits(self, ny: int, nu: int, low: ArrayLike, high: ArrayLike) -> None:
        """Refuses another plant's data, and actions beyond the bounds ``(nu,)``; reads, and so checks, all rows once.

        Raises:
            InvalidDataError: Naming what differs.
            FileFormatError: For a damaged shard.
        """
        check_sizes(self.name, {"observations": (self.ny, ny), "actions": (self.nu, nu)})
        found = self.statistics()
        ends = (low, found.low.actions, 1.0, "above"), (high, found.high.actions, -1.0, "below")
        for bound, end, sign, word in ends:
            limit = np.broadcast_to(np.asarray(bound, dtype=np.float64), (nu,))
            size = np.where(np.isfinite(limit), np.abs(limit), 0.0)
            for i in np.flatnonzero(sign * (limit - end) > 1e-6 * size):
                raise InvalidDataError(
                    f"{self.name}: action {i}",
                    expected=f"values {word} the MPC's bound {limit[i]:g}",
                    actual=f"{end[i]:g}",
                    hint="Check the units, and that the MPC's bounds are those of the plant.",
                )

    def excerpt(self, rows: int = EXCERPT_ROWS, seed: int = 0) -> TransitionTable:
        """Some stretches of consecutive rows from all over the shards, the same in each process, in memory.

        Where episodes are shorter than a stretch, of which each has a thousand rows, it begins with one's first row.

        Args:
            rows: How many, about.
            seed: Seeds the choice.
        """
        check_integers(1, rows=rows)
        found = {lane: self._stretches(lane, -(-rows // self.lanes), seed) for lane in self.own_lanes}
        parts, numbers, offset = [], [], 0
        for lane in range(self.lanes):
            own = found.get(lane, (None, None))
            block, begun = (self.ranks.shared(part, lane % self.ranks.size) for part in own)
            parts.append(block)
            numbers.append(np.cumsum(begun) - 1 + offset)
            offset += int(begun.sum())
        ids = np.concatenate(numbers).astype(np.int64)
        table = TransitionTable(
            np.concatenate(parts), self.ny, self.nu, ids, self.name, centring=self._raw_centring, names=self.names
        )
        return table

    def _n_pieces(self, lane: int) -> int:
        """How many blocks a lane has a part in."""
        first, last = self._bounds(lane)
        return self._block_of(last - 1) - self._block_of(first) + 1

    def _bounds(self, lane: int) -> tuple[int, int]:
        """First row of a lane, and that after its last, in all shards."""
        return lane * len(self) // self.lanes, (lane + 1) * len(self) // self.lanes

    def _block_of(self, row: int) -> int:
        """The number, in all shards, of the block that a row is in."""
        file = int(np.searchsorted(self._ends, row, side="right"))
        within = row - int(self._ends[file] - len(self._files[file]))
        return int(self._block_ends[file]) - self._files[file].n_blocks + within // self._files[file].block_rows

    def _piece(self, lane: int, number: int) -> _Piece:
        """The rows that a lane has in the block of that number among its own."""
        (first, last), block = self._bounds(lane), self._block_of(self._bounds(lane)[0]) + number
        return self._within(first, last, block)

    def _within(self, first: int, last: int, block: int) -> _Piece:
        """The rows of a block of all shards that lie in a range of rows."""
        file = int(np.searchsorted(self._block_ends, block, side="right"))
        source = self._files[file]
        local = block - (int(self._block_ends[file]) - source.n_blocks)
        begin = int(self._ends[file]) - len(source) + local * source.block_rows
        count = min(source.block_rows, len(source) - local * source.block_rows)
        return _Piece(file, local, max(first - begin, 0), min(last - begin, count))

    def _raw_rows(self, piece: _Piece) -> TransitionTable:
        """Some rows as they are in their shard, packed as all are."""
        file = self._files[piece.file]
        rows = np.empty((file.block_rows, file.width), dtype=np.float32)
        file.read_block(piece.block, rows)
        at = piece.block * file.block_rows
        ids = np.asarray(file.episode_ids[at + piece.start : at + piece.stop])
        packed = self._raw_centring.repacked(rows[piece.start : piece.stop], file.centring)
        return TransitionTable(packed, file.ny, file.nu, ids, self.name, centring=self._raw_centring)

    def _rows(self, piece: _Piece) -> TransitionTable | None:
        """Some rows as they are learned from; None where none of them is."""
        rows = self._raw_rows(piece)
        for change in self._changes:
            rows = change(rows)
            if not len(rows):
                return None
        return rows

    def _stream(self, lane: int, size: int, seed: int) -> Iterator[torch.Tensor]:
        """Random rows of a lane, so many at a time."""
        import torch

        rng, n_pieces = np.random.default_rng([seed, lane]), self._n_pieces(lane)
        width = 2 * self.ny + self.nu + 2
        largest = max(file.block_rows for file in self._files)
        capacity = max(POOL_BYTES // (4 * width), 4 * size)
        pool = np.empty((capacity + size + largest, width), dtype=np.float32)
        tensor, filled, waiting = torch.from_numpy(pool), 0, list[int]()
        while True:
            kept, read = filled, 0
            while filled < size or (filled + largest <= capacity and read < n_pieces):  # each row once in a pool
                if not waiting:
                    waiting = rng.permutation(n_pieces).tolist()
                rows = self._rows(self._piece(lane, waiting.pop()))
                read += 1
                if rows is not None:
                    pool[filled : filled + len(rows)] = rows.rows
                    filled += len(rows)
                elif read >= n_pieces and filled == kept:
                    raise self._empty(lane)
            order = torch.from_numpy(rng.permutation(filled))
            whole = filled // size * size
            for index in torch.split(order[:whole], size):
                yield tensor.index_select(0, index)
            filled -= whole
            pool[:filled] = tensor.index_select(0, order[whole:]).numpy()

    def _moments(self, lane: int) -> NDArray[np.float64]:
        """Count, mean, squares about it, smallest and largest value of each column of a lane, ``(5, width)``."""
        width = 2 * self.ny + self.nu + 2
        found, low, high = Moments(width), np.full(width, np.inf), np.full(width, -np.inf)
        for number in range(self._n_pieces(lane)):
            if (rows := self._rows(self._piece(lane, number))) is not None:
                block = self.centring.values(rows.rows)
                found.add(block)
                low, high = np.minimum(low, block.min(axis=0)), np.maximum(high, block.max(axis=0))
        return np.stack([np.full(width, float(found.count)), found.mean, found.squares, low, high])

    def _stretches(self, lane: int, rows: int, seed: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Rows of an excerpt from a lane, and whether an episode, or what is left of one, begins with each."""
        first, last = self._bounds(lane)
        n_all = -(-(last - first) // _STRETCH)
        drawn = np.random.default_rng([seed, lane]).permutation(n_all)[: max(1, rows // _STRETCH)]
        chosen = np.sort(drawn)
        parts, begun = [], []
        for run in np.split(chosen, np.flatnonzero(np.diff(chosen) > 1) + 1):
            begin, end = first + int(run[0]) * _STRETCH, min(first + (int(run[-1]) + 1) * _STRETCH, last)
            block, starts = self._consecutive(begin, end)
            known = np.flatnonzero(starts)
            cut = int(known[0]) if len(known) else 0  # what comes before is the end of an episode
            starts[cut] = True
            parts.append(block[cut:])
            begun.append(starts[cut:])
        return np.concatenate(parts), np.concatenate(begun)

    def _consecutive(self, begin: int, end: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Rows of all shards from one on to another, and whether each is the first of its episode."""
        before = max(begin - 1, 0)
        tables, files = [], []
        for block in range(self._block_of(before), self._block_of(end - 1) + 1):
            piece = self._within(before, end, block)
            tables.append(self._raw_rows(piece))
            files.append(np.full(len(tables[-1]), piece.file))
        ids = np.concatenate([table.episode_ids for table in tables])
        numbers = np.concatenate(files)
        starts = np.append(True, (ids[1:] != ids[:-1]) | (numbers[1:] != numbers[:-1]))
        skipped = begin - before
        return np.concatenate([table.rows for table in tables])[skipped:], starts[skipped:]

    def _empty(self, lane: int) -> InvalidDataError:
        return InvalidDataError(
            f"{self.name}: lane {lane}",
            expected="rows to learn from",
            actual="none",
            hint="Raise trim (now rows far out are left out), use fewer lanes, or look for a shard of another plant.",
        )


def _opened(folder: Path, count: int) -> TableFile:
    """A shard, one of so many."""
    try:
        return TableFile(folder)
    except FileFormatError as error:
        if isinstance(error.__cause__, OSError) and error.__cause__.errno in (errno.EMFILE, errno.ENFILE):
            expected, hint = f"to open {count} shards", "Raise the limit (ulimit -n), or write larger shards."
            raise StorageError("shards", expected=expected, actual="too many open files", hint=hint) from error
        raise
