"""(VALUE): a value function V_phi of the logged data, by regression (arXiv:2301.01667)."""

from __future__ import annotations

from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.learning.progress import OnEpoch, silent

from .config import ValueConfig, cosine
from .function import ValueFunction
from .methods import VALUE_METHODS, Expectile, ImplicitQ, Residual, TemporalDifference, ValueMethod
from .noise import Stochasticity, estimate_stochasticity
from .training import ValueTraining

__all__ = [
    "VALUE_METHODS",
    "Expectile",
    "ImplicitQ",
    "Residual",
    "Stochasticity",
    "TemporalDifference",
    "ValueConfig",
    "ValueFunction",
    "ValueMethod",
    "ValueTraining",
    "cosine",
    "estimate_stochasticity",
    "fit_value",
]


def fit_value(
    table: TransitionTable,
    discount: float,
    config: ValueConfig,
    *,
    seed: int,
    device: str = "cpu",
    epoch: int = 500,
    report: OnEpoch = silent,
) -> ValueFunction:
    """Learns V_phi by stochastic gradient descent on one of the losses: a :class:`ValueTraining` from start to end.

    Args:
        table: The transitions.
        discount: gamma.
        config: Loss and schedule.
        seed: Seeds weights and minibatches; the same seed gives the same weights on the same machine.
        device: Torch device.
        epoch: Steps between reports.
        report: Called at the end of each epoch with what :meth:`ValueTraining.advance` returns.

    Returns:
        The value function, in evaluation mode and without gradients.

    Raises:
        MPCOfflineError: If the loss stays NaN or infinite.
    """
    training = ValueTraining(table, discount, config, seed=seed, device=device)
    while not training.done:
        metrics = training.advance(epoch)
        report(training.step, training.n_steps, metrics)
    return training.result
