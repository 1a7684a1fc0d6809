"""From data to theta by plain regression; no MPC is solved here (arXiv:2301.01667)."""

from __future__ import annotations

from .identification import Identification, IdentificationConfig, identify
from .regression import FitConfig, FitResult, ParameterTraining, fit_parameters
from .smoothing import NoiseEstimate, estimate_noise, identify_smoothed, smooth, with_measurement_noise
from .terminal import DistillConfig, TerminalError, fit_terminal, terminal_error
from .value import VALUE_METHODS, ValueConfig, ValueFunction, ValueTraining, fit_value
from .value_noise import Stochasticity, estimate_stochasticity

__all__ = [
    "VALUE_METHODS",
    "DistillConfig",
    "FitConfig",
    "FitResult",
    "Identification",
    "IdentificationConfig",
    "NoiseEstimate",
    "ParameterTraining",
    "Stochasticity",
    "TerminalError",
    "ValueConfig",
    "ValueFunction",
    "ValueTraining",
    "estimate_noise",
    "estimate_stochasticity",
    "fit_parameters",
    "fit_terminal",
    "fit_value",
    "identify",
    "identify_smoothed",
    "smooth",
    "terminal_error",
    "with_measurement_noise",
]
