"""Transitions of data of robots (LeRobot, RLDS) and of do-mpc's simulations.

None of these packages is imported: what looks like their objects is read. Nothing that is loaded runs code, so there
is no reader of pickles: what loads one, as ``do_mpc.data.load_results``, is the user's to call.
"""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.core.types import Array
from mpcoffline.datasets.logs.sources import polars
from mpcoffline.datasets.recording.from_csv import Cost
from mpcoffline.datasets.table.numbers import real_numbers
from mpcoffline.datasets.table.transitions import TransitionTable

from .episodes import Steps, table_of, vectors

_APART = 0.01  # of a sampling time, by which rows may be off


def from_do_mpc(data: Any, *, cost: Cost | str, observations: Sequence[str] = ("_x",)) -> TransitionTable:
    """What do-mpc's simulator or controller has stored, as ``simulator.data`` or ``mpc.data``.

    Row k of ``_x`` and ``_u`` holds the state and the input that acts on it, so the last row of a simulation only
    gives the s+ of the one before. ``_y`` of a simulator is measured *after* the step, and is moved by a row. Where
    ``_time`` does not go on by the usual step, as after ``x0`` and ``t0`` were set anew, an episode begins.

    Example:
        >>> results = do_mpc.data.load_results("results/001_run.pkl")  # runs what the file says: only your own
        >>> table = from_do_mpc(results["simulator"], cost="stage cost")

    Args:
        data: The stored data, or a list of several.
        cost: L(s, a) for arrays ``(T, ny)`` and ``(T, nu)``, giving ``(T,)``; or the name of an auxiliary expression
            of the do-mpc model (``model.set_expression``), which is one of state and input of the same row.
        observations: The fields that are the observation: ``"_x"``, ``"_y"``, ``"_tvp"``, ``"_p"``, ``"_z"``.

    Raises:
        InvalidArgumentError: For anything else.
        InvalidDataError: For fewer than two rows, or NaN.
    """
    several = list(data) if isinstance(data, list | tuple) else [data]

    def field(each: Any, name: str, *index: str) -> Array:
        try:
            values = np.asarray(each[(name, *index)] if index else getattr(each, name), dtype=np.float64)
        except Exception as error:  # whatever do-mpc raises, assertions too
            actual, expected = f"{type(each).__name__}: {error!r:.80}", f"stored data of do-mpc with {name!r}"
            raise InvalidArgumentError("data", expected=" ".join([expected, *index]), actual=actual) from error
        return values

    def pieces() -> Iterator[Steps]:
        for each in several:
            u, time = field(each, "_u"), field(each, "_time").reshape(-1)
            costs = np.asarray(field(each, "_aux", cost)).reshape(-1) if isinstance(cost, str) else None
            columns = {name: field(each, name) for name in observations}
            if any(len(v) != len(u) for v in [*columns.values(), time, *([] if costs is None else [costs])]):
                sizes = ", ".join(f"{name} {len(v)}" for name, v in columns.items())
                raise InvalidArgumentError("data", expected=f"{len(u)} rows in each field, as in _u", actual=sizes)
            begins = [0, *(np.flatnonzero(_jumps(time)) + 1), len(u)]
            for first, end in itertools.pairwise(begins):
                start = first + int("_y" in columns)
                seen = [v[first:end] if name == "_y" else v[start:end] for name, v in columns.items()]
                s = np.hstack([v[: min(map(len, seen))] for v in seen])
                if end - start > 0:
                    yield Steps(s, u[start:end], None if costs is None else costs[start:end])

    return table_of("do-mpc's data", pieces(), None if isinstance(cost, str) else cost)


def from_lerobot(
    frames: Any,
    *,
    observations: Sequence[str] = ("observation.state",),
    action: str = "action",
    cost: Cost | None = None,
) -> TransitionTable:
    """Frames of a LeRobot data set: its parquet files, or a table of them.

    Row k holds the observation and the action that acts until row k+1; the last frame of an episode only gives the
    s+ of the one before. The data do not tell a terminal state from a cut: all episodes are cut off.

    Args:
        frames: A parquet file or a list of them, a frame of polars, pandas or pyarrow, or ``dataset.hf_dataset``; with
            ``episode_index`` and ``frame_index``.
        observations: Columns that make up the observation, numbers or lists of them.
        action: The action's column.
        cost: L(s, a) for arrays ``(T, ny)`` and ``(T, nu)``, giving ``(T,)``; by default minus ``next.reward``.

    Raises:
        InvalidArgumentError: For anything else, or for files without polars.
        InvalidDataError: For images, discrete actions, a missing column, or NaN.
    """
    name = "LeRobot's frames"
    if isinstance(frames, str | os.PathLike) or (isinstance(frames, list | tuple) and frames):
        wanted = [*observations, action, "episode_index", "frame_index", "next.reward"]
        frames = _parquet([frames] if isinstance(frames, str | os.PathLike) else list(frames), wanted)

    def column(key: str) -> list[Any]:
        try:
            values = frames[key]
        except Exception as error:  # whatever the frame's library raises
            known = [str(each) for each in getattr(frames, "column_names", getattr(frames, "columns", []))]
            raise InvalidDataError(
                name,
                expected=f"a column {key!r}",
                actual=", ".join(known) or type(frames).__name__,
                hint="cost= computes what is minimised." if key == "next.reward" else "",
            ) from error
        listed = next((getattr(values, to) for to in ("to_pylist", "to_list") if hasattr(values, to)), None)
        cells = listed() if listed is not None else list(values)
        if any(isinstance(each, dict | bytes) for each in cells[:1]):
            hint = "An MPC's model predicts states: name columns of numbers."
            raise InvalidDataError(f"{name}: {key}", expected="numbers", actual="images", hint=hint)
        return cells

    episode, frame = (vectors(name, key, column(key))[:, 0] for key in ("episode_index", "frame_index"))
    order = np.lexsort([frame, episode])
    s = np.hstack([vectors(name, key, column(key)) for key in observations])[order]
    a = vectors(name, action, column(action), continuous=True)[order]
    costs = None if cost is not None else -vectors(name, "next.reward", column("next.reward"))[order, 0]
    breaks = (np.diff(episode[order]) != 0) | (np.diff(frame[order]) != 1)
    parts = np.split(np.arange(len(a)), np.flatnonzero(breaks) + 1)
    pieces = (Steps(s[p], a[p], None if costs is None else costs[p]) for p in parts)
    return table_of(name, pieces, cost)


def from_rlds(
    episodes: Iterable[Any], *, observations: Sequence[str] | None = None, cost: Cost | None = None
) -> TransitionTable:
    """Episodes in the layout of RLDS and Open X-Embodiment: ``steps``, each with ``is_first``, ``is_last``, ...

    The last step of an episode holds the observation that was reached; its action and reward mean nothing there. A
    reward other than zero on it, which some converters write, belongs to no transition: a warning counts these.

    Args:
        episodes: For each episode a mapping with ``steps``: mappings with ``observation``, ``action``, ``reward``,
            ``is_terminal``, one after another, or one mapping of stacked arrays. ``tfds.as_numpy(dataset)`` is that.
        observations: Keys of the observation that make it up, where it is a mapping itself.
        cost: L(s, a) for arrays ``(T, ny)`` and ``(T, nu)``, giving ``(T,)``; by default -reward.

    Raises:
        InvalidArgumentError: For anything else, or for a mapping of observations without ``observations``.
        InvalidDataError: For images, discrete actions, or NaN; names the episode.
    """
    n_late = 0

    def pieces() -> Iterator[Steps]:
        nonlocal n_late
        for i, each in enumerate(episodes):
            where = f"RLDS, episode {i}"
            try:
                steps = _stacked(each["steps"])
                seen, a, ended = _seen(where, steps["observation"], observations), steps["action"], steps["is_terminal"]
                rewards = None if cost is not None else real_numbers(where, "reward", steps["reward"])
            except (KeyError, TypeError, IndexError) as error:
                expected = "steps with observation, action, reward and is_terminal"
                raise InvalidArgumentError(
                    where, expected=expected, actual=f"{type(error).__name__}: {error}"
                ) from error
            if isinstance(a, Mapping):
                expected, actual = "one array of actions", f"a mapping of {', '.join(a)}"
                raise InvalidDataError(f"{where}: action", expected=expected, actual=actual)
            a = vectors(where, "action", a, continuous=True)
            costs = None if rewards is None else -rewards.reshape(-1)[:-1]
            n_late += rewards is not None and bool(np.nan_to_num(rewards.reshape(-1)[-1:]).any())
            yield Steps(seen, a[:-1], costs, bool(np.asarray(ended).reshape(-1)[-1]))

    table = table_of("RLDS", pieces(), cost)
    if n_late:
        warnings.warn(
            f"RLDS: in {n_late} episodes the last step has a reward, which belongs to no transition: it is left out."
            " cost= computes what is minimised.",
            stacklevel=2,
        )
    return table


def _jumps(time: Array) -> NDArray[np.bool_]:
    """Where the next row is not one usual step later, ``(n - 1,)``."""
    steps = np.diff(time)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return np.asarray(np.abs(steps - usual) > _APART * abs(usual))


def _parquet(files: list[Any], wanted: list[str]) -> Any:
    """Those columns of files that are there, as one frame of polars."""
    pl = polars()
    try:
        frame = pl.scan_parquet(files)
        return frame.select([key for key in frame.collect_schema().names() if key in wanted]).collect()
    except Exception as error:  # polars has errors of its own, of the system, and of the file
        expected, actual = "parquet files of one layout", str(error).splitlines()[0][:200]
        raise InvalidArgumentError("frames", expected=expected, actual=actual) from error


def _stacked(steps: Any) -> Mapping[str, Any]:
    """Steps one after another as one mapping of arrays."""
    if isinstance(steps, Mapping):
        return steps
    rows = list(steps)
    first = rows[0]
    return {
        key: _stacked([row[key] for row in rows]) if isinstance(first[key], Mapping) else [row[key] for row in rows]
        for key in first
    }


def _seen(where: str, observation: Any, keys: Sequence[str] | None) -> Array:
    """The observations of an episode, ``(T, ny)``."""
    if isinstance(observation, Mapping):
        if keys is None:
            expected = "the keys that make up the observation"
            raise InvalidArgumentError("observations", expected=expected, actual=f"none of {', '.join(observation)}")
        return np.hstack([vectors(f"{where}: observation", key, observation[key]) for key in keys])
    return vectors(where, "observation", observation)
