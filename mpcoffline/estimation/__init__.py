"""What a log says of plant and measurement: model parameters, noise, smoothed states."""

from __future__ import annotations

from .identification import IdentificationConfig
from .identifying import Identification, identify
from .smoothing import NoiseEstimate, estimate_noise, smooth, with_measurement_noise

__all__ = [
    "Identification",
    "IdentificationConfig",
    "NoiseEstimate",
    "estimate_noise",
    "identify",
    "smooth",
    "with_measurement_noise",
]
