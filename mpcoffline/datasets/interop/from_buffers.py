"""Transitions out of other libraries' buffers: plain arrays, d3rlpy, TorchRL, Stable-Baselines3.

None of these libraries is imported: what looks like their objects is read. Rewards become costs, L = -r.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError, InvalidDataError
from mpcoffline.datasets.recording.from_csv import Cost
from mpcoffline.datasets.store.hdf5_guard import check_hdf5
from mpcoffline.datasets.table.numbers import floats, real_numbers
from mpcoffline.datasets.table.transitions import TransitionTable

from .episodes import Steps, costs_of, table_of, vectors

_D3RLPY = ("2.1",)  # versions of its files


def from_dict(
    data: Mapping[str, Any], *, cost: Cost | ArrayLike | None = None, name: str = "arrays"
) -> TransitionTable:
    """Flat arrays in the layout of D4RL and DSRL, and of :func:`~mpcoffline.datasets.to_dict`.

    Without ``next_observations`` the s+ of a row is the observation of the next one, so that the last row of each
    episode is left out, as it leads nowhere. An open HDF5 file of this layout is such a mapping, too.

    ``costs`` beside ``rewards``, which in DSRL and Safety-Gymnasium count violated limits, are not what is minimised
    here, and are not read. Price them yourself: ``cost=-data["rewards"] + 10 * data["costs"]``.

    Args:
        data: ``observations (n, ny)``, ``actions (n, nu)``, ``rewards (n,)``, ``terminals (n,)``, and how episodes
            are told apart: ``timeouts (n,)``, ``episode_ids (n,)`` or ``next_observations (n, ny)``.
        cost: L(s, a) for arrays ``(n, ny)`` and ``(n, nu)``, giving ``(n,)``, or these numbers; by default -rewards.
        name: What error messages call the data.

    Raises:
        InvalidArgumentError: For missing keys.
        InvalidDataError: For images, discrete actions, NaN, or arrays that do not fit together.
    """
    wanted = ["observations", "actions", "terminals", *(["rewards"] if cost is None else [])]
    missing = [key for key in wanted if key not in data]
    if missing:
        raise InvalidArgumentError(
            name,
            expected=f"the arrays {', '.join(wanted)}",
            actual=f"no {', '.join(missing)} among {', '.join(map(str, data)) or 'none'}",
            hint="cost= says what is minimised." if missing == ["rewards"] else "",
        )
    s = vectors(name, "observations", data["observations"])
    a = vectors(name, "actions", data["actions"], continuous=True)
    if len(a) != len(s):
        raise InvalidDataError(f"{name}: actions", expected=f"{len(s)} rows, as in observations", actual=str(len(a)))
    if callable(cost):
        costs = costs_of(name, s, a, cost, None)
    else:
        costs = costs_of(name, s, a, None, -real_numbers(name, "rewards", data["rewards"]) if cost is None else cost)
    terminals = _flags(name, "terminals", data["terminals"], len(s))
    last, known = terminals.copy(), False
    if "timeouts" in data:
        last, known = last | _flags(name, "timeouts", data["timeouts"], len(s)), True
    if "episode_ids" in data:
        ids = np.asarray(data["episode_ids"])
        last[:-1] |= ids[1:] != ids[:-1]
        known = True
    if "next_observations" in data:
        s_next = vectors(name, "next_observations", data["next_observations"])
        numbers = np.concatenate([[0], np.cumsum(last[:-1])]) if known else None
        return TransitionTable.from_arrays(s, a, costs, s_next, terminals, numbers, name=name)
    if not known:
        raise InvalidArgumentError(
            name,
            expected="timeouts, episode_ids or next_observations, to tell episodes apart",
            actual=f"{', '.join(map(str, data))}",
            hint="What a time limit cut off would be taken for steps of the plant.",
        )
    cuts = np.flatnonzero(last[:-1]) + 1
    parts = zip(*(np.split(each, cuts) for each in (s, a, costs, terminals)), strict=True)
    return table_of(name, (Steps(x, u, c, bool(end[-1])) for x, u, c, end in parts))


def from_d3rlpy(data: Any, *, cost: Cost | None = None) -> TransitionTable:
    """Episodes of d3rlpy: a ``ReplayBuffer``, an ``MDPDataset``, its episodes, or an ``.h5`` file that it dumped.

    d3rlpy keeps as many observations as actions, so that the last action of an episode is left out, as it leads
    nowhere; a warning counts the terminal ones. What :func:`~mpcoffline.datasets.to_d3rlpy` made comes back whole.

    Args:
        data: The buffer, its episodes, or the file (of d3rlpy 2.1 and later, or 1.x).
        cost: L(s, a) for arrays ``(T, ny)`` and ``(T, nu)``, giving ``(T,)``; by default -reward.

    Raises:
        InvalidArgumentError: For anything else.
        InvalidDataError: For images, discrete actions, or NaN; names the episode.
        FileFormatError: For a file that is damaged, or of another kind or version.
    """
    name = "d3rlpy's buffer"
    if isinstance(data, str | os.PathLike):
        path = Path(data)
        name = f"file {path}"
        stored = _dumped(path)
        if isinstance(stored, dict):
            return from_dict(stored, cost=cost, name=name)
        episodes: Any = stored
    else:
        episodes = getattr(data, "episodes", data)
    try:
        given = [(e.observations, e.actions, e.rewards, e.terminated, e) for e in episodes]
    except (AttributeError, TypeError) as error:
        expected = "a ReplayBuffer of d3rlpy, its episodes, or a file"
        raise InvalidArgumentError("data", expected=expected, actual=type(data).__name__) from error

    def pieces() -> Iterator[Steps]:
        for i, (s, a, rewards, terminated, episode) in enumerate(given):
            where = f"{name}, episode {i}"
            if isinstance(s, list | tuple):
                expected, actual = "one array of observations", f"{len(s)} of them"
                raise InvalidDataError(f"{where}: observations", expected=expected, actual=actual)
            last = getattr(episode, "last_observation", None)  # of our own to_d3rlpy
            seen = s if last is None else np.concatenate([s, np.asarray(last)[None]])
            costs = None if cost is not None else -real_numbers(where, "rewards", rewards)
            yield Steps(seen, a, costs, bool(terminated))

    return table_of(name, pieces(), cost, continuous=True)


def from_torchrl(
    data: Any, *, observation: Any = "observation", action: Any = "action", cost: Cost | None = None
) -> TransitionTable:
    """A ``TensorDict`` in TorchRL's layout, as collectors and environments' rollouts give it, or a replay buffer of it.

    Args:
        data: Batch size ``[n]`` or ``[batch, time]``, with ``observation``, ``action`` and, below ``next``,
            ``observation``, ``reward``, ``terminated``; or a ``ReplayBuffer``. Padding (``collector/mask``) is left
            out.
        observation: Key of the observation, perhaps a nested one, ``("agents", "observation")``.
        action: Key of the action.
        cost: L(s, a) for arrays ``(n, ny)`` and ``(n, nu)``, giving ``(n,)``; by default -reward.

    Raises:
        InvalidArgumentError: For anything else, or without a needed key.
        InvalidDataError: For images, discrete actions, or NaN.
    """
    name = "TorchRL's data"
    batch = data if hasattr(data, "batch_size") and hasattr(data, "keys") else _everything(data)
    dims = len(batch.batch_size)

    def column(key: Any, *, needed: bool = True) -> Any:
        value = batch.get(key, None)
        if value is None and needed:
            keys = sorted(str(each) for each in batch.keys(True, True))
            hint = "observation= and action= name others." if key in (observation, action) else ""
            raise InvalidArgumentError(name, expected=f"the entry {key!r}", actual=", ".join(keys), hint=hint)
        if value is None:
            return None
        array = np.asarray(value.detach().cpu())
        return array.reshape(-1, *array.shape[dims:])

    s, a = column(observation), column(action)
    following = ("next", *observation) if isinstance(observation, tuple) else ("next", observation)
    mask = column(("collector", "mask"), needed=False)
    kept = slice(None) if mask is None else mask.reshape(-1)
    if cost is None:
        costs = -floats(name, "reward", column(("next", "reward")).reshape(-1), 1)[kept]
    s, s_next = (vectors(name, "observation", each[kept]) for each in (s, column(following)))
    a = vectors(name, "action", a[kept], continuous=True)
    if cost is not None:
        costs = costs_of(name, s, a, cost, None)
    terminations = column(("next", "terminated")).reshape(-1)[kept] > 0
    ended = column(("next", "done"), needed=False)
    # Rows of a ring buffer may begin in the middle of an episode: what follows what, the numbers themselves tell.
    follows = (s_next[:-1] == s[1:]).all(axis=1) & ~terminations[:-1]
    if ended is not None:
        follows &= ~(ended.reshape(-1)[kept][:-1] > 0)
    ids = np.concatenate([[0], np.cumsum(~follows)])
    return TransitionTable.from_arrays(s, a, costs, s_next, terminations, ids, name=name)


def from_sb3_replay_buffer(data: Any, *, scaled_actions: bool = True, cost: Cost | None = None) -> TransitionTable:
    """What a replay buffer of Stable-Baselines3 holds, as ``agent.replay_buffer`` after learning.

    Recording by :class:`~mpcoffline.MinariRecorder` keeps more: costs and states in float64, all episodes.

    Args:
        data: The buffer, not one that overwrites next observations (``optimize_memory_usage``).
        scaled_actions: Whether the actions are in [-1, 1], as SB3's agents keep them; they are mapped to the bounds.
        cost: L(s, a) for arrays ``(n, ny)`` and ``(n, nu)``, giving ``(n,)``; by default -reward.

    Raises:
        InvalidArgumentError: For anything else.
        InvalidDataError: For images, discrete actions, or NaN.
    """
    name = "the replay buffer"
    needed = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "pos", "full")
    missing = [each for each in needed if not hasattr(data, each)]
    if missing or getattr(data, "optimize_memory_usage", False) or isinstance(data.observations, dict):
        expected = "a plain ReplayBuffer of Stable-Baselines3 that keeps next observations"
        raise InvalidArgumentError("data", expected=expected, actual=type(data).__name__)
    order = np.roll(np.arange(len(data.observations)), -data.pos if data.full else 0)
    order = order if data.full else order[: data.pos]

    def column(values: NDArray[Any]) -> NDArray[Any]:  # (time, environments, ...): one environment after another
        return np.swapaxes(values[order], 0, 1).reshape(-1, *values.shape[2:])

    s, s_next = (vectors(name, "observations", column(each)) for each in (data.observations, data.next_observations))
    a = vectors(name, "actions", column(data.actions), continuous=True)
    if scaled_actions:
        low, high = (np.asarray(bound, dtype=np.float64) for bound in (data.action_space.low, data.action_space.high))
        a = low + 0.5 * (a + 1.0) * (high - low)
    costs = costs_of(name, s, a, cost, -real_numbers(name, "rewards", column(data.rewards)))
    done, cut = column(data.dones) > 0.0, column(data.timeouts) > 0.0
    starts = np.arange(len(s)) % max(len(order), 1) == 0
    ids = np.cumsum(starts | np.concatenate([[True], done[:-1]])) - 1
    return TransitionTable.from_arrays(s, a, costs, s_next, done & ~cut, ids, name=name)


def _flags(name: str, column: str, values: ArrayLike, n: int) -> NDArray[np.bool_]:
    flags = real_numbers(name, column, values)
    if flags.size != n or not np.isin(flags, (0.0, 1.0)).all():
        raise InvalidDataError(f"{name}: {column}", expected=f"{n} booleans", actual=f"shape {flags.shape}")
    return flags.reshape(-1) > 0.0


def _everything(data: Any) -> Any:
    """All that a replay buffer of TorchRL holds."""
    try:
        batch = data[:]
        if hasattr(batch, "batch_size") and hasattr(batch, "keys"):
            return batch
    except Exception as error:  # whatever it raises
        raise InvalidArgumentError("data", expected="a TensorDict or a buffer of it", actual=str(error)) from error
    raise InvalidArgumentError("data", expected="a TensorDict or a buffer of it", actual=type(data).__name__)


class _Stored:
    """An episode of a file."""

    def __init__(self, columns: Mapping[str, Any]) -> None:
        self.observations, self.actions = columns["observations"], columns["actions"]
        self.rewards, self.terminated = columns["rewards"], bool(columns["terminated"])


def _dumped(path: Path) -> list[_Stored] | dict[str, Any]:
    """The episodes of a file of d3rlpy; of one of its version 1, flat arrays."""
    import h5py

    check_hdf5(path)
    try:
        with h5py.File(path, "r") as file:
            if "version" not in file and {"observations", "actions", "rewards", "terminals"} <= set(file):
                arrays = {key: file[key][()] for key in ("observations", "actions", "rewards", "terminals")}
                ends = file["episode_terminals"][()] if "episode_terminals" in file else arrays["terminals"]
                return arrays | {"timeouts": (ends > 0) & ~(arrays["terminals"] > 0)}
            version = file["version"].asstr()[()] if "version" in file else "none"
            if version not in _D3RLPY:
                expected = f"a file of d3rlpy, version {' or '.join(_D3RLPY)}"
                raise FileFormatError(f"file {path}", expected=expected, actual=f"version {version}")
            keys = ("observations", "actions", "rewards", "terminated")
            count = int(file["num_episodes"][()])
            if f"observations_{count - 1}" not in file and "observations_0_0" in file:
                expected, actual = "one array of observations an episode", "several"
                raise InvalidDataError(f"file {path}", expected=expected, actual=actual)
            return [_Stored({key: file[f"{key}_{i}"][()] for key in keys}) for i in range(count)]
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, FileFormatError | InvalidDataError):
            raise
        actual = f"{type(error).__name__}: {error}"
        raise FileFormatError(f"file {path}", expected="an intact file of d3rlpy", actual=actual) from error
