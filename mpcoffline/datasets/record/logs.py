"""Data sets without a learning agent: a policy in an environment, arrays, or the log file of a real plant."""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.checks import check_integers, checked_seed
from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.datasets.store.writing import write_dataset
from mpcoffline.datasets.table.arrays import types_that_hold
from mpcoffline.datasets.table.numbers import floats, real_numbers
from mpcoffline.datasets.table.transitions import TransitionTable

from .plants import check_spaces, check_units, in_units, opened, plain_spec, step_cap
from .policy_origin import policy_origin
from .recording import Recording
from .rollouts import run_episode
from .stage_cost import PlantInfo
from .watching import plant_of

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer

Cost = Callable[[NDArray[np.float64], NDArray[np.float64]], ArrayLike]


def record(
    env: gym.Env[Any, Any] | str,
    policy: Any,
    n_episodes: int,
    dataset_id: str,
    *,
    seed: int | None = None,
    deterministic: bool = True,
    overwrite: bool = False,
    algorithm_name: str | None = None,
    description: str | None = None,
    cost_key: str | None = None,
    max_episode_steps: int | None = None,
    resume: bool = True,
) -> MinariDataset:
    """Runs a policy and records what happens, as safely as :class:`mpcoffline.MinariRecorder`.

    A recording that was interrupted goes on, with a warning, with the episode after the last one finished; with a seed
    the result is the same as without the interruption. It goes on only where it is the same one: the policy (its name
    and its code; not the numbers in it), the environment with its arguments, the seed, and the number of episodes.
    Another one is kept elsewhere, which a warning says, and recording starts anew. Of an episode under way, 4096 steps
    at most are lost; going on begins it again, while :func:`repair` keeps it as one that was cut off.

    What is recorded is what the plant sees and pays, in its units: the reward below wrappers that change it, and
    -``info["cost"]`` in its place where the two are the same in float32. Where they are not, that key means something
    else (a violated limit, as in safe RL), and the reward counts, which a warning says once. Wrappers that rescale
    observations or actions are refused; those that add to them, stack or flatten them are recorded as they give them.

    Args:
        env: The environment or its id; not a vector environment.
        policy: Anything with SB3's ``predict``, or a function from an observation ``(ny,)`` to an action ``(nu,)``. An
            agent that learned under ``VecNormalize`` gets its observations normalised where it has the statistics.
        n_episodes: Number of episodes.
        dataset_id: Minari id of the new data set.
        seed: Episode i starts from ``env.reset(seed=seed + i)``.
        deterministic: Passed to ``predict``.
        overwrite: Whether an existing data set of this id may be replaced.
        algorithm_name: Stored as metadata; the name of the policy's class by default.
        description: Stored as metadata.
        cost_key: The key of ``info`` that *is* the stage cost, minus the plant's reward; by default ``"cost"``, where
            it proves to be. A key that is named must be there and equal at each step.
        max_episode_steps: Steps after which an episode is one without end, an error; by default 10,000, or the
            environment's own limit where that is larger.
        resume: False deletes what an interrupted recording of this id has left instead of continuing it: where numbers
            in the policy have changed, a gain or weights.

    Returns:
        The stored data set.

    Raises:
        InvalidArgumentError: For a bad id, spaces that cannot be stored, another recorder at work on it, fewer than one
            episode, a policy of other spaces, or wrappers that rescale. For an action outside the action space, an
            episode without end, or a ``cost_key`` that is not there: the episodes before are kept then.
        InvalidDataError: Where ``cost_key`` is not minus the reward; the episodes before are kept.
        UnknownIdError: For an environment id that is not registered.
        StorageError: Where the disk refuses; the episodes before are kept.
    """
    check_integers(1, n_episodes=n_episodes)
    first_seed = None if seed is None else checked_seed("seed", seed)
    made = opened(env)
    check_spaces(policy, made, narrower=True)
    check_units(made)
    actor = in_units(policy)
    cap, rule = step_cap(made, max_episode_steps), PlantInfo("record", cost_key)
    # Wrappers that change no space add nothing to what is recorded, and not all can be rebuilt.
    plant = plant_of(made)
    wrappers = (made.observation_space, made.action_space) != (plant.observation_space, plant.action_space)
    recording = Recording(
        dataset_id,
        env_spec=plain_spec(made.spec, wrappers=wrappers),
        observation_space=made.observation_space,
        action_space=made.action_space,
        mode="replace" if overwrite else "new",
        algorithm_name=algorithm_name or getattr(policy, "__name__", type(policy).__name__),
        description=description,
        origin=policy_origin(policy, made, int(n_episodes), first_seed, deterministic),
        resume=resume,
        leftover="aside",
        keep_cut=False,
    )
    recording.tell_resumed("record")
    on_piece = partial(recording.append_piece, 0)
    try:
        for number in range(recording.resumed, n_episodes):
            episode_seed = None if first_seed is None else first_seed + number
            episode = run_episode(made, actor, number, episode_seed, deterministic, rule, cap, on_piece)
            recording.append(0, episode, complete=True)
        return recording.seal()
    finally:
        recording.close()
        if isinstance(env, str):
            made.close()


def dataset_from_arrays(
    dataset_id: str,
    episodes: Iterable[tuple[ArrayLike, ArrayLike, ArrayLike]],
    *,
    action_low: ArrayLike = -np.inf,
    action_high: ArrayLike = np.inf,
    terminated: Sequence[bool] | None = None,
    description: str | None = None,
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
        overwrite: Whether an existing data set of this id may be replaced.

    Raises:
        InvalidArgumentError: For a bad id, or one that exists.
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
            _episode(s.astype(state_type), a.astype(action_type), s, cost, end)
            for (s, a, cost), end in zip(checked, ends, strict=True)
        ),
        env_spec=None,
        observation_space=spaces.Box(-np.inf, np.inf, (ny,), state_type),
        action_space=spaces.Box(low, high, (nu,), action_type),
        description=description,
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


def _episode(
    observations: NDArray[Any], actions: NDArray[Any], state: NDArray[Any], cost: NDArray[Any], terminated: bool
) -> EpisodeBuffer:
    from minari.data_collector import EpisodeBuffer

    last = np.arange(len(actions)) == len(actions) - 1
    columns: dict[str, Any] = {
        "observations": observations,
        "actions": actions,
        "rewards": -cost,
        "terminations": last & terminated,
        "truncations": last & (not terminated),
        "infos": {"cost": np.concatenate([[0.0], cost])[:, None], "state": state},
    }
    return EpisodeBuffer(**columns)


def from_csv(
    path: str | Path,
    *,
    observations: Sequence[str],
    actions: Sequence[str],
    cost: Cost | str,
    episode: str | None = None,
    time: str | None = None,
    dt: float | None = None,
    split_gaps: bool = False,
    delimiter: str = ",",
    dataset_id: str | None = None,
    overwrite: bool = False,
) -> TransitionTable:
    """Reads the log of a real plant: a text table with a header, one row a sampling instant.

    Row k holds the observation s_k and the action a_k that acts until row k+1; so the last row of an episode gives
    only the s+ of the one before it, and episodes end cut off, not terminated.

    Args:
        path: The file.
        observations: Names of the columns of s, ``ny``.
        actions: Names of the columns of a, ``nu``.
        cost: L(s, a) for arrays ``(n, ny)`` and ``(n, nu)``, giving ``(n,)``; or the name of a column.
        episode: Name of a column that says which episode a row belongs to (any text); by default all are one.
        time: Name of the column of the time in seconds, to check the sampling time.
        dt: The sampling time in seconds; rows must be this far apart, to 1 %.
        split_gaps: Whether a row at another distance begins a new episode instead of being an error.
        delimiter: What separates columns.
        dataset_id: Also stores the log as a Minari data set of this id.
        overwrite: Whether an existing data set of this id may be replaced.

    Returns:
        The transitions.

    Raises:
        InvalidArgumentError: For ``time`` without ``dt`` or the reverse, no columns, or a bad id or one that exists.
        InvalidDataError: For a missing column, a cell that is not a finite number, rows that do not follow each other
            by ``dt``, an episode in two pieces, or costs of another shape; names line and column.
    """
    if (time is None) != (dt is None) or (dt is not None and not dt > 0.0):
        raise InvalidArgumentError("time, dt", expected="both or neither, dt > 0", actual=f"{time!r}, {dt}")
    if not observations or not actions or isinstance(observations, str) or isinstance(actions, str):
        raise InvalidArgumentError(
            "observations, actions", expected="lists of column names", actual=f"{observations!r}, {actions!r}"
        )
    name = f"file {path}"
    numbers = [*observations, *actions, *([time] if time else []), *([cost] if isinstance(cost, str) else [])]
    values, labels, lines = _read(Path(path), name, numbers, episode, delimiter)
    starts = _starts(name, labels, lines, episode)
    ny, nu = len(observations), len(actions)
    if dt is not None:
        gaps = np.diff(values[:, ny + nu])
        wrong = (np.abs(gaps - dt) > 0.01 * dt) & ~starts[1:]
        if wrong.any() and not split_gaps:
            row = int(np.flatnonzero(wrong)[0]) + 1
            raise InvalidDataError(
                f"{name}, line {lines[row]}: {time}",
                expected=f"{dt:g} s more than the row before",
                actual=f"{gaps[row - 1]:g} s ({int(wrong.sum())} such rows)",
                hint="Name the column that tells episodes apart, or pass split_gaps=True.",
            )
        starts[1:] |= wrong
    goes_on = np.flatnonzero(~starts[1:])
    if len(goes_on) == 0:
        raise InvalidDataError(name, expected="two rows of one episode", actual=f"{len(values)} rows in as many")
    s, a = values[:, :ny], values[:, ny : ny + nu]
    costs = (
        values[goes_on, -1] if isinstance(cost, str) else real_numbers(name, "cost(s, a)", cost(s[goes_on], a[goes_on]))
    )
    if costs.shape != goes_on.shape or not np.isfinite(costs).all():
        bad = costs.shape == goes_on.shape
        where = f", line {lines[goes_on[np.flatnonzero(~np.isfinite(costs))[0]]]}" if bad else ""
        raise InvalidDataError(
            f"{name}{where}: cost(s, a)",
            expected=f"finite numbers of shape {goes_on.shape}",
            actual=str(costs[~np.isfinite(costs)][0]) if bad else f"shape {costs.shape}",
        )
    ids = np.cumsum(starts) - 1
    table = TransitionTable.from_arrays(
        s[goes_on], a[goes_on], costs, s[goes_on + 1], np.zeros(len(goes_on)), ids[goes_on], name=name
    )
    if dataset_id is not None:
        pieces = [goes_on[ids[goes_on] == i] for i in np.unique(ids[goes_on])]
        order = np.searchsorted(goes_on, np.concatenate(pieces))
        ends = np.cumsum([len(piece) for piece in pieces])
        parts = np.split(costs[order], ends[:-1])
        dataset_from_arrays(
            dataset_id,
            [(s[k[0] : k[-1] + 2], a[k], c) for k, c in zip(pieces, parts, strict=True)],
            description=f"Log {Path(path).name}.",
            overwrite=overwrite,
        )
    return table


def _read(
    path: Path, name: str, columns: list[str], episode: str | None, delimiter: str
) -> tuple[NDArray[np.float64], list[str], list[int]]:
    """Numbers ``(n, len(columns))``, each row's episode, and its line in the file."""
    rows: list[list[float]] = []
    labels: list[str] = []
    lines: list[int] = []
    with path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file, delimiter=delimiter)
        try:
            header = [cell.strip() for cell in next(reader, [])]
            places = []
            for column in [*columns, *([episode] if episode else [])]:
                if header.count(column) != 1:
                    raise InvalidDataError(
                        f"{name}, line 1: column {column!r}",
                        expected=f"one of that name among {', '.join(header) or '(none)'}",
                        actual=str(header.count(column)),
                    )
                places.append(header.index(column))
            for row in reader:
                if not row:
                    continue
                if len(row) != len(header):
                    raise InvalidDataError(
                        f"{name}, line {reader.line_num}", expected=f"{len(header)} columns", actual=str(len(row))
                    )
                rows.append([_number(name, reader.line_num, c, row[i]) for c, i in zip(columns, places, strict=False)])
                labels.append(row[places[-1]].strip() if episode else "")
                lines.append(reader.line_num)
        except (csv.Error, UnicodeDecodeError) as error:
            raise InvalidDataError(
                f"{name}, line {reader.line_num + 1}", expected="a text table", actual=str(error)
            ) from error
    if not rows:
        raise InvalidDataError(name, expected="at least two rows", actual="none")
    return np.array(rows), labels, lines


def _number(name: str, line: int, column: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InvalidDataError(f"{name}, line {line}: column {column!r}", expected="a finite number", actual=repr(cell))
    return value


def _starts(name: str, labels: list[str], lines: list[int], episode: str | None) -> NDArray[np.bool_]:
    """Whether each row begins an episode, ``(n,)``."""
    starts = np.array([True, *(b != a for a, b in itertools.pairwise(labels))])
    seen: set[str] = set()
    for row in np.flatnonzero(starts):
        if labels[row] in seen:
            raise InvalidDataError(
                f"{name}, line {lines[row]}: column {episode!r}",
                expected="the rows of an episode in one piece",
                actual=f"episode {labels[row]!r} again",
            )
        seen.add(labels[row])
    return starts
