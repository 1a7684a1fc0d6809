"""Episodes as other tools keep them, to transitions: one place for what they leave out.

Many tools keep as many observations as actions. Then nobody knows the s+ of an episode's last action, and that
transition is left out, where an end was terminal, too: an invented s+ would be taken for what the plant did.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.core.types import Array
from mpcoffline.datasets.recording.from_csv import Cost
from mpcoffline.datasets.store.names import checked_names
from mpcoffline.datasets.table.numbers import real_numbers
from mpcoffline.datasets.table.transitions import TransitionTable


class Steps(NamedTuple):
    """Some steps that follow each other.

    Attributes:
        observations: ``(T+1, ny)``, or ``(T, ny)`` where the last one is not kept.
        actions: ``(T, nu)``.
        costs: ``(T,)``; None where they are computed.
        terminated: Whether the last action ended in a terminal state.
    """

    observations: ArrayLike
    actions: ArrayLike
    costs: ArrayLike | None
    terminated: bool = False


def from_episodes(
    episodes: Iterable[Sequence[Any]],
    *,
    cost: Cost | None = None,
    terminated: Sequence[bool] | None = None,
    names: Sequence[str] = (),
    name: str = "episodes",
) -> TransitionTable:
    """Trajectories as arrays, one episode after another: simulations with acados or CasADi, and of one's own.

    :func:`~mpcoffline.datasets.dataset_from_arrays` stores the same as a Minari data set.

    Example:
        >>> table = from_episodes([(simX, simU)], cost=lambda x, u: x[:, 0] ** 2 + 0.1 * u[:, 0] ** 2)

    Args:
        episodes: For each episode its observations ``(T+1, ny)``, actions ``(T, nu)`` and, without ``cost``, costs
            ``(T,)``: a cost, not a reward. Of ``(T, ny)`` observations the last action is left out, as it leads
            nowhere. One column may be ``(T,)``; columns of CasADi, ``(T, n, 1)``, count as ``(T, n)``.
        cost: L(s, a) for arrays ``(T, ny)`` and ``(T, nu)``, giving ``(T,)``.
        terminated: For each episode, whether it ended in a terminal state; otherwise it was cut off there.
        names: What the columns are called, observations first; none by default.
        name: What error messages call the data.

    Raises:
        InvalidArgumentError: For another number of ``terminated`` or ``names``, or neither costs nor ``cost``.
        InvalidDataError: For a wrong shape, NaN or inf; names episode and step.
    """
    given = [tuple(each) for each in episodes]
    ends = [False] * len(given) if terminated is None else [bool(each) for each in terminated]
    if len(ends) != len(given):
        raise InvalidArgumentError("terminated", expected=f"{len(given)} values", actual=str(len(ends)))
    wanted = (2, 3) if cost is not None else (3,)
    for i, each in enumerate(given):
        if len(each) not in wanted:
            raise InvalidArgumentError(
                f"{name}, episode {i}",
                expected="observations, actions" + (" and costs" if cost is None else ""),
                actual=f"{len(each)} arrays",
                hint="cost= computes costs." if cost is None else "",
            )
    pieces = (Steps(s, a, costs[0] if costs else None, e) for (s, a, *costs), e in zip(given, ends, strict=True))
    table = table_of(name, pieces, cost)
    table.names = checked_names(name, names, table.ny + table.nu) if names else ()
    longest = int(table.episodes.lengths.max())
    if table.ny == table.nu + 1 and longest < table.nu:  # what (nx, T+1) and (nu, T) look like where nx = nu + 1
        warnings.warn(
            f"{name}: read as episodes of at most {longest} steps, {table.ny} observations and {table.nu} actions each."
            " If these are one column a step, as in CasADi, transpose them.",
            stacklevel=2,
        )
    return table


def table_of(
    name: str, pieces: Iterable[Steps], cost: Cost | None = None, *, continuous: bool = False
) -> TransitionTable:
    """The transitions of some pieces, each an episode.

    Args:
        name: What error messages call the data.
        pieces: What another tool kept.
        cost: L(s, a), in place of the pieces' own.
        continuous: Whether integers among the actions mean that they are numbers of choices.

    Raises:
        InvalidDataError: For what is no run of steps of vectors; names the episode.
    """
    parts: list[tuple[NDArray[Any], ...]] = []
    n_lost = 0
    for i, piece in enumerate(pieces):
        where = f"{name}, episode {i}"
        s = vectors(where, "observations", piece.observations)
        a = vectors(where, "actions", piece.actions, continuous=continuous)
        _check_lengths(where, s, a)
        n = min(len(a), len(s) - 1)
        n_lost += piece.terminated and n < len(a)
        if n < 1:
            continue
        if parts and (s.shape[1], a.shape[1]) != (parts[0][0].shape[1], parts[0][1].shape[1]):
            expected = f"{parts[0][0].shape[1]} observations and {parts[0][1].shape[1]} actions, as before"
            raise InvalidDataError(where, expected=expected, actual=f"{s.shape[1]} and {a.shape[1]}")
        costs = costs_of(where, s[: len(a)], a, cost, piece.costs)
        ended = (np.arange(n) == len(a) - 1) & piece.terminated
        parts.append((s[:n], a[:n], costs[:n], s[1 : n + 1], ended, np.full(n, i)))
    if not parts:
        raise InvalidDataError(name, expected="an episode of two observations or more", actual="none")
    if n_lost:
        warnings.warn(
            f"{name}: {n_lost} episodes terminated, and the observation that they reached is not kept: their last"
            " transitions are left out, and what an end costs is not learned.",
            stacklevel=3,
        )
    s, a, costs, s_next, terminations, ids = (np.concatenate(each) for each in zip(*parts, strict=True))
    return TransitionTable.from_arrays(s, a, costs, s_next, terminations, ids, name=name)


def costs_of(where: str, s: Array, a: Array, cost: Cost | None, given: ArrayLike | None) -> Array:
    """L of some steps, ``(T,)``: computed from ``(T, ny)`` and ``(T, nu)``, or as given, ``(T,)`` or ``(T, 1)``.

    Raises:
        InvalidDataError: For another shape.
    """
    column = "costs" if cost is None else "cost(s, a)"
    costs = real_numbers(where, column, ([] if given is None else given) if cost is None else cost(s, a))
    if costs.shape == (len(a), 1):
        costs = costs[:, 0]
    if costs.shape != (len(a),):
        raise InvalidDataError(f"{where}: {column}", expected=f"shape ({len(a)},)", actual=str(costs.shape))
    return costs


def vectors(where: str, column: str, values: ArrayLike, *, continuous: bool = False) -> Array:
    """One vector a step, ``(T, n)``, in float64.

    Raises:
        InvalidDataError: For images, for integers where numbers of a continuous action are needed, and for anything
            else that is no array of numbers.
    """
    array = real_numbers(where, column, values)
    kind = np.asarray(values).dtype
    if continuous and kind.kind not in "f":
        raise InvalidDataError(
            f"{where}: {column}",
            expected="a continuous action: numbers of type float",
            actual=f"{kind} of shape {array.shape}, the numbers of discrete actions?",
            hint="An MPC sets continuous inputs. If these numbers are what the plant gets, convert them to float.",
        )
    if array.ndim == 3 and array.shape[2] == 1 and kind != np.uint8:  # columns of CasADi
        array = array[:, :, 0]
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[1] < 1:
        raise InvalidDataError(
            f"{where}: {column}",
            expected="one vector a step, shape (T, n)",
            actual=f"{kind} of shape {array.shape}" + (", images?" if array.ndim > 2 else ""),
            hint="An MPC's model predicts states: pass those of the plant." if array.ndim > 2 else "",
        )
    return array


def _check_lengths(where: str, s: Array, a: Array) -> None:
    if len(s) in (len(a), len(a) + 1):
        return
    turned = s.shape[1] in (len(a), len(a) + 1, a.shape[1], a.shape[1] + 1)
    raise InvalidDataError(
        f"{where}: observations",
        expected=f"{len(a) + 1} rows, with {len(a)} actions",
        actual=f"{len(s)}, of shape {s.shape}",
        hint="One row a step: transpose what is one column a step, as in CasADi." if turned else "",
    )
