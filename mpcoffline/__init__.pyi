"""What the package shows, and where it lives: the one list, which type checkers and the lazy loader both read."""

from .control.evaluation import evaluate as evaluate
from .control.policy import MPCPolicy as MPCPolicy
from .core.errors import (
    FileFormatError as FileFormatError,
)
from .core.errors import (
    InvalidArgumentError as InvalidArgumentError,
)
from .core.errors import (
    InvalidDataError as InvalidDataError,
)
from .core.errors import (
    MPCOfflineError as MPCOfflineError,
)
from .core.errors import (
    StorageError as StorageError,
)
from .core.errors import (
    UnknownIdError as UnknownIdError,
)
from .datasets import (
    MinariRecorder as MinariRecorder,
)
from .datasets import (
    TransitionTable as TransitionTable,
)
from .datasets import (
    list_datasets as list_datasets,
)
from .datasets import (
    load_dataset as load_dataset,
)
from .diagnostics import diagnose as diagnose
from .gallery import collect as collect
from .learner.learner import OfflineMPCLearner as OfflineMPCLearner
from .mpc import (
    MPC as MPC,
)
from .mpc import (
    Constraint as Constraint,
)
from .mpc import (
    ConvexNetworkCost as ConvexNetworkCost,
)
from .mpc import (
    LiftedCost as LiftedCost,
)
from .mpc import (
    Model as Model,
)
from .mpc import (
    NetworkCost as NetworkCost,
)
from .mpc import (
    NormCost as NormCost,
)
from .mpc import (
    Parameter as Parameter,
)
from .mpc import (
    Penalty as Penalty,
)
from .mpc import (
    QuadraticCost as QuadraticCost,
)
from .mpc import (
    StateBounds as StateBounds,
)
from .plants import nominal_mpc as nominal_mpc
from .sb3 import MPCModel as MPCModel
from .solvers import make_solver as make_solver

__version__: str
