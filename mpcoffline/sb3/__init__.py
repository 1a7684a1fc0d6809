"""An MPC where Stable-Baselines3 expects an algorithm, a callback or a policy of the zoo."""

from __future__ import annotations

from .model import EnvironmentEvaluator, MPCModel, SB3Callback, register_with_rl_zoo

__all__ = ["EnvironmentEvaluator", "MPCModel", "SB3Callback", "register_with_rl_zoo"]
