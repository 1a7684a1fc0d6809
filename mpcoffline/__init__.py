"""Learn a Model Predictive Controller from logged data, without solving one MPC while learning.

The method is that of Sawant, Anand, Reinhardt, Gros, "Learning-based MPC from Big Data Using Reinforcement
Learning", arXiv:2301.01667. Importing this package registers the environments ``mpcoffline/LinearTracking-v0``,
``mpcoffline/PendulumSwingUp-v0``, ``mpcoffline/CartPoleSwingUp-v0`` and ``mpcoffline/PlanarQuadrotor-v0``; torch,
CasADi, Stable-Baselines3 and Minari load when first used.
"""

from __future__ import annotations

import lazy_loader

import mpcoffline.envs  # noqa: F401 -- registers the environments

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
