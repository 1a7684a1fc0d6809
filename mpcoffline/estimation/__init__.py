"""What a log says of plant and measurement: model parameters, noise, smoothed states."""

from __future__ import annotations

from .identification import IdentificationConfig
from .identifying import Identification, identify
from .smoothing import NoiseEstimate, estimate_noise, smooth, with_measurement_noise
from .structure import MultiStepCheck

__all__ = [
    "Identification",
    "IdentificationConfig",
    "MultiStepCheck",
    "NoiseEstimate",
    "estimate_noise",
    "identify",
    "smooth",
    "with_measurement_noise",
]
