"""What the package shows, and where it lives: the one list, which type checkers and the lazy loader both read."""

from .evaluation import evaluate as evaluate
from .explicit.distilling import distill as distill
from .explicit.policy import DistilledPolicy as DistilledPolicy
from .export import export_c as export_c
from .output_feedback import OutputFeedbackPolicy as OutputFeedbackPolicy
from .policy import MPCPolicy as MPCPolicy
from .predictors import D3rlpyPredictor as D3rlpyPredictor
