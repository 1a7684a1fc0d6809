"""From a log to a controller that one dares to switch on: check, tune, and learn from a trial."""

from __future__ import annotations

from mpcoffline.diagnostics.trial import Calibration

from .log_check import check_log
from .page import LogCheck, Remark
from .retuning import Retuned, retune
from .tuned import Tuned
from .tuning import tune

__all__ = ["Calibration", "LogCheck", "Remark", "Retuned", "Tuned", "check_log", "retune", "tune"]
