"""Callbacks of a fit, and what their answers mean."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.datasets.table.transitions import TransitionTable

if TYPE_CHECKING:
    from .learner import OfflineMPCLearner

#: Called as ``evaluator(learner, table)``; its number joins the metrics of the epoch.
Evaluator = Callable[["OfflineMPCLearner", TransitionTable], float]
#: Called as ``callback(learner, epoch, total_step)`` at the end of each epoch; False, also numpy's or torch's,
#: ends the fit there. One with a method ``on_fit_end()`` has it called when the fit ends, for whatever reason.
Callback = Callable[["OfflineMPCLearner", int, int], Any]


def check_callbacks(callbacks: Sequence[object]) -> None:
    """Refuses what cannot be called, before anything is learned.

    Raises:
        InvalidArgumentError: For one that is no function; SB3's are told how they become one.
    """
    for callback in callbacks:
        if not callable(callback):
            hint = "One of Stable-Baselines3's goes in as mpcoffline.sb3.SB3Callback(callback)."
            expected = "functions (learner, epoch, total_step)"
            raise InvalidArgumentError("callbacks", expected=expected, actual=repr(callback)[:200], hint=hint)


def asks_to_end(answer: Any) -> bool:
    """Whether a callback's answer ends the fit: one that is false. None is no answer, nor are many of them at once."""
    try:
        return answer is not None and not answer
    except (ValueError, RuntimeError):  # numpy's and torch's arrays of several
        return False
