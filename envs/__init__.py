"""The three tasks of arXiv:2301.01667 as Gymnasium environments.

Importing this package registers ``mpcoffline/LinearTracking-v0``, ``mpcoffline/PendulumSwingUp-v0`` and
``mpcoffline/CartPoleSwingUp-v0``. It needs numpy and gymnasium only, and pygame to draw.
"""

from __future__ import annotations

import gymnasium as gym

from .base import ControlTask
from .cartpole_swing_up import CartPoleSwingUpEnv
from .episode import EPISODE_STEPS
from .linear_tracking import LinearTrackingEnv
from .pendulum_swing_up import PendulumSwingUpEnv

__all__ = ["ENV_IDS", "CartPoleSwingUpEnv", "ControlTask", "LinearTrackingEnv", "PendulumSwingUpEnv"]

# One line a task. Strings: Minari stores the spec as JSON and could not rebuild an environment from a class.
_TASKS = {
    "mpcoffline/LinearTracking-v0": "linear_tracking:LinearTracking",
    "mpcoffline/PendulumSwingUp-v0": "pendulum_swing_up:PendulumSwingUp",
    "mpcoffline/CartPoleSwingUp-v0": "cartpole_swing_up:CartPoleSwingUp",
}
#: The tasks with a nominal controller, labels in figures and a shipped data set.
ENV_IDS = ("mpcoffline/LinearTracking-v0", "mpcoffline/PendulumSwingUp-v0", "mpcoffline/CartPoleSwingUp-v0")

for _id, _name in _TASKS.items():
    if _id not in gym.registry:
        gym.register(
            _id,
            entry_point=f"mpcoffline.envs.{_name}Env",
            vector_entry_point=f"mpcoffline.envs.{_name}VectorEnv",
            max_episode_steps=EPISODE_STEPS,
        )
