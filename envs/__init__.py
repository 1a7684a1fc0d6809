"""The three tasks of arXiv:2301.01667 as Gymnasium environments.

Importing this package registers ``mpcoffline/LinearTracking-v0``, ``mpcoffline/PendulumSwingUp-v0`` and
``mpcoffline/CartPoleSwingUp-v0``. It needs numpy and gymnasium only, and pygame to draw.
"""

from __future__ import annotations

import gymnasium as gym

from .base import ControlTask
from .cartpole_swing_up import CartPoleSwingUpEnv
from .linear_tracking import LinearTrackingEnv
from .pendulum_swing_up import PendulumSwingUpEnv

__all__ = ["ENV_IDS", "CartPoleSwingUpEnv", "ControlTask", "LinearTrackingEnv", "PendulumSwingUpEnv"]

ENV_IDS = ("mpcoffline/LinearTracking-v0", "mpcoffline/PendulumSwingUp-v0", "mpcoffline/CartPoleSwingUp-v0")

_MAX_EPISODE_STEPS = 100
_MODULES = ("linear_tracking", "pendulum_swing_up", "cartpole_swing_up")

# Entry points are strings: Minari stores the spec as JSON and could not rebuild an environment from a class.
for _id, _module, _class in zip(
    ENV_IDS, _MODULES, (LinearTrackingEnv, PendulumSwingUpEnv, CartPoleSwingUpEnv), strict=True
):
    if _id not in gym.registry:
        gym.register(
            _id,
            entry_point=f"mpcoffline.envs.{_module}:{_class.__name__}",
            vector_entry_point=f"mpcoffline.envs.{_module}:{_class.__name__.removesuffix('Env')}VectorEnv",
            max_episode_steps=_MAX_EPISODE_STEPS,
        )
