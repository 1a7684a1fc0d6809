"""What the package shows, and where it lives: the one list, which type checkers and the lazy loader both read."""

from .control.evaluation import evaluate as evaluate
from .control.policy import MPCPolicy as MPCPolicy
from .core.errors import (
    FileFormatError as FileFormatError,
    InvalidArgumentError as InvalidArgumentError,
    InvalidDataError as InvalidDataError,
    MPCOfflineError as MPCOfflineError,
    StorageError as StorageError,
    UnknownIdError as UnknownIdError,
)
from .datasets import (
    MinariRecorder as MinariRecorder,
    TransitionTable as TransitionTable,
    list_datasets as list_datasets,
    load_dataset as load_dataset,
)
from .diagnostics import diagnose as diagnose
from .estimation.consistency import check as check
from .gallery import collect as collect
from .learner.learner import OfflineMPCLearner as OfflineMPCLearner
from .mpc import (
    MPC as MPC,
    Constraint as Constraint,
    ConvexNetworkCost as ConvexNetworkCost,
    LiftedCost as LiftedCost,
    Model as Model,
    NetworkCost as NetworkCost,
    NormCost as NormCost,
    Parameter as Parameter,
    Penalty as Penalty,
    QuadraticCost as QuadraticCost,
    Signal as Signal,
    StateBounds as StateBounds,
)
from .plants import (
    BlackBoxPlant as BlackBoxPlant,
    Input as Input,
    Limit as Limit,
    Output as Output,
    Plant as Plant,
    State as State,
    load_plant as load_plant,
    nominal_mpc as nominal_mpc,
)
from .sb3 import MPCModel as MPCModel
from .solvers import make_solver as make_solver

__version__: str
