"""What a log says of plant and measurement: model parameters, noise, smoothed states."""

from __future__ import annotations

from .delays import DelaySearch, find_delays
from .identification import Identification, IdentificationConfig, identify
from .smoothing import NoiseEstimate, estimate_noise, identify_smoothed, smooth, with_measurement_noise

__all__ = [
    "DelaySearch",
    "Identification",
    "IdentificationConfig",
    "NoiseEstimate",
    "estimate_noise",
    "find_delays",
    "identify",
    "identify_smoothed",
    "smooth",
    "with_measurement_noise",
]
