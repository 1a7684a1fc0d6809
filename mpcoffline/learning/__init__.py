"""From data to theta by plain regression; no MPC is solved here (arXiv:2301.01667)."""

from __future__ import annotations

from .bellman.regression import FitConfig, FitResult, ParameterTraining, fit_parameters
from .terminal import DistillConfig, TerminalError, fit_terminal, terminal_error
from .value.fit import VALUE_METHODS, ValueConfig, ValueFunction, ValueMethod, ValueTraining, fit_value
from .value.noise import Stochasticity, estimate_stochasticity

__all__ = [
    "VALUE_METHODS",
    "DistillConfig",
    "FitConfig",
    "FitResult",
    "ParameterTraining",
    "Stochasticity",
    "TerminalError",
    "ValueConfig",
    "ValueFunction",
    "ValueMethod",
    "ValueTraining",
    "estimate_stochasticity",
    "fit_parameters",
    "fit_terminal",
    "fit_value",
    "terminal_error",
]
