"""Minibatches that are whole, or in parts that several processes have, and the gradients of losses over them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from mpcoffline.core.ranks import Ranks
from mpcoffline.datasets.table.shards import ShardedTable
from mpcoffline.datasets.table.transitions import Columns, TransitionTable

Some = TypeVar("Some")
#: The parts of a minibatch that this process has: of each its share of the rows, and the rows.
Parts = Sequence[tuple[float, Columns]]


class Reduction:
    """Of minibatches that are whole: a mean is that of the rows, a gradient what autograd gives."""

    def gradient(
        self,
        loss: Callable[[Some], tuple[Tensor, Tensor]],
        parts: Sequence[tuple[float, Some]],
        tensors: Sequence[Tensor],
    ) -> float:
        """Leaves the gradient of a mean over a minibatch in ``tensor.grad``.

        Args:
            loss: From some rows to the mean over them of which the gradient is wanted, and one that is shown.
            parts: The minibatch: of each part its share, and its rows.
            tensors: What it is a function of.

        Returns:
            What is shown of it.
        """
        ((_, rows),) = parts
        value, shown = loss(rows)
        value.backward()  # type: ignore[no-untyped-call]
        return float(shown.detach())

    def mean(self, values: Callable[[Some], Tensor], parts: Sequence[tuple[float, Some]]) -> Tensor | None:
        """The mean over a minibatch of a value of each row; None where a minibatch is whole, and its loss knows it."""
        return None


class ByLanes(Reduction):
    """Of minibatches in so many parts: sums over all processes, the same to the bit whoever has which part.

    ::

        d/dz E_B[l]  =  sum_k  |B_k| / |B|  d/dz E_{B_k}[l]

    Args:
        ranks: The processes.
        lanes: How many parts a minibatch has, in all of them.
    """

    def __init__(self, ranks: Ranks, lanes: int) -> None:
        self._ranks, self._lanes = ranks, lanes

    def gradient(
        self,
        loss: Callable[[Some], tuple[Tensor, Tensor]],
        parts: Sequence[tuple[float, Some]],
        tensors: Sequence[Tensor],
    ) -> float:
        """See :class:`Reduction`; NaN, and so are the gradients, where one of a part is not finite."""
        found: list[list[Tensor]] = []
        for share, rows in parts:
            for tensor in tensors:
                tensor.grad = None
            value, shown = loss(rows)
            (share * value).backward()  # type: ignore[no-untyped-call]
            grads = [torch.zeros_like(tensor) if tensor.grad is None else tensor.grad for tensor in tensors]
            found.append([*grads, share * shown.detach().double().reshape(1)])
        sums = self._ranks.exact_sums(found, self._lanes)
        for i, tensor in enumerate(tensors):
            tensor.grad = torch.full_like(tensor, torch.nan) if sums is None else sums[i].to(tensor.dtype)
        return torch.nan if sums is None else float(sums[-1])

    def mean(self, values: Callable[[Some], Tensor], parts: Sequence[tuple[float, Some]]) -> Tensor | None:
        """See :class:`Reduction`."""
        with torch.no_grad():
            own = [[share * values(rows).mean().reshape(1)] for share, rows in parts]
        sums = self._ranks.exact_sums(own, self._lanes)
        return torch.tensor(torch.nan, dtype=torch.float64) if sums is None else sums[0][0]


class Source(NamedTuple):
    """Where minibatches come from, and how means over them are taken.

    Attributes:
        data: Its statistics are those of all rows.
        batches: For ever: of each minibatch the parts of this process, packed as the data are.
        reduction: Means and gradients over them.
    """

    data: TransitionTable | ShardedTable
    batches: Iterator[list[tuple[float, Tensor]]]
    reduction: Reduction

    @classmethod
    def of(
        cls,
        table: TransitionTable,
        shards: ShardedTable | None,
        batch_size: int,
        rng: np.random.Generator,
        seed: int,
    ) -> Source:
        """Minibatches of a table, or of shards where there are some.

        Args:
            table: The table.
            shards: The shards.
            batch_size: Rows a minibatch.
            rng: Draws the rows of a table.
            seed: Draws those of shards.
        """
        if shards is None:
            return cls(table, ([(1.0, rows)] for rows in table.batches(batch_size, rng)), Reduction())
        return cls(shards, shards.batches(batch_size, seed), ByLanes(shards.ranks, shards.lanes))
