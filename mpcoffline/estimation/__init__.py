"""What a log says of plant and measurement: model parameters, noise, smoothed states."""

from __future__ import annotations

from .delays import DelaySearch, find_delays
from .identification import IdentificationConfig
from .identifying import Identification, identify
from .smoothing import NoiseEstimate, estimate_noise, smooth, with_measurement_noise

__all__ = [
    "DelaySearch",
    "Identification",
    "IdentificationConfig",
    "NoiseEstimate",
    "estimate_noise",
    "find_delays",
    "identify",
    "smooth",
    "with_measurement_noise",
]
