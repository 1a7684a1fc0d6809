"""Checks of what is recorded and of the arrays that become a transition table.

An error names column, episode and step.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from mpcoffline.errors import InvalidArgumentError, InvalidDataError

NUMBERS = "fiub"  # the kinds of numpy types that a recording can hold


def floats(name: str, column: str, values: ArrayLike, ndim: int) -> NDArray[np.float64]:
    """The values as float64 with ``ndim`` dimensions, or an ``InvalidDataError``."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidDataError(f"{name}: {column}", expected="an array of numbers", actual=str(error)) from error
    if array.ndim != ndim:
        shape = "(n,)" if ndim == 1 else "(n, columns)"
        raise InvalidDataError(f"{name}: {column}", expected=f"shape {shape}", actual=str(array.shape))
    return array


def checked_episode_ids(name: str, values: ArrayLike, length: int) -> NDArray[np.int64]:
    """The ids as int64 ``(length,)``, or an ``InvalidDataError``, also where an id comes again after another."""
    ids = np.asarray(values)
    if ids.shape != (length,) or not np.issubdtype(ids.dtype, np.integer):
        raise InvalidDataError(
            f"{name}: episode_ids", expected=f"{length} integers", actual=f"{ids.dtype} of shape {ids.shape}"
        )
    starts = np.flatnonzero(np.concatenate([[True], ids[1:] != ids[:-1]])) if length else np.empty(0, np.intp)
    _, first = np.unique(ids[starts], return_index=True)
    if len(first) != len(starts):
        again = int(starts[np.setdiff1d(np.arange(len(starts)), first)[0]])
        raise InvalidDataError(
            f"{name}, row {again}: episode_ids",
            expected="the rows of an episode in one piece",
            actual=f"episode {ids[again]} again",
            hint="Give each episode a number of its own, and keep its rows together in time order.",
        )
    return ids.astype(np.int64)


def check_finite(
    name: str,
    rows: NDArray[np.float32],
    ny: int,
    nu: int,
    episode_ids: NDArray[np.int64] | None,
    steps_before: int = 0,
) -> None:
    """Refuses the first NaN or inf of packed rows ``(n, 2 ny + nu + 2)`` with ``InvalidDataError``.

    Where they are a block of a longer table, ``steps_before`` of its first episode's steps are in earlier blocks.
    """
    bad = ~np.isfinite(rows)
    if not bad.any():
        return
    labels = [f"observation {i}" for i in range(ny)] + [f"action {i}" for i in range(nu)] + ["cost"]
    labels += [f"next observation {i}" for i in range(ny)] + ["termination"]
    row, column = (int(i) for i in np.argwhere(bad)[0])
    raise InvalidDataError(
        f"{name}, {place(episode_ids, row, steps_before)}: {labels[column]}",
        expected="a finite number (in float32)",
        actual=f"{rows[row, column]} ({int(bad.any(axis=1).sum())} such rows)",
        hint="Remove these transitions, or find out how they came to be.",
    )


def place(episode_ids: NDArray[np.int64] | None, row: int, steps_before: int = 0) -> str:
    """Where a row stands, in words: its episode and the step within, or its number."""
    if episode_ids is None:
        return f"row {row}"
    episode = int(episode_ids[row])
    step = row - int(np.flatnonzero(episode_ids == episode)[0])
    return f"episode {episode}, step {step + (steps_before if episode == episode_ids[0] else 0)}"


def check_storable(name: str, space: spaces.Space[Any]) -> None:
    """Refuses a space whose elements are not one array of numbers each, before anything is recorded.

    Raises:
        InvalidArgumentError: Naming the space and the wrapper that helps.
    """
    flat = isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary)
    if flat or (isinstance(space, spaces.Box) and space.dtype.kind in NUMBERS):
        return
    observed = "gymnasium.wrappers.FlattenObservation" if "observation" in name else "a gymnasium.ActionWrapper"
    raise InvalidArgumentError(
        name,
        expected="a Box of numbers",
        actual=f"{type(space).__name__}: {space}",
        hint=f"Make one array of it first, e.g. by {observed}.",
    )


def check_numbers(name: str, values: ArrayLike) -> NDArray[Any]:
    """The values as an array, or ``InvalidDataError`` for objects, texts, records or a ragged list."""
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise InvalidDataError(name, expected="an array of numbers", actual=str(error)) from error
    if array.dtype.kind not in NUMBERS:
        raise InvalidDataError(
            name,
            expected="an array of numbers",
            actual=f"{type(values).__name__} of type {array.dtype} and shape {array.shape}",
        )
    return array
