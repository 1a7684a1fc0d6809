"""What a policy is given to see, checked."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpcoffline.core.errors import InvalidArgumentError


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
