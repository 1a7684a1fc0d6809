"""From arrays to packed rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidDataError

from .build import BuiltRows
from .centring import Digits, Floats
from .math import CHUNK
from .numbers import check_finite, checked_episode_ids, floats


def read_arrays(
    name: str,
    observations: ArrayLike,
    actions: ArrayLike,
    costs: ArrayLike,
    next_observations: ArrayLike,
    terminations: ArrayLike,
    episode_ids: ArrayLike | None,
) -> BuiltRows:
    """Checks and packs five arrays; see :meth:`mpcoffline.TransitionTable.from_arrays`.

    Raises:
        InvalidDataError: For data that must not be learned from.
    """
    s, a = floats(name, "observations", observations, 2), floats(name, "actions", actions, 2)
    cost, s_next = floats(name, "costs", costs, 1), floats(name, "next_observations", next_observations, 2)
    terminated = floats(name, "terminations", terminations, 1)
    for column, array in {"actions": a, "costs": cost, "next_observations": s_next, "terminations": terminated}.items():
        if len(array) != len(s):
            raise InvalidDataError(
                f"{name}: {column}", expected=f"{len(s)} rows, as in observations", actual=str(len(array))
            )
    if len(s) == 0:
        raise InvalidDataError(name, expected="at least one transition", actual="none")
    if s_next.shape != s.shape:
        raise InvalidDataError(f"{name}: next_observations", expected=f"shape {s.shape}", actual=str(s_next.shape))
    ids = None if episode_ids is None else checked_episode_ids(name, episode_ids, len(s))
    values = np.concatenate([s, a, cost[:, None], s_next, terminated[:, None]], axis=1)
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes inf and is refused below
        rows = values.astype(np.float32)
    ny, nu = s.shape[1], a.shape[1]
    check_finite(name, rows, ny, nu, ids)
    if not np.isin(terminated, (0.0, 1.0)).all():
        raise InvalidDataError(
            f"{name}: terminations", expected="booleans", actual=f"values such as {terminated.max()}"
        )
    digits = Digits(ny, nu)
    for i in range(0, len(rows), CHUNK):
        digits.add(values[i : i + CHUNK], rows[i : i + CHUNK])
    centring = digits.centring
    if not centring.is_none:
        rows = centring.packed(values)
    if ids is None:
        starts = ~centring.goes_on(rows) | (terminated[:-1] > 0.0)
        ids = np.concatenate([[0], np.cumsum(starts)]).astype(np.int64)
    return BuiltRows(rows, ids, ny, nu, centring)


def packed_blocks(
    name: str, blocks: Callable[[], Iterable[tuple[Floats, NDArray[np.int64]]]], ny: int, nu: int
) -> BuiltRows:
    """Packs rows that come block by block, so that they are never all in float64 at once.

    Args:
        name: What error messages call the data.
        blocks: Called twice at most: yields rows ``(B, 2 ny + nu + 2)`` in float64, and the episode of each.
        ny: Number of observation coordinates.
        nu: Number of action coordinates.

    Raises:
        InvalidDataError: For a number that float32 cannot hold.
    """
    digits, parts, ids = Digits(ny, nu), [], []
    for values, episodes in blocks():
        with np.errstate(over="ignore"):
            rows = values.astype(np.float32)
        check_finite(name, rows, ny, nu, episodes)
        digits.add(values, rows)
        parts.append(rows)
        ids.append(episodes)
    centring = digits.centring
    if not centring.is_none:
        parts = [centring.packed(values) for values, _ in blocks()]
    return BuiltRows(np.concatenate(parts), np.concatenate(ids).astype(np.int64), ny, nu, centring)


def types_that_hold(episodes: Sequence[tuple[Floats, Floats, Floats]]) -> tuple[type[Any], type[Any]]:
    """Types to store observations and actions in: float32, or float64 where a table would be centred.

    Args:
        episodes: Observations ``(T+1, ny)``, actions ``(T, nu)`` and costs ``(T,)`` of each.
    """
    (first, inputs, _), *_ = episodes
    ny, nu = first.shape[1], inputs.shape[1]
    digits = Digits(ny, nu)
    for s, a, cost in episodes:
        values = np.hstack([s[:-1], a, cost[:, None], s[1:], np.zeros((len(a), 1))])
        digits.add(values, values.astype(np.float32))
    centring = digits.centring
    wide = centring.increments.any(), centring.centre[ny : ny + nu].any()
    state_type, action_type = (np.float64 if each else np.float32 for each in wide)
    return state_type, action_type
