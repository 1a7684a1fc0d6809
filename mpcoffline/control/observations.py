"""What a policy is given to see, checked; and the spaces of what it sees and sets."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.mpc import MPC


def spaces_of(
    mpc: MPC, observation_space: spaces.Box | None, action_space: spaces.Box | None
) -> tuple[spaces.Box, spaces.Box]:
    """The spaces of a policy of this MPC; by default unbounded observations, and float32 inputs in their bounds.

    Raises:
        InvalidArgumentError: For spaces of other sizes than the MPC's observations and inputs.
    """
    if observation_space is None:
        observation_space = spaces.Box(-np.inf, np.inf, (mpc.ny,), np.float32)
    if action_space is None:
        with np.errstate(over="ignore"):  # a bound beyond float32 is none
            low, high = (np.asarray(bound, dtype=np.float32) for bound in (mpc.action_low, mpc.action_high))
        action_space = spaces.Box(low, high, dtype=np.float32)
    for name, space, size in (
        ("observation_space", observation_space, mpc.ny),
        ("action_space", action_space, mpc.nu),
    ):
        if not isinstance(space, spaces.Box) or space.shape != (size,):
            raise InvalidArgumentError(name, expected=f"a Box of shape ({size},), as in the MPC", actual=str(space))
    return observation_space, action_space


def checked_observation(
    observation: ArrayLike | dict[str, NDArray[Any]], size: int, *, may_lack: int = 0
) -> NDArray[np.float64]:
    """One observation ``(size,)`` or several ``(B, size)`` as float64.

    Args:
        observation: What the environment gave.
        size: Of an observation.
        may_lack: How many of its entries, the first ones, may be NaN.

    Raises:
        InvalidArgumentError: For dictionaries, other shapes, and numbers that are not finite.
    """
    expected = f"shape ({size},) or (B, {size})"
    try:
        array = np.asarray(cast(ArrayLike, observation), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(
            "observation",
            expected=f"an array of {expected}",
            actual=f"{type(observation).__name__}: {error}",
            hint="Gymnasium's reset() returns observation and info, a VecEnv's the observations alone.",
        ) from error
    if array.ndim not in (1, 2) or array.shape[-1] != size or not array.size:
        raise InvalidArgumentError(
            "observation",
            expected=expected,
            actual=f"shape {array.shape}",
            hint="Is the policy used in the environment that its MPC models?",
        )
    wrong = ~np.isfinite(array)
    wrong[..., :may_lack] &= ~np.isnan(array[..., :may_lack])
    if wrong.any():
        first = tuple(np.argwhere(wrong)[0].tolist())
        raise InvalidArgumentError(
            "observation", expected="finite numbers", actual=f"{array[first]} at index {list(first)} of {array}"
        )
    return array
