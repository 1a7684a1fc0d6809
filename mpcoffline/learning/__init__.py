"""From data to theta: learning methods, and the regressions that they are made of (arXiv:2301.01667)."""

from __future__ import annotations

from .bellman.method import Bellman
from .bellman.regression import ParameterConfig, ParameterTraining, fit_parameters
from .bellman.stages import StartConfig, TerminalConfig
from .known_cost import CostConfig, known_cost
from .method import METHODS, Method
from .paper import Paper
from .stages import FitResult, Known, KnownCost, Stage, Training
from .terminal import DistillConfig, TerminalError, fit_terminal, terminal_error
from .value.fit import VALUE_METHODS, ValueConfig, ValueFunction, ValueMethod, ValueTraining, fit_value
from .value.noise import Stochasticity, estimate_stochasticity

__all__ = [
    "METHODS",
    "VALUE_METHODS",
    "Bellman",
    "CostConfig",
    "DistillConfig",
    "FitResult",
    "Known",
    "KnownCost",
    "Method",
    "Paper",
    "ParameterConfig",
    "ParameterTraining",
    "Stage",
    "StartConfig",
    "Stochasticity",
    "TerminalConfig",
    "TerminalError",
    "Training",
    "ValueConfig",
    "ValueFunction",
    "ValueMethod",
    "ValueTraining",
    "estimate_stochasticity",
    "fit_parameters",
    "fit_terminal",
    "fit_value",
    "known_cost",
    "terminal_error",
]
