"""Differential dynamic programming in generated, vectorised C."""

from __future__ import annotations

from .build import CompilerError
from .solver import DDPSolver

__all__ = ["CompilerError", "DDPSolver"]
