"""An MPC where Stable-Baselines3 expects an algorithm."""

from __future__ import annotations

from .model import MPCModel

__all__ = ["MPCModel"]
