"""The tasks of arXiv:2301.01667 and one more as Gymnasium environments, and the door for others: one file a plant.

Importing this package registers ``mpcoffline/LinearTracking-v0``, ``mpcoffline/PendulumSwingUp-v0``,
``mpcoffline/CartPoleSwingUp-v0`` and ``mpcoffline/PlanarQuadrotor-v0``. It needs numpy and gymnasium only, and pygame
to draw.
"""

from __future__ import annotations

from .base import ControlTask
from .linear_tracking import LinearTrackingEnv
from .pendulum_swing_up import PendulumSwingUpEnv

from .cartpole_swing_up import CartPoleSwingUpEnv  # isort: skip -- the order of the list of plants
from .planar_quadrotor import PlanarQuadrotorEnv
from .plant import Input, Nominal, Parameter, Plant, State, Uniform
from .registry import PLANTS, find_plant, register

__all__ = [
    "ENV_IDS",
    "PLANTS",
    "CartPoleSwingUpEnv",
    "ControlTask",
    "Input",
    "LinearTrackingEnv",
    "Nominal",
    "Parameter",
    "PendulumSwingUpEnv",
    "PlanarQuadrotorEnv",
    "Plant",
    "State",
    "Uniform",
    "find_plant",
    "register",
]

#: Gymnasium ids of the plants that come with this package; :data:`PLANTS` has those of others too.
ENV_IDS = tuple(plant.id for plant in PLANTS.values())
