"""Checks of what users give: each refusal names the thing, what was expected and what was found."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: A distribution of initial states: a name out of ``ControlTask.starts``, or ``(low, high)`` of a uniform one.
Start = str | Sequence[ArrayLike]


def checked_number(name: str, value: float, low: float, high: float, unit: str = "") -> float:
    """``value`` as a float.

    Raises:
        ValueError: For anything but a number from ``low`` to ``high``.
    """
    number = floats_of(value)
    if number is None or number.shape != () or not low <= number <= high:
        raise ValueError(f"{name}: expected a number from {low:g} to {high:g}{unit and ' ' + unit}, got {value!r}.")
    return float(number)


def checked_matrix(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """``value`` as a float64 array.

    Raises:
        ValueError: For another shape, or an entry that is not finite.
    """
    array = floats_of(value)
    if array is None or array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers of shape {shape}, got {value!r}.")
    return array


def checked_deviations(name: str, value: ArrayLike, n: int) -> Array:
    """Standard deviations ``(n,)`` from a scalar or one number a coordinate.

    Raises:
        ValueError: For another shape, or an entry that is negative or not finite.
    """
    array = floats_of(value)
    if array is None or array.shape not in ((), (n,)) or not (np.isfinite(array).all() and (array >= 0.0).all()):
        raise ValueError(f"{name}: expected a standard deviation >= 0, or {n} of them (one a state), got {value!r}.")
    return np.broadcast_to(array, (n,)).copy()


def checked_state(name: str, value: ArrayLike, space: spaces.Box) -> Array:
    """``value`` as a state in ``space``.

    Raises:
        ValueError: For another shape, or an entry that is not finite or out of range.
    """
    array = floats_of(value)
    if array is None:
        raise ValueError(f"{name}: expected numbers of shape {space.shape}, got {value!r}.")
    if array.shape != space.shape:
        raise ValueError(f"{name}: expected shape {space.shape}, got {array.shape}.")
    if not (np.isfinite(array).all() and (array >= space.low).all() and (array <= space.high).all()):
        raise ValueError(f"{name}: expected finite values from {space.low} to {space.high}, got {array}.")
    return array


def checked_start(
    name: str, value: Start, names: tuple[str, ...], space: spaces.Box, angle: int | None
) -> str | tuple[Array, Array]:
    """A distribution of initial states: one of ``names``, or the bounds ``(low, high)`` of a uniform one.

    Args:
        name: What the user calls it.
        value: A name, or a pair of bounds, each a scalar or ``(nx,)``.
        names: The names that the task knows.
        space: States that the task starts from.
        angle: The coordinate that wraps, whose bounds may reach half a turn beyond the space.

    Raises:
        ValueError: For an unknown name, or bounds that are no bounds, not finite or out of range.
    """
    if isinstance(value, str):
        if value not in names:
            raise ValueError(f"{name}: expected one of {names}, or bounds (low, high), got {value!r}.")
        return value
    if not isinstance(value, Sequence | np.ndarray) or len(value) != 2:
        raise ValueError(f"{name}: expected one of {names}, or bounds (low, high), got {value!r}.")
    widest = space.high.copy()
    if angle is not None:
        widest[angle] += math.pi
    wide = spaces.Box(-widest, widest, dtype=np.float64)
    low, high = (
        checked_state(f"{name}, {which}", _spread(bound, space.shape), wide)
        for which, bound in zip(("low", "high"), value, strict=True)
    )
    if (low > high).any():
        raise ValueError(f"{name}: expected low <= high in every coordinate, got low {low}, high {high}.")
    return low, high


def checked_render_mode(render_mode: str | None, modes: Sequence[str]) -> str | None:
    """``render_mode``.

    Raises:
        ValueError: For an unknown one.
    """
    if render_mode is not None and render_mode not in modes:
        raise ValueError(f"render_mode: expected None or one of {tuple(modes)}, got {render_mode!r}.")
    return render_mode


def _spread(value: ArrayLike, shape: tuple[int, ...]) -> ArrayLike:
    """A scalar repeated to ``shape``; anything else as it is."""
    return np.full(shape, value) if np.ndim(value) == 0 else value


def floats_of(value: ArrayLike) -> Array | None:
    """``value`` as a float64 array, or None for what is not made of numbers."""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        return None
    return array.astype(np.float64) if array.dtype.kind in "iuf" else None
