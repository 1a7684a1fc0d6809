"""From data to theta by plain regression; no MPC is solved here (arXiv:2301.01667)."""

from __future__ import annotations

from .regression import FitConfig, FitResult, ParameterTraining, fit_parameters
from .value import VALUE_METHODS, ValueConfig, ValueFunction, ValueTraining, fit_value

__all__ = [
    "VALUE_METHODS",
    "FitConfig",
    "FitResult",
    "ParameterTraining",
    "ValueConfig",
    "ValueFunction",
    "ValueTraining",
    "fit_parameters",
    "fit_value",
]
