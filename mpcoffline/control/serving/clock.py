"""The time of a loop: the computer's, or one that only moves when it is told to, for tests and simulations."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

T = TypeVar("T")

_LEAST = 1e-4  # s that a call is always waited for


class Clock(Protocol):
    """A time that a loop can read, wait for, and limit calls by."""

    def now(self) -> float:
        """Seconds, from anywhere; it never goes back."""

    def epoch(self) -> float:
        """Seconds since 1970, UTC."""

    def sleep_until(self, t: float) -> None:
        """Returns at a time of :meth:`now`; at once where that is over."""

    def call(self, name: str, function: Callable[[], T], until: float) -> T:
        """What a function returns, if it does so in time.

        Args:
            name: What the function does; of one name only one is under way.
            function: The function.
            until: A time of :meth:`now`.

        Raises:
            TimeoutError: If it takes longer, or the one before of that name is still under way. It is left to itself.
        """


class SystemClock:
    """The computer's clock. Calls run in threads of their own, since nothing else can leave a call that hangs."""

    def __init__(self) -> None:
        self._running: dict[str, threading.Thread] = {}

    def now(self) -> float:
        """Seconds of the monotonic clock."""
        return time.monotonic()

    def epoch(self) -> float:
        """Seconds since 1970."""
        return time.time()

    def sleep_until(self, t: float) -> None:
        """Sleeps."""
        left = t - time.monotonic()
        if left > 0.0:
            time.sleep(left)

    def call(self, name: str, function: Callable[[], T], until: float) -> T:
        """See :class:`Clock`."""
        before = self._running.get(name)
        if before is not None:
            before.join(max(_LEAST, until - self.now()))
            if before.is_alive():
                raise TimeoutError(f"{name}: the call before is still under way")
        found: list[tuple[bool, Any]] = []

        def run() -> None:
            try:
                found.append((True, function()))
            except BaseException as error:
                found.append((False, error))

        thread = threading.Thread(target=run, name=name, daemon=True)
        self._running[name] = thread
        thread.start()
        thread.join(max(_LEAST, until - self.now()))
        if not found:
            raise TimeoutError(f"{name}: no answer in time")
        done, what = found[0]
        if not done:
            raise what
        answer: T = what
        return answer


class VirtualClock:
    """A clock that stands still but for :meth:`advance` and waiting: nothing is slept, everything can be repeated.

    Args:
        epoch: Seconds since 1970 at its begin.
    """

    def __init__(self, epoch: float = 0.0) -> None:
        self._now, self._begin = 0.0, epoch

    def now(self) -> float:
        """Seconds since its begin."""
        return self._now

    def epoch(self) -> float:
        """Seconds since 1970."""
        return self._begin + self._now

    def advance(self, seconds: float) -> None:
        """Lets time pass, as a call that takes some does."""
        self._now += seconds

    def sleep_until(self, t: float) -> None:
        """Lets time pass until then."""
        self._now = max(self._now, t)

    def call(self, name: str, function: Callable[[], T], until: float) -> T:
        """See :class:`Clock`; what takes longer has been left when its time was over."""
        begin = self._now
        try:
            return function()
        finally:
            if self._now > until:
                self._now = max(begin, until)
                raise TimeoutError(f"{name}: no answer in time")
