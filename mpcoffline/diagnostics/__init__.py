"""May I trust this fit? A report on a learned MPC from its log alone."""

from __future__ import annotations

from .background import Names
from .diagnosis import diagnose
from .report import Report

__all__ = ["Names", "Report", "diagnose"]
