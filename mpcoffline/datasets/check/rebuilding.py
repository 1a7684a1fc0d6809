"""Whether an environment is what its spec rebuilds: where it is not, the given one itself must be stepped."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import HumanRendering

from mpcoffline.datasets.recording.watching import wrappers_around

Env = gym.Env[Any, Any]

# Which numbers come next is the reset's business, and windows are nobody's.
_LEFT_OUT = {"_np_random", "_np_random_seed", "render_mode", "_viewer", "spec", "metadata"}
_COMPARED = (
    gym.Space, type, ModuleType, BuiltinFunctionType, str, bytes, int, float, complex, set, frozenset, np.generic,
)  # fmt: skip
_DEPTH = 7


def without_window(spec: EnvSpec) -> EnvSpec:
    """The spec, not rendered for a human: copies that step together would open a window each."""
    kwargs = {key: value for key, value in spec.kwargs.items() if (key, str(value)) != ("render_mode", "human")}
    return replace(spec, kwargs=kwargs)


def rebuilt_spec(env: Env) -> EnvSpec | None:
    """The spec from which copies of an environment can be made; None where they would be something else.

    That is so without a spec, with wrappers around it (which keep statistics, files, or cannot be rebuilt), or where
    its attributes are not those of a new one: those aside that a reset sets, and those that cannot be compared.
    """
    if env.spec is None or wrappers_around(env):
        return None
    spec = without_window(env.spec)
    try:
        with closing(gym.make(spec)) as new, closing(gym.make(spec)) as begun:
            begun.reset(seed=0)
            same = _layers(new) == _layers(env) and _limit(new) == _limit(env)
            same = same and _same_attributes(env.unwrapped, new.unwrapped, begun.unwrapped)
    except Exception:  # whatever a constructor raises that was not meant to be called again
        return None
    return spec if same else None


def _layers(env: Env) -> list[type]:
    found: list[type] = []
    layer = env
    while isinstance(layer, gym.Wrapper):
        found += [] if isinstance(layer, HumanRendering) else [type(layer)]
        layer = layer.env
    return [*found, type(layer)]


def _limit(env: Env) -> Any:
    return env.get_wrapper_attr("_max_episode_steps") if env.has_wrapper_attr("_max_episode_steps") else None


def _same_attributes(given: Env, new: Env, begun: Env) -> bool:
    a, b, c = ({k: v for k, v in vars(each).items() if k not in _LEFT_OUT} for each in (given, new, begun))
    set_by_reset = {key for key in c if key not in b or not _same(b[key], c[key], ((new, begun),))}
    compared = (a.keys() | b.keys()) - set_by_reset
    return all(key in a and key in b and _same(a[key], b[key], ((given, new),)) for key in compared)


def _same(a: Any, b: Any, within: tuple[tuple[Any, Any], ...] = ()) -> bool:
    """Whether two things that were made apart hold the same; False where that cannot be seen.

    Args:
        a: One of them.
        b: The other.
        within: What they are parts of, which may come again in them: a method's own object, or what a closure holds.
    """
    if a is b or any(a is outer and b is other for outer, other in within):
        return True
    if type(a) is not type(b) or len(within) == _DEPTH:
        return False

    def parts(x: Any, y: Any) -> bool:
        return _same(x, y, (*within, (a, b)))

    if isinstance(a, np.ndarray):
        if a.dtype == object:
            return a.shape == b.shape and parts(a.tolist(), b.tolist())
        return bool(np.array_equal(a, b, equal_nan=a.dtype.kind in "fc"))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(parts(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(parts(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, MethodType):
        return a.__func__ is b.__func__ and parts(a.__self__, b.__self__)
    if isinstance(a, FunctionType):
        held = [(f.__defaults__, f.__kwdefaults__, [c.cell_contents for c in f.__closure__ or ()]) for f in (a, b)]
        return a.__code__ is b.__code__ and parts(*held)
    if isinstance(a, _COMPARED):
        return bool(a == b) or bool(a != a and b != b)
    if isinstance(a, np.random.Generator):
        return True
    return hasattr(a, "__dict__") and bool(vars(a)) and parts(vars(a), vars(b))
