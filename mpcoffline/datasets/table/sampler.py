"""Random minibatches: a gather from memory, or shuffled blocks of a file that is larger than memory."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .cache import TableFile

if TYPE_CHECKING:
    import torch


def gather_batches(
    rows: NDArray[np.float32], batch_size: int, rng: np.random.Generator, epochs: int | None
) -> Iterator[torch.Tensor]:
    """Each row once an epoch, in random order; a remainder shorter than a batch is left out.

    Args:
        rows: The packed rows ``(n, width)``.
        batch_size: Rows a batch, at most n.
        rng: Random generator.
        epochs: Passes over the table; None goes on for ever.
    """
    import torch

    tensor = torch.from_numpy(rows)
    for _ in itertools.count() if epochs is None else range(epochs):
        order = torch.from_numpy(rng.permutation(len(rows))[: len(rows) // batch_size * batch_size])
        for index in torch.split(order, batch_size):
            yield tensor.index_select(0, index)


def block_batches(
    file: TableFile, batch_size: int, rng: np.random.Generator, epochs: int | None, memory: int
) -> Iterator[torch.Tensor]:
    """Like :func:`gather_batches` without holding the table: randomly chosen blocks are mixed in a pool.

    Blocks are read in random order, as many as the pool holds, and its rows are permuted. So rows of one batch
    come from all over the table, but two rows of a block are more often in the same pool than chance would have it.
    While batches are drawn, the system fetches the next pool's blocks.

    Args:
        file: The table.
        batch_size: Rows a batch, at most the table's.
        rng: Random generator.
        epochs: Passes over the table; None goes on for ever.
        memory: Bytes that this may occupy; the pool takes half of it.

    Raises:
        FileFormatError: For a block that is not what was written.
    """
    import torch

    capacity = max(1, memory // 2 // (file.block_rows * file.row_bytes))
    pool = np.empty((capacity * file.block_rows + batch_size, file.width), dtype=np.float32)
    tensor = torch.from_numpy(pool)
    for _ in itertools.count() if epochs is None else range(epochs):
        blocks = rng.permutation(file.n_blocks).tolist()
        filled = 0  # the rows left over from the pool before
        for first in range(0, len(blocks), capacity):
            for block in blocks[first : first + capacity]:
                filled += file.read_block(block, pool[filled:])
                file.advise(block, needed=False)
            following = blocks[first + capacity : first + 2 * capacity]
            order = torch.from_numpy(rng.permutation(filled))
            batches = filled // batch_size
            indices = torch.split(order, batch_size)
            advised = 0
            for i in range(batches):
                ahead = len(following) * (i + 1) // batches
                for block in following[advised:ahead]:
                    file.advise(block, needed=True)
                advised = ahead
                yield tensor.index_select(0, indices[i])
            left = order[batches * batch_size :]
            pool[: len(left)] = tensor.index_select(0, left).numpy()
            filled = len(left)
