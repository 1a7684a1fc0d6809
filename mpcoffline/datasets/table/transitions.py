"""The transition table: what learning reads, packed so that a minibatch is one gather."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets.store.names import names_of

from .arrays import read_arrays
from .build import BuiltRows, joined, read_minari
from .cache import TableFile, default_memory, scratch_table
from .centring import Centring
from .math import CHUNK, Columns, Episodes, TableStatistics, drawn_episodes, innermost, moments, split
from .numbers import check_bounds, check_sizes
from .sampler import block_batches, gather_batches
from .shown import Shown

__all__ = ["Columns", "Episodes", "TableStatistics", "TransitionTable"]

if TYPE_CHECKING:
    import torch
    from minari import MinariDataset


class TransitionTable(Shown):
    """Transitions (s, a, L, s+, terminated) as one C-contiguous float32 array ``(n, 2 ny + nu + 2)``.

    :attr:`rows` and :meth:`batches` are that array, for speed; everything else is in units. Columns that are small
    against their offset, as a position at 1e6 m, are packed without it (``datasets/table/centring.py``), and come out
    in float64; all others are float32 views of the rows.

    One packed row a transition makes a random minibatch one contiguous gather a row, an order of magnitude
    faster than gathering five arrays. Everything here speaks cost L; a reward changes its sign in :meth:`from_minari`
    and nowhere else. A time-limit truncation is not a termination: learning bootstraps from its s+.
    Build one with :meth:`from_arrays` or :meth:`from_minari`, which check what they are given.

    Args:
        rows: The packed rows, ``(n, 2 ny + nu + 2)`` float32, columns in the order above.
        ny: Number of observation coordinates.
        nu: Number of action coordinates.
        episode_ids: Episode of each row, ``(n,)``; rows of an episode are contiguous and in time order.
        name: What error messages call this table, e.g. the data set's id.
        centring: What the rows were packed without; nothing by default.
        file: Where the rows are a memory map, the file that they are in.
        memory: Bytes that sampling a mapped table may occupy; a quarter of the machine's memory by default.
        names: Names and units of the columns, observations first, as ``"level [cm]"``; none where nobody said.
    """

    def __init__(
        self,
        rows: NDArray[np.float32],
        ny: int,
        nu: int,
        episode_ids: NDArray[np.int64],
        name: str = "table",
        *,
        centring: Centring | None = None,
        file: TableFile | None = None,
        memory: int | None = None,
        names: tuple[str, ...] = (),
    ) -> None:
        super().__init__(ny, nu, name, names)
        self._rows, self._episode_ids = rows, episode_ids
        self.centring: Centring = Centring.none(ny, nu) if centring is None else centring
        self._plain = self.centring.is_none
        self._file, self._memory = file, memory

    @property
    def rows(self) -> NDArray[np.float32]:
        """The packed rows; those of a file are checked first, once (``FileFormatError`` where it is damaged)."""
        return self._rows if self._file is None else self._file.rows

    @property
    def episode_ids(self) -> NDArray[np.int64]:
        """Episode of each row; those of a file are checked first, once."""
        return self._episode_ids if self._file is None else self._file.episode_ids

    @property
    def is_mapped(self) -> bool:
        """Whether the rows are in a file rather than in memory."""
        return self._file is not None

    def __len__(self) -> int:
        return len(self._rows)

    def __repr__(self) -> str:
        what = f"; {', '.join(self.names)}" if self.names else f", ny={self.ny}, nu={self.nu}"
        return f"{type(self).__name__}({self.name!r}, n={len(self)}{what})"

    @property
    def observations(self) -> NDArray[np.floating[Any]]:
        """Observations s ``(n, ny)``: a view, or where they are centred a copy in float64."""
        return self._part(0, self.ny)

    @property
    def actions(self) -> NDArray[np.floating[Any]]:
        """Actions a in the environment's units ``(n, nu)``, a view or a copy as :attr:`observations`."""
        return self._part(self.ny, self.nu)

    @property
    def costs(self) -> NDArray[np.floating[Any]]:
        """The stage cost L(s, a) ``(n,)``, a view or a copy as :attr:`observations`."""
        return self._part(self.ny + self.nu, 1)[:, 0]

    @property
    def next_observations(self) -> NDArray[np.floating[Any]]:
        """Observations s+ reached ``(n, ny)``, a view or a copy as :attr:`observations`."""
        s_next, increments = self._part(self.ny + self.nu + 1, self.ny), self.centring.increments
        return s_next.astype(np.float64) + increments * self.observations if increments.any() else s_next

    @property
    def terminations(self) -> NDArray[np.float32]:
        """1.0 where the episode terminated in s+, else 0.0, a view ``(n,)``."""
        return self.rows[:, -1]

    @property
    def n_episodes(self) -> int:
        """Number of episodes."""
        return len(self.episodes.ids)

    @property
    def episodes(self) -> Episodes:
        """Where its episodes lie: ids, first rows and lengths, ``(E,)`` each."""
        return Episodes(*np.unique(self.episode_ids, return_index=True, return_counts=True))

    def columns(self, block: Any) -> Columns:
        """The five columns of a block of rows in units: views of it; where the table is centred, copies in float64.

        Args:
            block: ``(B, 2 ny + nu + 2)``, a numpy array or a torch tensor.
        """
        return split(block, self.ny, self.nu) if self._plain else self.centring.columns(block)

    def values(self) -> Columns:
        """All five columns in units, copies in float64."""
        return split(self.centring.values(self.rows), self.ny, self.nu)

    def take(self, rows: NDArray[np.intp] | slice) -> TransitionTable:
        """A table in memory of some of the rows, in the order given: ``table.take(table.episodes.rows(-1))``."""
        own: dict[str, Any] = {"name": self.name, "centring": self.centring, "names": self.names}
        return TransitionTable(self.rows[rows], self.ny, self.nu, self.episode_ids[rows], **own)

    def sample(self, count: int, rng: np.random.Generator | int) -> TransitionTable:
        """A table in memory of rows drawn at random, each at most once, in the order that they have here.

        Args:
            count: How many; all of them where there are no more.
            rng: Random generator or seed.

        Raises:
            InvalidArgumentError: For a count below 1.
        """
        check_integers(1, count=count)
        return self.take(np.sort(np.random.default_rng(rng).permutation(len(self))[:count]))

    def with_states(self, observations: ArrayLike, next_observations: ArrayLike) -> TransitionTable:
        """A table in memory with other s and s+, ``(n, ny)`` each, packed as this one is."""
        values = self.centring.values(self.rows)
        columns = split(values, self.ny, self.nu)
        columns.observations[:], columns.next_observations[:] = observations, next_observations
        own: dict[str, Any] = {"name": self.name, "centring": self.centring, "names": self.names}
        return TransitionTable(self.centring.packed(values), self.ny, self.nu, self.episode_ids, **own)

    def goes_on(self) -> NDArray[np.bool_]:
        """Whether a row's s+ is the s of the next, ``(n - 1,)``; where centred, but for the last digits of float32."""
        return self.centring.goes_on(self.rows)

    @classmethod
    def from_arrays(
        cls,
        observations: ArrayLike,
        actions: ArrayLike,
        costs: ArrayLike,
        next_observations: ArrayLike,
        terminations: ArrayLike,
        episode_ids: ArrayLike | None = None,
        *,
        name: str = "transitions",
    ) -> TransitionTable:
        """Packs five arrays.

        Args:
            observations: s, ``(n, ny)``.
            actions: a, ``(n, nu)``.
            costs: The stage cost L(s, a), ``(n,)``: a cost, not a reward.
            next_observations: s+, ``(n, ny)``.
            terminations: Whether the episode terminated in s+, ``(n,)``; False at a time limit.
            episode_ids: Episode of each row, ``(n,)`` integers. By default a row goes on the episode of the
                row before where it starts in the s+ reached there and nothing terminated.
            name: What error messages call the data.

        Raises:
            InvalidDataError: For a wrong shape, lengths that differ, no row at all, NaN or inf (in float32),
                or terminations that are not boolean.
        """
        arrays = observations, actions, costs, next_observations, terminations, episode_ids
        return cls._of(read_arrays(name, *arrays), name)

    @classmethod
    def of(cls, data: TransitionTable | MinariDataset | str) -> TransitionTable:
        """A table as it is; a Minari data set, or the id of one, by :meth:`from_minari`.

        Raises:
            InvalidArgumentError: For anything else.
        """
        if isinstance(data, TransitionTable):
            return data
        if not isinstance(data, str) and not hasattr(data, "iterate_episodes"):
            expected, hint = "a table, a Minari data set or its id", "TransitionTable.from_arrays takes arrays."
            raise InvalidArgumentError("data set", expected=expected, actual=type(data).__name__, hint=hint)
        return cls.from_minari(data)

    @classmethod
    def from_minari(
        cls, dataset: MinariDataset | str, *, memory: int | None = None, cache: str | Path | None = None
    ) -> TransitionTable:
        """Reads a Minari data set; cost = -reward.

        Large tables (from 500,000 rows on) are kept in a cache outside the data set, under the SHA-256 of its file,
        so that they are built once. A table larger than ``memory`` stays in the cache's file: its rows are
        a memory map, and :meth:`batches` shuffles it block by block.

        Args:
            dataset: The data set, or its id (local or shipped).
            memory: Bytes; by default a quarter of the machine's memory.
            cache: The cache's folder; by default ``tables`` in that of all caches (``MPCOFFLINE_CACHE``). One that
                others own or can write is not used, but a temporary one.

        Raises:
            UnknownIdError: For an unknown id.
            InvalidDataError: For spaces other than a one-dimensional Box, episodes that do not hold one
                observation more than actions, or data that :meth:`from_arrays` refuses.
            FileFormatError: For a damaged file.
            StorageError: Where a table larger than ``memory`` cannot be written.
        """
        if isinstance(dataset, str):
            from mpcoffline.datasets.hub.loading import load_dataset

            dataset = load_dataset(dataset)
        name = f"data set {dataset.spec.dataset_id!r}"
        memory = default_memory() if memory is None else memory
        table = cls._of(read_minari(dataset, name, memory, None if cache is None else Path(cache)), name, memory)
        table.names = names_of(dataset)
        return table

    @classmethod
    def concat(cls, tables: Sequence[TransitionTable], *, name: str | None = None) -> TransitionTable:
        """Several tables as one; episodes are numbered anew, so that those of different tables stay apart.

        Args:
            tables: At least one table. Where one is mapped, the result is too.
            name: What error messages call it; the tables' names by default.

        Raises:
            InvalidArgumentError: For no table at all.
            InvalidDataError: For tables of different numbers of observations or actions.
        """
        if not tables:
            raise InvalidArgumentError("tables", expected="at least one", actual="none")
        first = tables[0]
        for other in tables:
            check_sizes(other.name, {"observations": (other.ny, first.ny), "actions": (other.nu, first.nu)}, first.name)
        centring = Centring.common([table.centring for table in tables], [len(table) for table in tables])
        blocks = joined(((table.rows, table.episode_ids, table.centring) for table in tables), centring)
        largest = next((table for table in tables if table.is_mapped), first)
        return largest.rewritten(blocks, name or " + ".join(table.name for table in tables), centring)

    def rewritten(
        self,
        blocks: Iterable[tuple[NDArray[np.float32], NDArray[np.int64]]],
        name: str | None = None,
        centring: Centring | None = None,
        sizes: tuple[int, int] | None = None,
    ) -> TransitionTable:
        """A table of other rows, and of their size: a mapped one gives a mapped one, in a file that vanishes with it.

        Args:
            blocks: Packed rows ``(B, 2 ny + nu + 2)`` and their episodes ``(B,)``, one block after another.
            name: What error messages call it; the name of this one by default.
            centring: What they are packed without; as in this one by default.
            sizes: Their ny and nu; likewise.

        Raises:
            StorageError: Where a mapped table cannot be written.
        """
        centring, (ny, nu) = centring or self.centring, sizes or (self.ny, self.nu)
        if self._file is None:
            rows, ids = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
            table = TransitionTable(rows, ny, nu, ids, name or self.name, centring=centring)
        else:
            file = scratch_table(ny, nu, blocks, self._file.folder.parent, centring)
            table = self._of(file, name or self.name, self._memory)
        table.names = self.names if sizes is None else ()
        return table

    def check_fits(
        self, ny: int, nu: int, action_low: ArrayLike | None = None, action_high: ArrayLike | None = None
    ) -> None:
        """Refuses to fit an MPC to data of another plant.

        Args:
            ny: Number of states of the MPC's model; the data's observations must be these.
            nu: Number of its inputs.
            action_low: Its lower input bounds ``(nu,)``; None for no check.
            action_high: Its upper input bounds ``(nu,)``.

        Raises:
            InvalidDataError: Naming what differs; for an action out of bounds (beyond float32
                rounding) its episode and step.
        """
        check_sizes(self.name, {"observations": (self.ny, ny), "actions": (self.nu, nu)})
        check_bounds(self.name, self.actions, self.episode_ids, action_low, action_high)

    def trim(self, fraction: float, count: int | None = None) -> TransitionTable:
        """Drops the transitions farthest out, on which a value regression would spend itself.

        Keeps the rows with the smallest ``max(|s - m|, |s+ - m|) / h`` over the coordinates, with m the middle between
        the quartiles of each and h half their distance (where that is zero the mean of ``|s - m|``, else 1).

        Args:
            fraction: Share of rows to keep, in (0, 1].
            count: How many coordinates decide, the first ones; all by default.

        Returns:
            A new table, rows in the same order.

        Raises:
            InvalidArgumentError: For another fraction.
        """
        check_number("fraction", fraction, 0.0, 1.0)
        return self._take(innermost(self.rows, self.ny, self.nu, fraction, self.centring.states, count))

    def statistics(self) -> TableStatistics:
        """Mean, standard deviation and range of every column, in float64, in one pass over the table."""
        rows = (values[None, :] for values in moments(self.rows, self.centring.values))
        return TableStatistics(*(Columns(*(c[0] for c in split(row, self.ny, self.nu))) for row in rows))

    def split(self, fraction: float, seed: int) -> tuple[TransitionTable, TransitionTable]:
        """Splits at random by episode, so that no episode is on both sides.

        Args:
            fraction: Share of the episodes in the first table, in (0, 1).
            seed: Seed of the draw.

        Returns:
            Two tables with at least one episode each.

        Raises:
            InvalidArgumentError: For another fraction, or fewer than two episodes.
        """
        chosen = drawn_episodes(self.name, self.episode_ids, fraction, seed)
        return self._take(np.flatnonzero(chosen)), self._take(np.flatnonzero(~chosen))

    def batches(
        self, batch_size: int, rng: np.random.Generator | int, *, epochs: int | None = None
    ) -> Iterator[torch.Tensor]:
        """Random minibatches, each row once an epoch; a remainder shorter than a batch is left out.

        Args:
            batch_size: Rows a batch; capped at the number of rows.
            rng: Random generator or seed.
            epochs: Passes over the table; None goes on for ever.

        Yields:
            Blocks of rows ``(B, 2 ny + nu + 2)``, float32 tensors; :meth:`columns` names their parts.

        Raises:
            InvalidArgumentError: For a batch size below 1.
        """
        check_integers(1, batch_size=batch_size)
        batch_size, generator = min(batch_size, len(self)), np.random.default_rng(rng)
        if self._file is None:
            return gather_batches(self.rows, batch_size, generator, epochs)
        memory = default_memory() if self._memory is None else self._memory
        return block_batches(self._file, batch_size, generator, epochs, memory)

    def _part(self, start: int, size: int) -> NDArray[np.floating[Any]]:
        """Some neighbouring columns of the rows, with what they were packed without."""
        part, centre = self.rows[:, start : start + size], self.centring.centre[start : start + size]
        return part + centre if centre.any() else part

    def _take(self, index: NDArray[np.intp]) -> TransitionTable:
        if self._file is None:
            return self.take(index)
        parts = (index[i : i + CHUNK] for i in range(0, len(index), CHUNK))
        return self.rewritten((self.rows[part], self.episode_ids[part]) for part in parts)

    @classmethod
    def _of(cls, built: BuiltRows | TableFile, name: str, memory: int | None = None) -> TransitionTable:
        file = built if isinstance(built, TableFile) else None
        rows, ids = (built.raw_rows, built.raw_ids) if isinstance(built, TableFile) else (built.rows, built.episode_ids)
        return cls(rows, built.ny, built.nu, ids, name, centring=built.centring, file=file, memory=memory)
