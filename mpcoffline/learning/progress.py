"""How the regressions report: one call an epoch."""

from __future__ import annotations

from collections.abc import Callable

Metrics = dict[str, float]
#: Called as ``report(steps_done, steps_total, metrics)`` at the end of each epoch.
OnEpoch = Callable[[int, int, Metrics], None]


def silent(steps_done: int, steps_total: int, metrics: Metrics) -> None:
    """A report that says nothing."""
