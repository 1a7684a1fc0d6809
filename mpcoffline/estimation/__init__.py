"""What a log says of plant and measurement: model parameters, noise, smoothed states."""

from __future__ import annotations

from .delays import DelaySearch, find_delays
from .episodes import EpisodeSpread
from .from_outputs import OutputIdentification, identify_from_outputs
from .identification import IdentificationConfig
from .identifying import Identification, identify
from .lags import Lag, find_lags
from .observer import KalmanObserver
from .profiles import with_profiles
from .residual import Residual, fit_residual, fit_residuals, with_residual
from .sensors import Sensors
from .smoothing import NoiseEstimate, estimate_noise, smooth, with_measurement_noise
from .structure import MultiStepCheck
from .subspace import LinearModel, linear_model

__all__ = [
    "DelaySearch",
    "EpisodeSpread",
    "Identification",
    "IdentificationConfig",
    "KalmanObserver",
    "Lag",
    "LinearModel",
    "MultiStepCheck",
    "NoiseEstimate",
    "OutputIdentification",
    "Residual",
    "Sensors",
    "estimate_noise",
    "find_delays",
    "find_lags",
    "fit_residual",
    "fit_residuals",
    "identify",
    "identify_from_outputs",
    "linear_model",
    "smooth",
    "with_measurement_noise",
    "with_profiles",
    "with_residual",
]
