"""Transitions in float64 on which a model is identified, and wrapped angles in them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpcoffline.core.types import Array

FULL_TURN = 2.0 * np.pi
_NEAR_TURN = 0.5  # rad
_MOST_TURNS = 10  # a step; beyond 1e16, every number is one of full turns


class Rows(NamedTuple):
    """The transitions used, in float64."""

    x: Array
    u: Array
    reached: Array


def without_jumps(rows: Rows, errors: Array) -> tuple[Rows, tuple[int, ...]]:
    """The rows with full turns removed from s+ in wrapped angles, and which coordinates these are.

    These are confined to one turn, and their prediction errors are either small or near a full turn. Some are small:
    whether a step crosses the end of the turn depends on where it began. What is off by full turns in nearly all rows
    is off by a number, as a model in another unit is.
    """
    turns = np.round(np.nan_to_num(errors) / FULL_TURN)
    jumps = turns != 0.0
    near = (np.abs(errors - FULL_TURN * turns) < _NEAR_TURN) & (np.abs(turns) <= _MOST_TURNS)
    confined = np.ptp(np.concatenate([rows.x, rows.reached]), axis=0) <= 1.05 * FULL_TURN
    count = jumps.sum(axis=0)
    wrapped = confined & (count > 0) & (count <= 0.9 * len(errors)) & ((jumps & near).sum(axis=0) >= 0.9 * count)
    reached = rows.reached + np.where(wrapped & jumps, FULL_TURN * turns, 0.0)
    return rows._replace(reached=reached), tuple(int(i) for i in np.flatnonzero(wrapped))
