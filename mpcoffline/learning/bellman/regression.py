"""(FIT): the parameters of the MPC by regression on the data; no MPC is solved (arXiv:2301.01667)."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.text import listed
from mpcoffline.core.threads import one_torch_thread
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.shards import ShardedTable
from mpcoffline.datasets.table.transitions import Columns, TransitionTable
from mpcoffline.learning.adam import STATE, Adam
from mpcoffline.learning.limit_costs import LimitCosts
from mpcoffline.learning.reduction import Parts, Source
from mpcoffline.learning.stages import FitResult, KnownCost, Metrics
from mpcoffline.learning.value.fit import ValueFunction, cosine
from mpcoffline.learning.value.network import same_shape, whole_numbers
from mpcoffline.mpc import MPC
from mpcoffline.mpc.coordinates import Coordinates, canonical
from mpcoffline.mpc.scaling import Scaling, cost_spread, increments_scale

from .equation import BellmanProblem, PredictionError
from .limits import refit_limits
from .refit import refit_cost

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ParameterConfig:
    """How theta is learned.

    Attributes:
        prior: l2, the weight of ``|z - z_0|^2``, where z are the scaled coordinates of
            :class:`~mpcoffline.mpc.coordinates.Coordinates` and the regression error is measured in units of the
            cost's variance.
        prediction_weight: Weight of the one-step prediction error
            (:class:`~mpcoffline.learning.bellman.PredictionError`) beside (FIT); 0 is the published method.
        potential: Whether the cost is fitted with a :class:`~mpcoffline.learning.potential.Potential` besides.
        n_steps: Gradient steps on cost and model together; none where the model is not learned.
        batch_size: Transitions a step.
        learning_rate: Adam's at the start, in scaled coordinates; falls to zero on a cosine.
        clip: Bound on the gradient's norm.
        n_restarts: How often the gradient steps may begin again, from a perturbed start with half the learning rate,
            after they ended worse than they began.
        refit_rows: Transitions of the full-batch fit of the cost; a random subset where there are more.
        refit_iterations: Bound on its L-BFGS iterations.
    """

    prior: float = 1e-3
    prediction_weight: float = 0.0
    potential: bool = False
    n_steps: int = 1_000
    batch_size: int = 512
    learning_rate: float = 0.03
    clip: float = 100.0
    n_restarts: int = 2
    refit_rows: int = 20_000
    refit_iterations: int = 300

    def __post_init__(self) -> None:
        for name in ("prior", "prediction_weight"):
            check_number(name, getattr(self, name), 0.0, open_low=False)
        for name in ("learning_rate", "clip"):
            check_number(name, getattr(self, name), 0.0)
        check_integers(0, n_steps=self.n_steps, n_restarts=self.n_restarts)
        check_integers(1, **{n: getattr(self, n) for n in ("batch_size", "refit_rows", "refit_iterations")})


class ParameterTraining:
    """The state of (FIT) between its steps: Adam on cost and model together, then the convex fit of the cost.

    The second part, which is the last step, minimises the same objective over the cost alone, where it is a linear
    least-squares problem in the weights; it takes the minimum that stochastic gradients only approach. Where the model
    is not learned, it is all.

    Args:
        mpc: The MPC; its parameters are theta_0.
        value: V_phi.
        table: The transitions.
        groups: ``("cost",)`` for MPC_2, ``("cost", "model")`` for MPC_3.
        config: Prior and schedules.
        seed: Seeds the minibatches.
        cost: How the logged costs follow from the MPC's, where that is known: then the stage cost stays.
        limits: What soft limits cost, which the table does not contain; their parameters are learned where ``groups``
            have ``"constraints"``.
        shards: Where the table is an excerpt, all transitions: minibatches, and the rows of the convex fit, are of
            these.

    Raises:
        InvalidArgumentError: If model, cost or V is not finite at theta_0 on the data.
    """

    config: ParameterConfig
    attempt: int
    step: int

    def __init__(
        self,
        mpc: MPC,
        value: ValueFunction,
        table: TransitionTable,
        groups: tuple[str, ...],
        config: ParameterConfig,
        *,
        seed: int,
        cost: KnownCost | None = None,
        limits: LimitCosts | None = None,
        shards: ShardedTable | None = None,
    ) -> None:
        self._groups = groups = groups if cost is None else tuple(group for group in groups if group != "cost")
        self._mpc, self.config, self._seed = mpc, config, seed
        self._limits = limits if "constraints" in groups else None
        costs = table.costs
        self._rng = np.random.default_rng(seed)
        self._problem = BellmanProblem(mpc, value, cost_spread(costs), cost)
        self._sample = table.columns(torch.from_numpy(table.sample(config.refit_rows, self._rng).rows))
        s, a, _, reached, _ = (part.double().numpy() for part in self._sample)
        centre = table.centring.centre[: table.ny]
        self._prediction_error = PredictionError(self._problem, self._sample, torch.from_numpy(mpc.theta), centre)
        self._scaling = Scaling(s, a, increments_scale(s, reached, centre), self._problem.unit)
        self._coordinates = Coordinates(mpc, groups, self._scaling)
        with torch.no_grad():
            self._loss_before = float(self._problem.error(self._sample, torch.from_numpy(mpc.theta)))
        if not np.isfinite(self._loss_before):
            raise InvalidArgumentError(
                "mpc",
                expected="a model and a cost that are finite on the data",
                actual=f"a regression error of {self._loss_before}",
                hint="Evaluate mpc.dynamics_function and mpc.stage_function at the logged states and actions.",
            )
        self._low, self._high = (torch.from_numpy(b) for b in (self._coordinates.low, self._coordinates.high))
        source = Source.of(table, shards, config.batch_size, self._rng, seed)
        self._data, self._batches, self._reduction = source
        self._shards = shards
        self._n_gradients = config.n_steps if "model" in groups else 0
        self.n_steps: int = self._n_gradients + 1
        self.attempt = self.step = 0
        self._begin()

    def _begin(self) -> None:
        """The start of an attempt: the first from theta_0, others a little beside it and with shorter steps."""
        start = self._coordinates.start
        if self.attempt:
            start = start + 0.1 * np.random.default_rng([self._seed, self.attempt]).normal(size=start.shape)
        z = torch.from_numpy(start)
        self._z = torch.minimum(torch.maximum(z, self._low), self._high).requires_grad_()
        self._result: FitResult | None = None
        self._optimiser = Adam([self._z], self.config.learning_rate)

    @property
    def theta(self) -> Array:
        """The parameters reached so far, ``(size,)``."""
        return canonical(self._mpc, self._coordinates.theta(self._z.detach()).numpy())

    @property
    def done(self) -> bool:
        """Whether all steps are made."""
        return self.step >= self.n_steps

    @one_torch_thread()
    def advance(self, n: int) -> Metrics:
        """Makes n more gradient steps, fewer at the end of an attempt, and alone the last step; returns the error."""
        if self.step >= self._n_gradients:
            self.step = min(self.step + n, self.n_steps)
            if self._shards is not None:
                self._result = None  # what a process may have looked at before is of the sample
            return {"fit_loss": self.result.loss_after}
        losses: list[float] = []
        made, self._result = min(n, self._n_gradients - self.step), None
        for _ in range(made):
            self.step += 1
            losses += self._gradient_step()
        if made and not losses:
            _log.warning("(FIT) did not move in %d steps: no gradient was finite; has the model a sqrt at zero?", made)
        if self.step >= self._n_gradients and self._failed() and self.attempt < self.config.n_restarts:
            self.attempt, self.step = self.attempt + 1, 0
            _log.warning(
                "(FIT) ended worse than it began; starting again beside theta_0 (%d of at most %d restarts)",
                self.attempt,
                self.config.n_restarts,
            )
            self._begin()
        return {"fit_loss": float(np.mean(losses)) if losses else np.nan}

    def _gradient_step(self) -> list[float]:
        """One step of Adam, projected onto the bounds; returns the regression error where it was finite."""
        config = self.config
        schedule = cosine(self.step, self._n_gradients) * 0.5**self.attempt
        self._optimiser.learning_rate = config.learning_rate * schedule
        parts = [(share, self._data.columns(rows)) for share, rows in next(self._batches)]

        def residuals(batch: Columns) -> torch.Tensor:
            return self._problem.residuals(batch, self._coordinates.theta(self._z.detach()))

        constant = self._reduction.mean(residuals, parts)

        def loss(batch: Columns) -> tuple[torch.Tensor, torch.Tensor]:
            theta = self._coordinates.theta(self._z)
            error = self._problem.error(batch, theta, constant)
            found = error + config.prior * self._z.square().sum()
            if config.prediction_weight > 0.0:
                found = found + config.prediction_weight * self._prediction_error(batch, theta)
            return found, error

        self._optimiser.zero_grad()
        error = self._reduction.gradient(loss, parts, [self._z])
        norm = torch.nn.utils.clip_grad_norm_([self._z], config.clip)
        if not torch.isfinite(norm):  # one NaN would stay in Adam's moments for ever
            return []
        self._optimiser.step()
        with torch.no_grad():
            self._z.clamp_(self._low, self._high)
        return [error]

    def _failed(self) -> bool:
        """Whether the gradient steps ended with a larger objective than they began with."""
        with torch.no_grad():
            before, after = (
                self._objective(self._coordinates.theta(z)) for z in (torch.zeros_like(self._z), self._z.detach())
            )
        travelled = self.config.prior * float(self._z.detach().square().sum())
        return not after + travelled <= before * (1.0 + 1e-3)

    def _objective(self, theta: torch.Tensor) -> float:
        error = self._problem.error(self._sample, theta)
        return float(error + self.config.prediction_weight * self._prediction_error(self._sample, theta))

    @property
    def result(self) -> FitResult:
        """The convex fit of the cost from where the gradient steps are; theta_0's model where they all failed."""
        if self._result is None:
            self._result = self._with_limits(self._finished())
        return self._result

    def _finished(self) -> FitResult:
        theta = self._mpc.theta
        if self._n_gradients and not self._failed():
            theta = self.theta
        elif self._n_gradients:
            _log.warning("(FIT) of cost and model failed in every attempt; the model stays as it was")
        config = self.config
        if "cost" not in self._groups:
            with torch.no_grad():
                error = float(self._problem.error(self._sample, torch.from_numpy(theta)))
            return FitResult(theta, self._loss_before, error, tuple(self._coordinates.at_bounds(theta)))
        refit = refit_cost(
            self._mpc,
            theta,
            self._problem,
            self._sample,
            self._scaling,
            prior=config.prior,
            shaped=config.potential,
            max_iterations=config.refit_iterations,
            parts=self._fitted_parts(),
            reduction=self._reduction if self.done else None,
        )
        at_bounds = tuple(self._coordinates.at_bounds(refit.theta))
        if at_bounds:
            _log.warning("(FIT) ended on the bounds of %s: are the bounds right?", listed(at_bounds))
        return FitResult(refit.theta, self._loss_before, refit.error, at_bounds, refit.potential)

    def _fitted_parts(self) -> Parts | None:
        """The rows of the convex fit that this process has of shards; None where these are the sample.

        Before the end that is so, too: a process may look at the result without the others.
        """
        if self._shards is None or not self.done:
            return None
        drawn = next(self._shards.batches(min(self.config.refit_rows, len(self._shards)), self._seed))
        return [(share, self._data.columns(rows)) for share, rows in drawn]

    def _with_limits(self, found: FitResult) -> FitResult:
        """The result with the parameters of limits, where these are learned."""
        if self._limits is None:
            return found
        how = self._mpc, found.theta, self._problem, self._sample, self._limits
        theta, error = refit_limits(*how, prior=self.config.prior)
        return replace(found, theta=theta, loss_after=error)

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        """What :meth:`restore` needs to go on bit for bit."""
        arrays = {"z": self._z.detach().numpy().copy(), "steps": np.array([self.attempt, self.step], dtype=np.float64)}
        moments = self._optimiser.state.get(self._z, {})  # it does not count steps that were skipped
        return arrays | {name: moment.numpy().copy() for name, moment in moments.items()}

    def restore(self, arrays: dict[str, NDArray[np.float64]]) -> None:
        """Takes over a state from :meth:`to_arrays` of a training with the same arguments.

        Raises:
            FileFormatError: If arrays are missing or of another problem.
        """
        try:
            attempt, step = whole_numbers(arrays["steps"], 2)
            if not (0 <= attempt <= self.config.n_restarts and 0 <= step <= self.n_steps):
                raise ValueError(f"attempt {attempt}, step {step}")
            z = same_shape(arrays["z"], self._z)
            kinds = {"step": torch.zeros(())} | dict.fromkeys(STATE[1:], self._z) if "exp_avg" in arrays else {}
            moments = {name: same_shape(arrays[name], kind) for name, kind in kinds.items()}
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(
                "state of (FIT)", expected="that of the same MPC and configuration", actual=str(error)
            ) from error
        self.attempt, self.step = attempt, step
        for _ in range(attempt * self._n_gradients + min(step, self._n_gradients)):
            next(self._batches)
        self._begin()
        with torch.no_grad():
            self._z.copy_(z)
        if moments:
            self._optimiser.state[self._z] = moments


def fit_parameters(
    mpc: MPC,
    value: ValueFunction,
    table: TransitionTable,
    groups: tuple[str, ...],
    config: ParameterConfig,
    *,
    seed: int,
) -> FitResult:
    """Learns theta by (FIT): a :class:`ParameterTraining` from beginning to end.

    Args:
        mpc: The MPC; its parameters are theta_0.
        value: V_phi.
        table: The transitions.
        groups: ``("cost",)`` for MPC_2, ``("cost", "model")`` for MPC_3.
        config: Prior and schedules.
        seed: Seeds the minibatches.

    Returns:
        The parameters and the errors before and after.

    Raises:
        InvalidArgumentError: If model, cost or V is not finite at theta_0 on the data.
    """
    training = ParameterTraining(mpc, value, table, groups, config, seed=seed)
    while not training.done:
        training.advance(training.n_steps)
    return training.result
