"""The plants as an engineer knows them: their nominal controllers."""

from __future__ import annotations

from .nominal import nominal_mpc

__all__ = ["nominal_mpc"]
