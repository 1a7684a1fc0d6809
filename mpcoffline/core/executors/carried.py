"""A function that travels to workers which others start, pickled once, and unpickled once in each of them."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from typing import Any

from .protocol import Outcome, at_work, described, outcome_of

_MOST = 4  # that a worker keeps
_kept: dict[str, Callable[[Any], Any]] = {}


class Carried:
    """A function, pickled.

    Args:
        fn: A function, or an object with ``__call__`` that can be pickled.
        dumps: Pickles it; that of cloudpickle takes functions of a script, too.

    Attributes:
        key: What tells it from others.
        content: The pickled function.
    """

    def __init__(self, fn: Callable[[Any], Any], dumps: Callable[[Any], bytes] = pickle.dumps) -> None:
        self.content: bytes = dumps(fn)
        self.key: str = hashlib.sha256(self.content).hexdigest()


def done_with(key: str, content: bytes, job: Any) -> Outcome:
    """What comes of a job in this worker; it keeps the function, and what that has built, for the next one."""
    with at_work():
        if key not in _kept:
            while len(_kept) >= _MOST:
                del _kept[next(iter(_kept))]
            try:
                _kept[key] = pickle.loads(content)
            except Exception as error:
                return Outcome(None, described(error))
        return outcome_of(_kept[key], job)
