"""Data sets of trajectories that are given as arrays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets.store.names import checked_names
from mpcoffline.datasets.store.writing import episode_of, write_dataset
from mpcoffline.datasets.table.arrays import types_that_hold
from mpcoffline.datasets.table.excerpts import stretches
from mpcoffline.datasets.table.numbers import floats
from mpcoffline.datasets.table.transitions import TransitionTable

if TYPE_CHECKING:
    from minari import MinariDataset


def dataset_from_arrays(
    dataset_id: str,
    episodes: Iterable[tuple[ArrayLike, ArrayLike, ArrayLike]],
    *,
    action_low: ArrayLike = -np.inf,
    action_high: ArrayLike = np.inf,
    terminated: Sequence[bool] | None = None,
    description: str | None = None,
    names: Sequence[str] = (),
    overwrite: bool = False,
) -> MinariDataset:
    """Stores trajectories as a Minari data set.

    Observations and actions are stored as float32, or as float64 where they are small against their offset (a position
    at 1e6 m), so that float32 would lose their changes.

    Args:
        dataset_id: Minari id of the new data set.
        episodes: For each episode its observations ``(T+1, ny)``, actions ``(T, nu)`` and costs ``(T,)``.
        action_low: Lower bounds of the actions, ``(nu,)`` or a number.
        action_high: Upper bounds of the actions.
        terminated: For each episode, whether it ended in a terminal state; otherwise it was cut off there.
        description: Stored as metadata.
        names: What the columns are called, with units as ``"level [cm]"``, observations first; none by default.
        overwrite: Whether an existing data set of this id may be replaced.

    Raises:
        InvalidArgumentError: For a bad id, or one that exists, or names that are none or not one a column.
        InvalidDataError: For a wrong shape, NaN or inf, or an action out of bounds; names episode and step.
        StorageError: Where the disk refuses.
    """
    checked = [_checked(f"episode {i}", *episode) for i, episode in enumerate(episodes)]
    if not checked:
        raise InvalidDataError(f"data set {dataset_id!r}", expected="at least one episode", actual="none")
    ends = [False] * len(checked) if terminated is None else list(terminated)
    if len(ends) != len(checked):
        raise InvalidArgumentError("terminated", expected=f"{len(checked)} values", actual=str(len(ends)))
    ny, nu = checked[0][0].shape[1], checked[0][1].shape[1]
    for i, (s, a, _) in enumerate(checked):
        if (s.shape[1], a.shape[1]) != (ny, nu):
            raise InvalidDataError(
                f"episode {i}", expected=f"{ny} observations and {nu} actions", actual=f"{s.shape[1]}, {a.shape[1]}"
            )
    called = checked_names(f"data set {dataset_id!r}", names, ny + nu) if names else ()
    state_type, action_type = types_that_hold(checked)
    low, high = (np.broadcast_to(np.asarray(b, action_type), (nu,)).copy() for b in (action_low, action_high))
    for i, (_, a, _) in enumerate(checked):
        outside = (a.astype(action_type) < low) | (a.astype(action_type) > high)
        if outside.any():
            step, column = (int(k) for k in np.argwhere(outside)[0])
            raise InvalidDataError(
                f"episode {i}, step {step}: action {column}",
                expected=f"a value in [{low[column]:g}, {high[column]:g}]",
                actual=f"{a[step, column]:g}",
            )
    return write_dataset(
        dataset_id,
        (
            episode_of(s.astype(state_type), a.astype(action_type), cost, s, terminated=end)
            for (s, a, cost), end in zip(checked, ends, strict=True)
        ),
        env_spec=None,
        observation_space=spaces.Box(-np.inf, np.inf, (ny,), state_type),
        action_space=spaces.Box(low, high, (nu,), action_type),
        description=description,
        names=called,
        overwrite=overwrite,
    )


def dataset_from_table(
    dataset_id: str,
    table: TransitionTable,
    *,
    action_low: ArrayLike = -np.inf,
    action_high: ArrayLike = np.inf,
    description: str | None = None,
    overwrite: bool = False,
) -> MinariDataset:
    """Stores the transitions of a table as a Minari data set, with the names of its columns.

    What does not go on from the row before begins a new episode.

    Args:
        dataset_id: Minari id of the new data set.
        table: The transitions.
        action_low: Lower bounds of the actions, ``(nu,)`` or a number.
        action_high: Upper bounds of the actions.
        description: Stored as metadata.
        overwrite: Whether an existing data set of this id may be replaced.

    Raises:
        InvalidArgumentError: For a bad id, or one that exists.
        InvalidDataError: For an action out of bounds.
        StorageError: Where the disk refuses.
    """
    columns = table.values()
    parts = stretches(table)
    return dataset_from_arrays(
        dataset_id,
        [
            (
                np.vstack([columns.observations[p], columns.next_observations[p][-1:]]),
                columns.actions[p],
                columns.costs[p],
            )
            for p in parts
        ],
        action_low=action_low,
        action_high=action_high,
        terminated=[bool(columns.terminations[p][-1] > 0.0) for p in parts],
        description=description,
        names=table.names,
        overwrite=overwrite,
    )


def _checked(
    name: str, observations: ArrayLike, actions: ArrayLike, costs: ArrayLike
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    s, a, cost = (
        floats(name, "observations", observations, 2),
        floats(name, "actions", actions, 2),
        floats(name, "costs", costs, 1),
    )
    for column, found, wanted in (("observations", len(s), len(a) + 1), ("costs", len(cost), len(a))):
        if found != wanted or len(a) == 0:
            raise InvalidDataError(
                f"{name}: {column}", expected=f"{wanted} rows, with {len(a)} actions", actual=str(found)
            )
    for column, values in (("observation", s), ("action", a), ("cost", cost[:, None])):
        bad = ~np.isfinite(values.astype(np.float32))
        if bad.any():
            step, i = (int(k) for k in np.argwhere(bad)[0])
            raise InvalidDataError(
                f"{name}, step {step}: {column} {i}",
                expected="a finite number (in float32)",
                actual=str(values[step, i]),
            )
    return s, a, cost
