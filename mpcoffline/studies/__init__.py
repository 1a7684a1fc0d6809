"""The experiments of arXiv:2301.01667, each as data -> table -> figure."""

from __future__ import annotations

from .main_job import run_task
from .reproduction import reproduce
from .results import ControllerResult, TaskResult

__all__ = ["ControllerResult", "TaskResult", "reproduce", "run_task"]
