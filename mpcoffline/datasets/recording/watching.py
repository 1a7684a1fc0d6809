"""Looking on while a plant is stepped: what it was given and what it paid, below all wrappers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import HumanRendering, OrderEnforcing, PassiveEnvChecker, TimeLimit

from .stage_cost import number_of, same_in_float32

Env = gym.Env[Any, Any]


def plant_of(env: Env) -> Env:
    """The environment without what was wrapped around it: what ``gym.make`` made, or what there is below all wrappers.

    Wrappers that an environment's own entry point puts on are part of the plant.
    """
    layer = env
    while isinstance(layer, gym.Wrapper):
        if isinstance(layer, OrderEnforcing | PassiveEnvChecker):  # the outermost of gym.make, but for the time limit
            return layer
        layer = layer.env
    return layer


def wrappers_around(env: Env) -> list[gym.Wrapper[Any, Any, Any, Any]]:
    """The wrappers between an environment and its plant, from the outside; time limits and windows change nothing."""
    found, layer, plant = [], env, plant_of(env)
    while layer is not plant and isinstance(layer, gym.Wrapper):
        found.append(layer)
        layer = layer.env
    return [wrapper for wrapper in found if not isinstance(wrapper, TimeLimit | HumanRendering)]


class Shadow:
    """Stands before a method of one object, until it is taken away.

    An attribute of the object, not of its class; a copy of the object gets its own, as methods are copied.

    Args:
        owner: The object.
        method: The method's name.
        call: Called in its place, with the method and what it was given.

    Raises:
        AttributeError: Where the object takes no attributes.
        TypeError: Likewise.
    """

    def __init__(self, owner: Any, method: str, call: Callable[[Callable[..., Any], tuple[Any, ...]], Any]) -> None:
        self._owner, self._method, self._call = owner, method, call
        self._original = getattr(owner, method)
        self._before = vars(owner).get(method)
        setattr(owner, method, self)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The method, with the one who watches in between."""
        original = self._original
        return self._call(lambda *given: original(*given, **kwargs) if kwargs else original(*given), args)

    def remove(self) -> None:
        """Gives the method back, unless somebody else stands before it now; harmless when repeated."""
        if vars(self._owner).get(self._method) is self:
            if self._before is None:
                delattr(self._owner, self._method)
            else:
                setattr(self._owner, self._method, self._before)


class PlantWatch:
    """Watches one environment: after each of its steps, what went into and came out of its plant.

    Nothing is changed, and no random number is drawn. An environment that cannot be watched (its methods cannot be
    shadowed) shows what it gives itself.

    Args:
        env: The environment, wrapped or not.

    Attributes:
        env: The environment.
        reward: What the plant paid in the last step; the sum where a wrapper stepped it several times.
        observation: The plant's observation after the last step.
        action: What the plant was given in the last step.
        wrapped: Whether there is something between the environment and its plant.
    """

    env: gym.Env[Any, Any]

    def __init__(self, env: Env) -> None:
        self.reward: float | None = None
        self.observation: Any = None
        self.action: Any = None
        self.env, plant = env, plant_of(env)
        self.wrapped: bool = plant is not env and bool(wrappers_around(env))
        self._depth = 0
        self._shadows: list[Shadow] = []
        try:
            self._shadows.append(Shadow(plant, "step", self._of_plant))
            if plant is not env:
                self._shadows.append(Shadow(env, "step", self._of_env))
        except (AttributeError, TypeError):  # __slots__
            self.remove()
        self._alone = plant is env

    def remove(self) -> None:
        """Stops watching; harmless when repeated."""
        for shadow in reversed(self._shadows):
            shadow.remove()
        self._shadows = []

    def changes(self, action: Any, observation: Any) -> tuple[str, str, str] | None:
        """What the wrappers changed in the last step: its name, the plant's own, and what was seen outside.

        Args:
            action: What the environment was given.
            observation: What it returned.
        """
        if not self.wrapped or self.reward is None:
            return None
        for name, inside, outside in (
            ("action", self.action, action),
            ("observation", self.observation, observation),
        ):
            if inside is outside:
                continue
            shapes = np.shape(inside), np.shape(outside)
            numbers = np.asarray(inside).dtype.kind in "biuf" and np.asarray(outside).dtype.kind in "biuf"
            if numbers and shapes[0] == shapes[1] and not same_in_float32(inside, outside):
                return name, str(inside), str(outside)
        return None

    def _of_env(self, step: Callable[..., Any], given: tuple[Any, ...]) -> Any:
        self.reward = None
        return step(*given)

    def _of_plant(self, step: Callable[..., Any], given: tuple[Any, ...]) -> Any:
        if self._alone:
            self.reward = None
        self._depth += 1
        try:
            result = step(*given)
        finally:
            self._depth -= 1
        paid = number_of(result[1])
        if self._depth == 0 and paid is not None:  # a plant may call its own step
            self.reward = paid if self.reward is None else self.reward + paid
            self.observation, self.action = result[0], given[0] if given else None
        return result


@contextmanager
def watched(env: Env) -> Iterator[PlantWatch]:
    """A :class:`PlantWatch` that ends with the block."""
    watch = PlantWatch(env)
    try:
        yield watch
    finally:
        watch.remove()
