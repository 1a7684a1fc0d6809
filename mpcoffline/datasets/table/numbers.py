"""Checks of what is recorded and of the arrays that become a transition table.

An error names column, episode and step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError

NUMBERS = "fiub"  # the kinds of numpy types that a recording can hold


def floats(name: str, column: str, values: ArrayLike, ndim: int) -> NDArray[np.float64]:
    """The values as float64 with ``ndim`` dimensions, or an ``InvalidDataError``."""
    array = real_numbers(name, column, values)
    if array.ndim != ndim:
        shape = "(n,)" if ndim == 1 else "(n, columns)"
        raise InvalidDataError(f"{name}: {column}", expected=f"shape {shape}", actual=str(array.shape))
    return array


def real_numbers(name: str, column: str, values: ArrayLike) -> NDArray[np.float64]:
    """The values as float64, or an ``InvalidDataError`` for what are no real numbers, or are masked.

    Truth values are numbers (0 and 1) everywhere but among the costs.
    """
    _refuse_masks(name, column, values)
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as error:  # the last from torch
        raise InvalidDataError(f"{name}: {column}", expected="an array of numbers", actual=str(error)) from error
    if array.dtype.kind not in ("fiu" if column.startswith("cost") else "fiub"):
        raise InvalidDataError(
            f"{name}: {column}",
            expected="an array of numbers",
            actual=f"an array of {array.dtype}",
            hint="Convert it to float64, which says what is meant.",
        )
    return array.astype(np.float64, copy=False)


def _refuse_masks(name: str, column: str, values: object) -> None:
    """Refuses them: numpy would go on with what lies beneath a mask."""
    parts = values if isinstance(values, (list, tuple)) else [values]
    n_masked = sum(np.count_nonzero(part.mask) for part in parts if isinstance(part, np.ma.MaskedArray))
    if n_masked:
        raise InvalidDataError(
            f"{name}: {column}",
            expected="numbers",
            actual=f"{n_masked} masked entries",
            hint="Remove these transitions, or fill in what is missing.",
        )


def checked_episode_ids(name: str, values: ArrayLike, length: int) -> NDArray[np.int64]:
    """The ids as int64 ``(length,)``, or an ``InvalidDataError``, also where an id comes again after another."""
    _refuse_masks(name, "episode_ids", values)
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


def check_sizes(name: str, sizes: Mapping[str, tuple[int, int]], other: str = "the MPC") -> None:
    """Refuses numbers of coordinates that are not those of the other: found and wanted, by what they count."""
    for kind, (found, wanted) in sizes.items():
        if found != wanted:
            raise InvalidDataError(
                f"{name}: {kind}",
                expected=f"{wanted} coordinates, as in {other}",
                actual=str(found),
                hint=f"Is this data set of the same task as {other}?",
            )


def check_bounds(
    name: str,
    actions: NDArray[np.floating[Any]],
    episode_ids: NDArray[np.int64],
    low: ArrayLike | None,
    high: ArrayLike | None,
) -> None:
    """Refuses the first action beyond the MPC's bounds by more than rounding; None is no bound."""
    bounds = [np.abs(np.asarray(bound, dtype=np.float64)) for bound in (low, high) if bound is not None]
    finite = [np.where(np.isfinite(bound), bound, 0.0) for bound in bounds]
    size = np.max(np.broadcast_arrays(*finite, np.zeros(actions.shape[1:])), axis=0)  # of each input, in its own unit
    for bound, sign, word in ((low, -1.0, "above"), (high, 1.0, "below")):
        if bound is None:
            continue
        limit = np.broadcast_to(np.asarray(bound, dtype=np.float64), actions.shape[1:])
        excess = sign * (actions.astype(np.float64) - limit)
        outside = excess > 1e-6 * size
        if outside.any():
            row, column = (int(i) for i in np.argwhere(outside)[0])
            raise InvalidDataError(
                f"{name}, {place(episode_ids, row)}: action {column}",
                expected=f"a value {word} the MPC's bound {limit[column]:g}",
                actual=f"{actions[row, column]:g} ({int(outside.any(axis=1).sum())} such rows)",
                hint="Check the units, and that the MPC's bounds are those of the plant.",
            )
