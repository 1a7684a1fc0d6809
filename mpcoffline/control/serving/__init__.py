"""A policy in charge of a plant: a loop of fixed period around a device, with all that can go wrong in one."""

from __future__ import annotations

from .clock import Clock, SystemClock, VirtualClock
from .decisions import DecisionLog
from .device import Device, DeviceError, Measurement
from .lines import LineDevice, LineServer
from .loop import Service, ServiceStats
from .simulated import SimulatedDevice

__all__ = [
    "Clock",
    "DecisionLog",
    "Device",
    "DeviceError",
    "LineDevice",
    "LineServer",
    "Measurement",
    "Service",
    "ServiceStats",
    "SimulatedDevice",
    "SystemClock",
    "VirtualClock",
]
