"""The regression error of (FIT) and of the one-step prediction, as torch expressions of theta."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import Columns
from mpcoffline.estimation.rows import FULL_TURN, Rows, without_jumps
from mpcoffline.learning.stages import KnownCost
from mpcoffline.learning.value.fit import ValueFunction
from mpcoffline.mpc import MPC
from mpcoffline.mpc.scaling import increments_scale
from mpcoffline.mpc.theta_twin import ThetaTwin
from mpcoffline.mpc.torch_twin import TorchTwin


class BellmanProblem:
    """The regression error of (FIT), arXiv:2301.01667.

    ::

        min_c E_D[ (L(s,a) + gamma V(s+) - gamma V(f_th(s,a)) - Lhat_th(s,a) - c)^2 ] / Var_D[L]

    After a terminal state both V vanish. The constant c, theta_3 of (COST), is always the best one: no input depends on
    it, so that neither a constant in the logged costs nor a stage cost without such a parameter matters.

    Args:
        mpc: The MPC whose functions f and Lhat are fitted.
        value: V_phi, constant here.
        unit: What errors are measured in, the spread of the cost.
        cost: How L follows from Lhat, where that is known: then ``scale Lhat`` stands for Lhat here.
    """

    n_states: int
    unit: float

    def __init__(self, mpc: MPC, value: ValueFunction, unit: float, cost: KnownCost | None = None) -> None:
        self._f, self._stage = ThetaTwin(mpc.dynamics_function), TorchTwin(mpc.stage_function)
        self.n_states, self._ny = mpc.layout.n_states, mpc.ny
        self._value, self._discount, self.unit = value, mpc.discount, unit
        self._scale, self._of_reached = (1.0, False) if cost is None else (cost.scale, cost.reached)
        self._last: tuple[Columns, Tensor, Tensor] | None = None

    def discounted(self, batch: Columns) -> Tensor:
        """The weight of what follows, ``(B,)``: gamma, and zero after a terminal state."""
        weight: Tensor = self._discount * (1.0 - batch.terminations.double())
        return weight

    def target(self, batch: Columns) -> Tensor:
        """L(s,a) + gamma V(s+), ``(B,)``: what does not depend on theta."""
        following = self._value(batch.next_observations).double()
        target: Tensor = batch.costs.double() + self.discounted(batch) * following
        return target

    def predicted(self, batch: Columns, theta: Tensor) -> Tensor:
        """The predicted successor f_th(s,a), ``(B, ny)``; signals, which no model predicts, are those of s+.

        Two errors of one step ask for it; a large model is run, and differentiated, once.
        """
        if self._last is None or self._last[0] is not batch or self._last[1] is not theta:
            self._last = batch, theta, self._predicted(batch, theta)
        return self._last[2]

    def _predicted(self, batch: Columns, theta: Tensor) -> Tensor:
        reached: Tensor = self._f(batch.observations.double(), batch.actions.double(), theta)
        n, ny = self.n_states, self._ny
        if n == ny:
            return reached
        return torch.cat([reached[:, :n], batch.next_observations[:, n:ny].double(), reached[:, ny:]], dim=1)

    def predicted_value(self, batch: Columns, theta: Tensor) -> Tensor:
        """The discounted value of the predicted successor, gamma V(f_th(s,a)), ``(B,)``."""
        value: Tensor = self.discounted(batch) * self._value(self.predicted(batch, theta)).double()
        return value

    def stage_cost(self, batch: Columns, theta: Tensor) -> Tensor:
        """Lhat_th(s,a), ``(B,)``; of s+ where the logged costs are of that."""
        s = batch.next_observations if self._of_reached else batch.observations
        cost: Tensor = self._stage(s.double(), batch.actions.double(), theta)
        return self._scale * cost.squeeze(-1)

    def residuals(self, batch: Columns, theta: Tensor) -> Tensor:
        """What (FIT) leaves of each row, ``(B,)``, without the constant c."""
        explained = self.predicted_value(batch, theta) + self.stage_cost(batch, theta)
        return self.target(batch) - explained

    def error(self, batch: Columns, theta: Tensor, constant: Tensor | None = None) -> Tensor:
        """The mean squared error over a minibatch, a scalar.

        Args:
            batch: The minibatch, or a part of it.
            theta: The parameters.
            constant: c; the best for these rows by default. That of a whole minibatch makes the mean of its parts'
                gradients the gradient of the whole: in the best constant the derivative vanishes.
        """
        return self.mean_square(self.residuals(batch, theta), constant)

    def mean_square(self, residuals: Tensor, constant: Tensor | None = None) -> Tensor:
        """The variance of residuals in units of the cost's: their mean square with the best constant, or one given."""
        best = residuals.mean() if constant is None else constant
        return ((residuals - best) / self.unit).square().mean()


class PredictionError:
    """The one-step prediction error of the plant's states, every coordinate in the spread of its increments.

    ::

        E_D[ mean_i ((s+_i - f_th(s,a)_i) / std_D[s+_i - s_i])^2 ]

    Zero for the true model of a deterministic plant, about one for a model that predicts no motion. Full turns of
    angles that are confined to one turn do not count.

    Args:
        problem: Has the model.
        sample: Transitions that decide the spread, and which coordinates are such angles.
        theta: Parameters with which the model predicts well enough to see jumps of a full turn.
        centre: See :func:`~mpcoffline.mpc.scaling.increments_scale`.
    """

    def __init__(self, problem: BellmanProblem, sample: Columns, theta: Tensor, centre: Array | float = 0.0) -> None:
        self._problem = problem
        s, a, reached = (part.double() for part in (sample.observations, sample.actions, sample.next_observations))
        s, reached = s[:, : problem.n_states], reached[:, : problem.n_states]
        with torch.no_grad():
            missed = reached - problem.predicted(sample, theta)[:, : problem.n_states]
        rows, self._angles = without_jumps(Rows(s.numpy(), a.numpy(), reached.numpy()), -missed.numpy())
        self._scale = torch.from_numpy(
            increments_scale(rows.x, rows.reached, np.atleast_1d(centre)[: problem.n_states])
        )

    def __call__(self, batch: Columns, theta: Tensor) -> Tensor:
        """The mean error over a minibatch, a scalar."""
        missed = batch.next_observations.double() - self._problem.predicted(batch, theta)
        missed = missed[:, : self._problem.n_states]
        if self._angles:
            turns = torch.zeros_like(missed)
            angles = list(self._angles)
            turns[:, angles] = FULL_TURN * torch.round(missed.detach()[:, angles] / FULL_TURN)
            missed = missed - turns
        error: Tensor = (missed / self._scale).square().mean()
        return error
