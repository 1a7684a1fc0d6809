"""Parts of a table: an excerpt of a large one for what looks at rows one after another, and its runs."""

from __future__ import annotations

import itertools

import numpy as np

from .transitions import TransitionTable

_BLOCK = 1_000  # consecutive rows that are taken together


def excerpt(table: TransitionTable, rows: int, seed: int) -> TransitionTable:
    """The table, or of a larger one some stretches of consecutive rows, in their order.

    Args:
        table: The transitions.
        rows: How many of them, to a thousand.
        seed: Seeds the choice.
    """
    n_blocks, wanted = -(-len(table) // _BLOCK), max(1, rows // _BLOCK)
    if n_blocks <= wanted:
        return table
    chosen = np.sort(np.random.default_rng(seed).permutation(n_blocks)[:wanted])
    taken = (chosen[:, None] * _BLOCK + np.arange(_BLOCK)).ravel()
    return table.take(taken[taken < len(table)])


def stretches(table: TransitionTable) -> list[slice]:
    """The runs of rows in which each goes on from the one before, in their order."""
    within = (table.episode_ids[1:] == table.episode_ids[:-1]) & table.goes_on() & (table.terminations[:-1] == 0.0)
    begins = [0, *(np.flatnonzero(~within) + 1).tolist(), len(table)]
    return [slice(a, b) for a, b in itertools.pairwise(begins)]
