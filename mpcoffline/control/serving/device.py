"""What a loop asks of a plant: two calls, and an error for when it does not answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from mpcoffline.core.errors import MPCOfflineError


class DeviceError(MPCOfflineError, OSError):
    """A device does not answer, or not as it should: for the loop a lost measurement, never its end."""


@dataclass(frozen=True)
class Measurement:
    """What a device says of its plant now.

    Attributes:
        values: States and signals by name, in the units of the plant file. Values of a signal that is previewed stand
            under the names of its columns, ``"price in 1 steps"``; those that are missing stay as the last one before.
            Clocks need none: the loop knows the time.
        inputs: The inputs in effect now, by name; those that the device cannot say are left out. At the first
            measurement they are where the controller takes over.
    """

    values: Mapping[str, float]
    inputs: Mapping[str, float] = field(default_factory=dict)


class Device(Protocol):
    """A plant that can be measured and moved.

    Either call may raise :class:`DeviceError` (or ``OSError``), and may take its time: the loop waits no longer than to
    the end of its period. A device should have a watch-dog of its own, that brings the plant to rest when no input has
    arrived for some periods: a loop on another computer cannot do that when the line is cut.
    """

    def read(self) -> Measurement:
        """What is measured now."""

    def write(self, inputs: Mapping[str, float]) -> None:
        """Applies inputs, by name, from now on."""
