"""Learn a Model Predictive Controller from logged data, without solving one MPC while learning.

The method is that of Sawant, Anand, Reinhardt, Gros, "Learning-based MPC from Big Data Using Reinforcement
Learning", arXiv:2301.01667. Importing this package registers the environments ``mpcoffline/LinearTracking-v0``,
``mpcoffline/PendulumSwingUp-v0`` and ``mpcoffline/CartPoleSwingUp-v0``; torch and CasADi load when first used.
"""

from __future__ import annotations

import mpcoffline.envs  # noqa: F401 -- registers the environments

__version__ = "0.1.0"
