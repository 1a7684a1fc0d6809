"""Which numbers of a plant's ``info`` are believed: one rule for all that records, evaluates and replays."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core.errors import InvalidArgumentError, InvalidDataError
from mpcoffline.core.types import Array


def number_of(value: object) -> float | None:
    """``value`` as a float where it is a number or an array of one; None for anything else."""
    if type(value) is float:
        return value
    array = _numbers(value)
    return None if array is None or array.size != 1 else float(array.reshape(()))


def reward_of(name: str, value: object) -> float:
    """The reward of a step as a float.

    Raises:
        InvalidDataError: For anything but a number or an array of one.
    """
    reward = number_of(value)
    if reward is None:
        raise InvalidDataError(f"{name}: reward", expected="a number", actual=f"{value!r:.80}")
    return reward


def same_in_float32(a: ArrayLike, b: ArrayLike) -> bool:
    """Whether numbers or arrays are the same after rounding to float32; NaN equals NaN."""
    if a is b:
        return True
    alike = isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and (a.dtype, a.shape) == (b.dtype, b.shape)
    if alike and np.asarray(a).tobytes() == np.asarray(b).tobytes():  # as at nearly every step
        return True
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array_equal(np.asarray(a, dtype=np.float32), np.asarray(b, dtype=np.float32), equal_nan=True)


class PlantInfo:
    r"""What is taken from the infos of one recording or evaluation, over all its environments and episodes.

    **Cost.** ``info["cost"]`` is the stage cost L where it is minus the reward that the plant paid,
    float32(-cost) = float32(reward): then its digits count, which a ``VecEnv`` rounds off the reward. The same key
    means something else elsewhere (a violated limit in safe RL, energy, money). So at the first step where the two
    differ, or where the key is missing or no number, the reward counts instead, from the first step of that episode on
    and until the end of the recording: no episode mixes two meanings. (Those before agree with their rewards.) That is
    told once. It is an error where ``cost_key`` claims that a key is the cost.

    **State.** ``info["state"]`` counts as long as each step gives numbers of one shape; a missing one at a reset is
    unknown. Otherwise it is left out, from that episode on, and that is told once.

    Args:
        name: Who reads, for messages.
        cost_key: The key that *is* the cost; by default ``"cost"``, where it proves to be.

    Raises:
        InvalidArgumentError: For a key that is no text.

    Attributes:
        key: The key that is looked at.
        has_cost: Whether costs of the info count; None before the first step.
        has_state: Whether states count; None before the first step.
    """

    name: str
    key: str

    def __init__(self, name: str, cost_key: str | None = None) -> None:
        if cost_key is not None and not isinstance(cost_key, str):
            raise InvalidArgumentError("cost_key", expected="the name of a key of info", actual=repr(cost_key))
        self.name, self.key = name, "cost" if cost_key is None else cost_key
        self.has_cost: bool | None = None
        self.has_state: bool | None = None
        self._claimed = cost_key is not None
        self._shape: tuple[int, ...] | None = None
        self._told: set[str] = set()

    def first_cost(self, info: Mapping[str, Any]) -> float:
        """The cost in a reset's info, NaN where there is none."""
        found = number_of(info.get(self.key))
        return math.nan if found is None else found

    def cost(self, info: Mapping[str, Any], reward: float, given: float | None = None) -> float:
        """The stage cost of a step: that of the info where it counts, else minus the reward.

        Args:
            info: The step's info.
            reward: What the plant paid.
            given: What a wrapper around the plant made of it.

        Raises:
            InvalidArgumentError: Where ``cost_key`` names a key that is not there or is no number.
            InvalidDataError: Where ``cost_key`` names a key that is not minus the reward.
        """
        found = number_of(info[self.key]) if self.key in info else None
        equal = found is not None and (found == -reward or same_in_float32(-found, reward))
        if found is not None and equal and self.has_cost is not False:
            self.has_cost = True
            return found
        if self._claimed:
            self._refuse(info, found, reward)
        if self.key in info or self.has_cost:
            was = "missing" if self.key not in info else f"{info[self.key] if found is None else found!r:.80}"
            self._tell(
                "cost",
                f"info[{self.key!r}] is {was}, and the plant paid a reward of {reward!r}: the reward counts, and"
                f" info[{self.key!r}] is left out. (cost_key= names the key that is the cost, minus the reward.)",
            )
        self.has_cost = False
        if given is not None and not same_in_float32(given, reward):
            self._tell(
                "reward", f"a wrapper makes {given!r} of the plant's reward of {reward!r}: the plant's is what counts."
            )
        return -reward

    def state(self, info: Mapping[str, Any], *, reset: bool = False) -> Array | None:
        """The state ``(nx,)``; None where there is none, or it does not count.

        Args:
            info: The info of a step or a reset.
            reset: Whether it is a reset's, where a state may be missing.
        """
        if "state" not in info and (reset or not self.has_state):
            self.has_state = self.has_state if reset else False
            return None
        found = _numbers(info.get("state"))
        found = None if found is None else np.atleast_1d(found)
        if found is not None and self._shape in (None, found.shape) and self.has_state is not False:
            self._shape = found.shape
            self.has_state = self.has_state if reset else True
            return found
        self.has_state = False
        was = f"of shape {found.shape}" if found is not None else f"{info.get('state')!r:.80}"
        expected = "numbers" if self._shape is None else f"numbers of shape {self._shape}"
        self._tell("state", f"info['state'] is {was} where each step should give {expected}: it is left out.")
        return None

    def _refuse(self, info: Mapping[str, Any], found: float | None, reward: float) -> None:
        name = f"{self.name}: info[{self.key!r}]"
        if found is None:
            actual = f"{info[self.key]!r:.80}" if self.key in info else f"the keys {sorted(map(str, info))}"
            raise InvalidArgumentError(
                name, expected="the cost at each step, since cost_key names it", actual=actual, hint="Leave it out?"
            )
        raise InvalidDataError(
            name,
            expected=f"minus the reward that the plant paid ({reward!r}), since cost_key says so",
            actual=repr(found),
            hint="Without cost_key the reward counts.",
        )

    def _tell(self, what: str, message: str) -> None:
        if what not in self._told:
            self._told.add(what)
            warnings.warn(f"{self.name}: {message}", stacklevel=2)


def _numbers(value: object) -> Array | None:
    """``value`` as a new array; None for what is not made of numbers."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):  # rows of different lengths, a tensor on another device
        return None
    return array.astype(np.float64) if array.dtype.kind in "biuf" and array.size else None
