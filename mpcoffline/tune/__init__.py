"""From a log to a controller that one dares to switch on: what log and description say of each other."""

from __future__ import annotations

from .log_check import check_log
from .page import LogCheck, Remark

__all__ = ["LogCheck", "Remark", "check_log"]
