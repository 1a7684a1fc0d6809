"""From a log to a controller that one dares to switch on: what log and description say of each other, and tuning."""

from __future__ import annotations

from .log_check import LogCheck, Remark, check_log
from .tuned import Tuned
from .tuning import tune

__all__ = ["LogCheck", "Remark", "Tuned", "check_log", "tune"]
