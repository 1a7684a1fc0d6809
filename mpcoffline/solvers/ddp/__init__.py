"""Differential dynamic programming in generated, vectorised C."""

from __future__ import annotations

from .ahead import Ahead
from .build import CompilerError
from .solver import DDPSolver

__all__ = ["Ahead", "CompilerError", "DDPSolver"]
