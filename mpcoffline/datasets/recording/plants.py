"""What is accepted as a plant and as a policy for it, and how a plant is stored: the same for all that runs one."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import InvalidArgumentError, UnknownIdError

from .watching import PlantWatch, plant_of, wrappers_around

Env = gym.Env[Any, Any]

#: Steps after which an episode counts as one without end, in an environment without a limit of its own.
MAX_EPISODE_STEPS = 10_000


def opened(env: object) -> Env:
    """The environment, made where its id is given.

    Args:
        env: A Gymnasium environment, or the id of one, ``"module:id"`` too.

    Raises:
        UnknownIdError: For an id that is not registered.
        InvalidArgumentError: For anything else, such as a vector environment.
    """
    if isinstance(env, str):
        return made(env)
    if not isinstance(env, gym.Env):
        raise InvalidArgumentError(
            "env",
            expected="a Gymnasium environment or the id of one",
            actual=type(env).__name__,
            hint="Of a vector environment give one environment: `venv.envs[0]` of a DummyVecEnv. Its agents can be"
            " judged by stable_baselines3's evaluate_policy; evaluate steps copies together anyway.",
        )
    return env


def made(env_id: str, make: Callable[[str], Env] = gym.make) -> Env:
    """The environment of an id.

    Args:
        env_id: The id, ``"module:id"`` too.
        make: What makes it.

    Raises:
        UnknownIdError: For an id that is not registered, malformed, or no text.
    """
    try:
        if not isinstance(env_id, str):
            raise gym.error.UnregisteredEnv(f"An id is a text, not {type(env_id).__name__}.")
        return make(env_id)
    except (gym.error.Error, ModuleNotFoundError) as error:
        known = isinstance(env_id, str) and env_id in gym.registry
        if known or (isinstance(error, ModuleNotFoundError) and ":" not in env_id):
            raise  # the environment itself says so, e.g. that a package is missing
        raise UnknownIdError(
            "environment id", expected="a registered environment", actual=repr(env_id), hint=str(error)
        ) from error


def step_cap(env: Env, max_episode_steps: int | None) -> int:
    """The steps after which an episode is one without end.

    Args:
        env: The environment.
        max_episode_steps: What the user says; by default ``MAX_EPISODE_STEPS``, or the environment's own limit where
            that is larger.

    Raises:
        InvalidArgumentError: For anything but a positive integer or None.
    """
    if max_episode_steps is not None:
        check_integers(1, max_episode_steps=max_episode_steps)
        return int(max_episode_steps)
    return max(MAX_EPISODE_STEPS, (env.spec.max_episode_steps or 0) if env.spec is not None else 0)


def no_end(name: str, cap: int) -> InvalidArgumentError:
    """The error for an episode that goes on beyond ``cap`` steps."""
    return InvalidArgumentError(
        name,
        expected=f"an end within max_episode_steps={cap} steps",
        actual="none",
        hint="Give the environment a time limit, gym.make(..., max_episode_steps=...), or allow longer episodes.",
    )


def plain_spec(spec: EnvSpec | None, *, wrappers: bool = False) -> EnvSpec | None:
    """The spec as it is stored: without rendering, its arguments as JSON has them.

    Args:
        spec: The environment's.
        wrappers: Whether wrappers that were put around it stay; the time limit always does.
    """
    if spec is None:
        return None
    kwargs = {key: _plain(value) for key, value in spec.kwargs.items() if key != "render_mode"}
    steps = spec.max_episode_steps
    return replace(
        spec,
        kwargs=kwargs,
        max_episode_steps=None if steps is None else int(steps),
        additional_wrappers=spec.additional_wrappers if wrappers else (),
    )


def common_spec(name: str, specs: Sequence[EnvSpec | None]) -> EnvSpec | None:
    """The plain spec that all copies of an environment share.

    Raises:
        InvalidArgumentError: Where two copies are not the same environment with the same arguments.
    """
    plain = [plain_spec(spec) for spec in specs]
    for i, spec in enumerate(plain):
        if spec != plain[0]:
            raise InvalidArgumentError(
                f"{name}'s environments",
                expected=f"copies of one, as a data set stores the arguments of one: {_described(plain[0])}",
                actual=f"{_described(spec)} as number {i}",
                hint="Record each into a data set of its own; TransitionTable.concat makes one table of them.",
            )
    return plain[0]


def check_spaces(policy: Any, env: Any, *, narrower: bool = False) -> None:
    """Refuses an environment (or ``VecEnv``) that a policy was not made for, or cannot act in.

    A policy that says nothing of its spaces is taken at its word.

    Args:
        policy: The policy.
        env: The environment.
        narrower: Whether the policy may keep to a part of the actions; where wrappers that rescale are looked for, too.

    Raises:
        InvalidArgumentError: For spaces of another kind, shape or bounds, or gymnasium's ``NormalizeObservation``
            around an MPC.
    """
    if is_mpc(policy) and _normalises(env):
        raise InvalidArgumentError(
            "env",
            expected="observations in their units, or normalised by SB3's VecNormalize",
            actual="gymnasium.wrappers.NormalizeObservation",
            hint="Its statistics are out of an MPC's reach.",
        )
    for name in ("observation_space", "action_space"):
        own, given = getattr(policy, name, None), getattr(env, name)
        if name == "action_space" and narrower and _is_part(own, given):
            continue
        if isinstance(own, spaces.Space) and not _fits(own, given, free=name == "observation_space"):
            raise InvalidArgumentError(
                f"env.{name}",
                expected=f"the policy's {own}",
                actual=str(given),
                hint="Is the policy used in the environment that its MPC models or it learned in, without wrappers that"
                f" rescale? (Where only bounds differ, MPCPolicy(mpc, {name}=env.{name}) says that they are meant.)",
            )


def check_units(env: Env) -> None:
    """Refuses wrappers that rescale or normalise what goes into the plant or comes out of it.

    Raises:
        InvalidArgumentError: For one that shows in a space; :func:`check_unchanged` finds the others.
    """
    plant = plant_of(env)
    for name in ("observation_space", "action_space"):
        own, given = getattr(plant, name), getattr(env, name)
        same_shape = isinstance(own, spaces.Box) and isinstance(given, spaces.Box) and own.shape == given.shape
        if wrappers_around(env) and same_shape and not _fits(own, given, free=False):
            raise _rescaled(env, f"env.{name}", str(own), str(given))


def check_unchanged(env: Env, watch: PlantWatch, action: Any, observation: Any) -> None:
    """Refuses, after a step, what wrappers made of the plant's own action or observation of the same shape.

    Raises:
        InvalidArgumentError: Where there is a difference.
    """
    changed = watch.changes(action, observation)
    if changed is not None:
        what, inside, outside = changed
        raise _rescaled(env, f"env, {what}", f"the plant's own {inside}", outside)


def in_units(policy: Any) -> Any:
    """The policy for observations in their units.

    An agent that learned under ``VecNormalize`` gets them normalised with its statistics, where it has them; an MPC
    that was told to undo such a normalisation is told not to. An agent that has lost its statistics is warned of.
    """
    inner = getattr(policy, "policy", None)
    if is_mpc(policy):
        mpc_policy = policy if inner is None else inner
        undoes = getattr(mpc_policy, "_vec_normalize", None) is not None
        return mpc_policy.with_normalization(None) if undoes else policy
    ask = getattr(policy, "get_vec_normalize_env", None)
    if not callable(ask):
        return policy
    statistics = ask()
    if statistics is not None:
        return _Normalising(policy, statistics) if statistics.norm_obs else policy
    if _lost_statistics(policy):
        warnings.warn(
            f"{type(policy).__name__}: the agent learned under VecNormalize and is without its statistics, so that it"
            " sees observations that are not normalised; agent.set_env(VecNormalize.load(path, venv)) gives them back.",
            stacklevel=3,
        )
    return policy


def _lost_statistics(agent: Any) -> bool:
    """Whether an SB3 agent that was loaded alone shows that it learned under ``VecNormalize``.

    On-policy algorithms keep the original of the last observation then, and only then; the others always keep one, so
    that only a last observation beyond its space tells.
    """
    original, seen, space = (
        getattr(agent, name, None) for name in ("_last_original_obs", "_last_obs", "observation_space")
    )
    if original is None or not isinstance(space, spaces.Box):
        return False
    if not hasattr(agent, "replay_buffer_class"):
        return True
    inside = [bool(((rows >= space.low) & (rows <= space.high)).all()) for rows in (original, seen)]
    return inside == [True, False]


class _Normalising:
    """An agent behind the statistics of its ``VecNormalize``."""

    def __init__(self, agent: Any, statistics: Any) -> None:
        self._agent, self._statistics = agent, statistics

    def __getattr__(self, name: str) -> Any:
        return getattr(self._agent, name)

    def predict(self, observation: Any, *rest: Any, **more: Any) -> Any:
        return self._agent.predict(self._statistics.normalize_obs(observation), *rest, **more)


def is_mpc(policy: Any) -> bool:
    """Whether a policy is an MPC, which needs the plant's own units, or an ``MPCModel`` with one."""
    return hasattr(policy, "mpc") or hasattr(getattr(policy, "policy", None), "mpc")


def _normalises(env: Any) -> bool:
    kind = gym.wrappers.NormalizeObservation
    if isinstance(env, gym.Env):
        return any(isinstance(wrapper, kind) for wrapper in wrappers_around(env))
    return any(env.env_is_wrapped(kind))


def _fits(own: spaces.Space[Any], given: object, *, free: bool) -> bool:
    """Whether a space is the same but for rounding to float32; ``free``: no bounds at all say nothing."""
    if not isinstance(own, spaces.Box):
        return own == given
    if not isinstance(given, spaces.Box) or given.shape != own.shape:
        return False
    unknown = free and not (own.bounded_below | own.bounded_above).any()
    close = (np.allclose(a, b, rtol=1e-6, atol=0.0) for a, b in ((own.low, given.low), (own.high, given.high)))
    return unknown or all(close)


def _is_part(own: object, given: object) -> bool:
    """Whether all of a Box lies in another one, but for rounding to float32."""
    if not (isinstance(own, spaces.Box) and isinstance(given, spaces.Box) and own.shape == given.shape):
        return False
    low = (own.low >= given.low) | np.isclose(own.low, given.low, rtol=1e-6, atol=0.0)
    high = (own.high <= given.high) | np.isclose(own.high, given.high, rtol=1e-6, atol=0.0)
    return bool((low & high).all())


def _rescaled(env: Env, name: str, expected: str, actual: str) -> InvalidArgumentError:
    around = ", ".join(type(wrapper).__name__ for wrapper in wrappers_around(env))
    return InvalidArgumentError(
        name,
        expected=expected,
        actual=f"{actual} by {around}",
        hint="Scale inside the policy, so that costs, data and MPC keep the plant's units; or, where the wrapper is"
        " part of the plant, register an environment whose entry point puts it on.",
    )


def _described(spec: EnvSpec | None) -> str:
    return "an environment without spec" if spec is None else f"{spec.id} {spec.kwargs}, {spec.max_episode_steps} steps"


def _plain(value: Any) -> Any:
    """``value`` with numpy's arrays and scalars as lists and numbers."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_plain(each) for each in value) if type(value) in (list, tuple) else value
    return value
