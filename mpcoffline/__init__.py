"""Learn a Model Predictive Controller from logged data, without solving one MPC while learning.

The method is that of Sawant, Anand, Reinhardt, Gros, "Learning-based MPC from Big Data Using Reinforcement
Learning", arXiv:2301.01667. Importing this package registers the environments ``mpcoffline/LinearTracking-v0``,
``mpcoffline/PendulumSwingUp-v0`` and ``mpcoffline/CartPoleSwingUp-v0``; torch, CasADi, Stable-Baselines3 and Minari
load when first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import mpcoffline.envs  # noqa: F401 -- registers the environments

if TYPE_CHECKING:
    from mpcoffline.datasets import MinariRecorder, TransitionTable, collect, list_datasets, load_dataset
    from mpcoffline.diagnostics import diagnose
    from mpcoffline.errors import (
        FileFormatError,
        InvalidArgumentError,
        InvalidDataError,
        MPCOfflineError,
        StorageError,
        UnknownIdError,
    )
    from mpcoffline.evaluation import evaluate
    from mpcoffline.learner import OfflineMPCLearner
    from mpcoffline.mpc import (
        MPC,
        Constraint,
        ConvexNetworkCost,
        LiftedCost,
        Model,
        NetworkCost,
        NormCost,
        Parameter,
        Penalty,
        QuadraticCost,
        StateBounds,
    )
    from mpcoffline.policy import MPCPolicy
    from mpcoffline.sb3 import MPCModel
    from mpcoffline.solvers import make_solver
    from mpcoffline.tasks import nominal_mpc

__version__ = "0.1.0"

# Where each public name lives; the module is imported when the name is first used.
_HOMES = {
    "MPC": "mpc",
    "Constraint": "mpc",
    "ConvexNetworkCost": "mpc",
    "LiftedCost": "mpc",
    "Model": "mpc",
    "NetworkCost": "mpc",
    "NormCost": "mpc",
    "Parameter": "mpc",
    "Penalty": "mpc",
    "QuadraticCost": "mpc",
    "StateBounds": "mpc",
    "make_solver": "solvers",
    "MPCModel": "sb3",
    "MPCPolicy": "policy",
    "OfflineMPCLearner": "learner",
    "diagnose": "diagnostics",
    "nominal_mpc": "tasks",
    "evaluate": "evaluation",
    "MinariRecorder": "datasets",
    "TransitionTable": "datasets",
    "collect": "datasets",
    "list_datasets": "datasets",
    "load_dataset": "datasets",
    "FileFormatError": "errors",
    "InvalidArgumentError": "errors",
    "InvalidDataError": "errors",
    "MPCOfflineError": "errors",
    "StorageError": "errors",
    "UnknownIdError": "errors",
}

__all__ = [
    "MPC",
    "Constraint",
    "ConvexNetworkCost",
    "FileFormatError",
    "InvalidArgumentError",
    "InvalidDataError",
    "LiftedCost",
    "MPCModel",
    "MPCOfflineError",
    "MPCPolicy",
    "MinariRecorder",
    "Model",
    "NetworkCost",
    "NormCost",
    "OfflineMPCLearner",
    "Parameter",
    "Penalty",
    "QuadraticCost",
    "StateBounds",
    "StorageError",
    "TransitionTable",
    "UnknownIdError",
    "__version__",
    "collect",
    "diagnose",
    "evaluate",
    "list_datasets",
    "load_dataset",
    "make_solver",
    "nominal_mpc",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
