"""A fit in several processes of one job: who speaks, who writes, and what all of them hand out in the end."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
from gymnasium import spaces

from mpcoffline.core.ranks import Ranks
from mpcoffline.datasets.table.shards import ShardedTable
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

if TYPE_CHECKING:
    from minari import MinariDataset


def opened(
    dataset: MinariDataset | TransitionTable | ShardedTable | str, seed: int
) -> tuple[TransitionTable, spaces.Box | None, ShardedTable | None]:
    """What a fit is given: transitions in a table, the space of observations where known, and shards where it is these.

    Args:
        dataset: The data; of shards the table is an excerpt, the same in each process.
        seed: Seeds the excerpt.
    """
    if isinstance(dataset, ShardedTable):
        return dataset.excerpt(seed=seed), None, dataset
    if isinstance(dataset, TransitionTable):
        return dataset, None, None
    if isinstance(dataset, str):
        from mpcoffline.datasets import load_dataset

        dataset = load_dataset(dataset)
    table, space = TransitionTable.of(dataset), dataset.observation_space
    return table, space if isinstance(space, spaces.Box) else None, None


class Together:
    """The processes that fit from shards; one that is alone does all that there is to do.

    Args:
        shards: What is learned from; None for a table.
    """

    def __init__(self, shards: ShardedTable | None) -> None:
        self._ranks = Ranks() if shards is None else shards.ranks

    @property
    def is_first(self) -> bool:
        """Whether this one calls callbacks, writes files and chooses among candidates."""
        return self._ranks.is_first

    def any_asks(self, ends: bool) -> bool:
        """Whether a process wants the fit to end."""
        return self._ranks.largest([float(ends)])[0] > 0.0

    def handed_out(self, mpc: MPC | None) -> MPC | None:
        """The MPC of the first process, in all of them.

        Args:
            mpc: That of this one.
        """
        if self._ranks.size == 1 or mpc is None:
            return mpc
        text = np.frombuffer(json.dumps(mpc.to_json()).encode(), dtype=np.uint8) if self.is_first else None
        found = self._ranks.shared(text, 0)
        return mpc if self.is_first else MPC.from_json(json.loads(found.tobytes()))
