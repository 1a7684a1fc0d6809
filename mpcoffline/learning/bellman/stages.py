"""The stages of the regressions on the Bellman equation."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from mpcoffline.core.checks import check_known, check_number
from mpcoffline.core.errors import FileFormatError
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.smoothing import identify_smoothed
from mpcoffline.learning.progress import Metrics
from mpcoffline.learning.stages import Arrays, FitResult, Known, Stage
from mpcoffline.learning.terminal import fit_terminal
from mpcoffline.learning.value.config import ValueConfig
from mpcoffline.learning.value.training import ValueTraining
from mpcoffline.mpc import MPC, NormCost, TerminalCost

from .regression import ParameterConfig, ParameterTraining

Init = Literal["nominal", "identified"]
Terminal = Literal["given", "norm", "quadratic", "network"]

_log = logging.getLogger(__name__)

_OTHER_MAGNITUDE = 30.0
_SCALE_ROWS = 5_000
_TERMINAL_ROWS = 100_000


@dataclass(frozen=True)
class StartConfig:
    """Where the model starts.

    Attributes:
        init: ``"nominal"`` at theta_0, ``"identified"`` at the smallest one-step prediction error, which also removes
            measurement noise from the data where there is any.
        adapt_above: With ``init="identified"``, steps on cost and model together (``fit_n_steps``) are made only where
            the identified model misses more than this share of an increment (root mean square of the one-step
            errors): where its structure is not the plant's. Else the model stays and the cost alone is fitted.
    """

    init: Init = "nominal"
    adapt_above: float = 0.0

    def __post_init__(self) -> None:
        check_known("init", self.init, get_args(Init))
        check_number("adapt_above", self.adapt_above, 0.0, open_low=False)


class Identify(Stage):
    """The table without measurement noise; the model, where it is learned, by its prediction error.

    Args:
        config: Whether it is done.
    """

    quick = True

    def __init__(self, config: StartConfig) -> None:
        self._config = config

    def outcome(self) -> Known:
        """See :class:`~mpcoffline.learning.stages.Stage`."""
        known = self.known
        if self._config.init == "nominal":
            return known
        found = identify_smoothed(known.mpc, known.table, seed=known.seed)
        if "model" not in known.groups:
            return replace(known, table=found.table)
        mpc = known.mpc.with_theta(found.identification.theta)
        return replace(known, mpc=mpc, table=found.table, model_error=found.identification.error_after)


class LearnValue(Stage):
    """V_phi by (VALUE); none is learned where one is given.

    Args:
        config: How.
    """

    phase, epoch = "(VALUE) learning V", 500

    def __init__(self, config: ValueConfig) -> None:
        self._config = config

    def begin(self, known: Known) -> None:
        """See :class:`~mpcoffline.learning.stages.Stage`."""
        super().begin(known)
        self._training: ValueTraining | None = None
        self.step = self.n_steps = 0
        if known.value_function is None:
            self._training = ValueTraining(
                known.table, known.mpc.discount, self._config, seed=known.seed, device=known.device
            )
            self.n_steps = self._training.n_steps

    @property
    def done(self) -> bool:
        """Whether V is given, or all steps are made, or the validation loss has stopped falling."""
        return self._training is None or self._training.done

    def advance(self, n: int) -> Metrics:
        """See :class:`~mpcoffline.learning.value.training.ValueTraining`."""
        if self._training is None:
            return {}
        metrics = self._training.advance(n)
        self.step = self._training.step
        return metrics

    def outcome(self) -> Known:
        """See :class:`~mpcoffline.learning.stages.Stage`."""
        return self.known if self._training is None else replace(self.known, value_function=self._training.result.cpu())

    def to_arrays(self) -> Arrays:
        """See :class:`~mpcoffline.learning.stages.Stage`."""
        return {} if self._training is None else self._training.to_arrays()

    def restore(self, arrays: Arrays) -> None:
        """See :class:`~mpcoffline.learning.stages.Stage`."""
        if self._training is not None:
            self._training.restore(arrays)
            self.step = self._training.step


class LearnParameters(Stage):
    """Theta by (FIT): steps on cost and model together, and as the last one the convex fit of the cost.

    Args:
        config: How.
        adapt_above: See :class:`StartConfig`.
    """

    def __init__(self, config: ParameterConfig, adapt_above: float = 0.0) -> None:
        self._config, self._adapt_above = config, adapt_above

    def begin(self, known: Known) -> None:
        """See :class:`~mpcoffline.learning.stages.Stage`."""
        super().begin(replace(known, mpc=in_units_of(known.mpc, known.table)))
        self.phase = f"(FIT) learning {'+'.join(known.groups)}"
        self._training = ParameterTraining(
            self.known.mpc, known.constant_value, known.table, known.groups, self._adapting(), seed=known.seed
        )
        self._found: FitResult | None = None
        self.step, self.n_steps = 0, self._training.n_steps + 1

    def _adapting(self) -> ParameterConfig:
        """The configuration, without steps on a model that was identified and predicts well."""
        config, missed = self._config, self.known.model_error
        if missed is None or not config.n_steps:
            return config
        if missed <= self._adapt_above:
            _log.info("The identified model misses %.2g of an increment: it stays, (FIT) finds the cost", missed)
            return replace(config, n_steps=0)
        _log.info(
            "The identified model misses %.2g of an increment, adapt_above is %g: (FIT) adapts it with the cost. The "
            "larger horizon and discount are, the more an MPC relies on its model",
            missed,
            self._adapt_above,
        )
        return config

    def advance(self, n: int) -> Metrics:
        """Makes n more steps, fewer before the last, which is made alone."""
        if self._training.done:
            self.step = self.n_steps
            return {"fit_loss": self._result().loss_after}
        metrics = self._training.advance(n)
        self.step, self._found = self._training.step, None
        return metrics

    def _result(self) -> FitResult:
        """What is found from where the steps have come to: once, for it takes seconds."""
        if self._found is None:
            self._found = self._training.finish()
        return self._found

    def outcome(self) -> Known:
        """See :class:`~mpcoffline.learning.stages.Stage`."""
        result = self._result()
        return replace(self.known, mpc=self.known.mpc.with_theta(result.theta), result=result)

    def to_arrays(self) -> Arrays:
        """See :class:`~mpcoffline.learning.stages.Stage`."""
        return self._training.to_arrays() | {"done": np.array(self.done)}

    def restore(self, arrays: Arrays) -> None:
        """See :class:`~mpcoffline.learning.stages.Stage`."""
        self._training.restore(arrays)
        done = arrays.get("done")
        if done is None or done.shape or done.dtype != bool or (done and not self._training.done):
            raise FileFormatError("state of (FIT)", expected="whether it was done", actual=repr(done)[:100])
        self.step = self.n_steps if done else self._training.step


@dataclass(frozen=True)
class TerminalConfig:
    """What the terminal cost of the learned MPC becomes.

    Attributes:
        method: ``"given"`` keeps the given one's, ``"norm"`` is (TERM), ``"quadratic"`` and ``"network"`` are fitted
            to V, as Theorem 1 asks for (doi:10.1109/TAC.2019.2913768).
        blend: Share of the convex quadratic in ``"network"``: steadier at short horizons.
    """

    method: Terminal = "given"
    blend: float = 0.0

    def __post_init__(self) -> None:
        check_known("terminal", self.method, get_args(Terminal))
        check_number("blend", self.blend, 0.0, 1.0, open_low=False)


class FitTerminal(Stage):
    """The terminal cost: T = V - Phi, or none from V.

    Args:
        config: Which.
    """

    quick = True

    def __init__(self, config: TerminalConfig) -> None:
        self._config = config

    def outcome(self) -> Known:
        """See :class:`~mpcoffline.learning.stages.Stage`."""
        known, kind = self.known, self._config.method
        if kind == "given":
            return known
        goal = np.zeros(known.mpc.nx) if known.mpc.reference is None else known.mpc.reference
        if kind == "norm":
            return _with_terminal_cost(known, NormCost(goal))
        value, potential = known.constant_value, None if known.result is None else known.result.potential
        terminal_cost = fit_terminal(
            kind,
            value if potential is None else lambda s: value(s) - potential(s),
            known.table.sample(_TERMINAL_ROWS, 0).observations,
            x_ref=goal,
            blend=self._config.blend,
            seed=known.seed,
        )
        return _with_terminal_cost(known, terminal_cost)


def _with_terminal_cost(known: Known, cost: TerminalCost) -> Known:
    mpc = known.mpc.replace(terminal_cost=cost)
    return replace(known, mpc=mpc, result=None if known.result is None else replace(known.result, theta=mpc.theta))


def in_units_of(mpc: MPC, table: TransitionTable) -> MPC:
    """The MPC with the weights of its stage cost scaled to the logged cost, where these are of other magnitudes.

    (FIT) measures distances in the size of theta_0, which has to be that of the cost in the data within a factor of 30.
    """
    rows = table.sample(_SCALE_ROWS, 0)  # at random: a stride would meet the length of episodes
    stage = mpc.stage_function(rows.observations.T, rows.actions.T, mpc.theta).full()
    logged, nominal = float(rows.costs.std(dtype=np.float64)), float(stage.std())
    factor = logged / nominal if nominal > 0.0 else 1.0
    if not np.isfinite(factor) or 1.0 / _OTHER_MAGNITUDE < factor < _OTHER_MAGNITUDE or factor == 0.0:
        return mpc
    weights = [block.name for block in mpc.space if block.group == "cost" and block.kind == "psd"]
    theta = mpc.theta
    for name in weights:
        theta[mpc.space.slices[name]] *= np.sqrt(factor)  # of W = C C'
    outcome = f"{', '.join(weights)} scaled to it" if weights else "scale that by hand"
    _log.warning("the logged cost varies %.3g times as much as the MPC's stage cost: %s", factor, outcome)
    return mpc.with_theta(theta)
