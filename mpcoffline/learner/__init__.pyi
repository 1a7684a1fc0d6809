"""What the package shows, and where it lives: the one list, which type checkers and the lazy loader both read."""

from .learner import OfflineMPCLearner as OfflineMPCLearner
from .loggers import CSVLogger as CSVLogger, TensorBoardLogger as TensorBoardLogger
from .presets import PRESETS as PRESETS
