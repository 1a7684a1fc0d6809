"""Where jobs can be done: here, in processes, through joblib, on a Ray cluster."""

from __future__ import annotations

from .joblib_pool import Joblib
from .processes import Processes
from .protocol import EXECUTORS, Executor, JobError, is_at_work, n_cpus
from .ray_cluster import Ray
from .serial import Serial

__all__ = ["EXECUTORS", "Executor", "JobError", "Joblib", "Processes", "Ray", "Serial", "is_at_work", "n_cpus"]
