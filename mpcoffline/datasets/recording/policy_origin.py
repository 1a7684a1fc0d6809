"""What makes a recording of a policy this one and no other, so that it is continued by the same one only."""

from __future__ import annotations

import zlib
from types import CodeType
from typing import Any

import gymnasium as gym


def policy_origin(
    policy: Any, env: gym.Env[Any, Any], n_episodes: int, seed: int | None, deterministic: bool
) -> dict[str, Any]:
    """The policy, the plant, and the arguments on which the episodes depend, by the names that messages use."""
    return {
        "policy": policy_name(policy),
        "plant": type(env.unwrapped).__qualname__,
        "number of episodes": n_episodes,
        "seed": seed,
        "deterministic": deterministic,
    }


def policy_name(policy: Any) -> str:
    """A policy's name and a checksum of its code, with which a corrected policy is another one.

    Numbers in it, such as gains and weights, are not looked at.

    Args:
        policy: A function, or anything with ``predict`` or ``__call__``.
    """
    named = policy if hasattr(policy, "__qualname__") else type(policy)
    parts = [policy, *(getattr(type(policy), name, None) for name in ("predict", "__call__"))]
    codes = [part.__code__ for part in parts if isinstance(getattr(part, "__code__", None), CodeType)]
    checksum = f" (code {zlib.crc32(repr([_content(code) for code in codes]).encode()):08x})" if codes else ""
    return f"{named.__qualname__}{checksum}"


def _content(code: CodeType) -> list[Any]:
    """What the code does, without where it stands: equal in every process of one version of Python."""
    constants = [
        _content(c) if isinstance(c, CodeType) else sorted(map(repr, c)) if isinstance(c, frozenset) else repr(c)
        for c in code.co_consts
    ]
    return [code.co_code, code.co_names, constants]
