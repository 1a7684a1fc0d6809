"""The cost part of (FIT): for a fixed model, a convex least-squares problem over the whole data set."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.optimize
import torch
from torch import Tensor

from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import Columns
from mpcoffline.learning.potential import Potential
from mpcoffline.learning.reduction import Parts, Reduction
from mpcoffline.mpc import MPC
from mpcoffline.mpc.coordinates import Coordinates, canonical, with_level
from mpcoffline.mpc.scaling import Scaling

from .equation import BellmanProblem

_log = logging.getLogger(__name__)


class Refit(NamedTuple):
    """The cost that explains the data best.

    Attributes:
        theta: All parameters, ``(size,)``; only those of the cost have changed.
        error: The regression error of (FIT) there, in units of the cost's variance.
        potential: The fitted potential, where one was asked for.
    """

    theta: Array
    error: float
    potential: Potential | None


def refit_cost(
    mpc: MPC,
    theta: Array,
    problem: BellmanProblem,
    sample: Columns,
    scaling: Scaling,
    *,
    prior: float,
    shaped: bool,
    max_iterations: int,
    parts: Parts | None = None,
    reduction: Reduction | None = None,
) -> Refit:
    """The cost parameters, and the potential, that minimise (FIT) for a fixed model, by L-BFGS-B.

    Quadratic costs make it a linear least-squares problem in the weights over the cone of PSD matrices; in the factor
    C of W = C C' it is smooth and has no local minima besides.

    Args:
        mpc: The MPC; the prior pulls towards its parameters, also where ``theta`` has left them.
        theta: The start; its model is kept.
        problem: The regression error.
        sample: The transitions, all at once.
        scaling: Their units.
        prior: Weight of the squared distance to the MPC's parameters in scaled coordinates.
        shaped: Whether the stage cost has a potential besides.
        max_iterations: Bound on the iterations.
        parts: The transitions that are fitted, where the sample is not all of them: the parts of this process.
        reduction: How means over these are taken.

    Raises:
        MPCOfflineError: If the fit is lost.
    """
    nominal = Coordinates(mpc, ("cost",), scaling)
    start = Coordinates(mpc.with_theta(theta), ("cost",), scaling)
    reduction = reduction or Reduction()
    potential = Potential(sample.observations) if shaped else None
    whole: Parts = [(1.0, sample)]
    prepared = [(share, _Prepared.of(problem, potential, rows, theta)) for share, rows in parts or whole]
    offset = torch.from_numpy(nominal.z(theta))
    ratio = torch.from_numpy(start.scale / nominal.scale)

    def residuals(z: Tensor, rows: _Prepared) -> Tensor:
        explained = problem.stage_cost(rows.columns, start.theta(z[: start.size])) + rows.shaping @ z[start.size :]
        return rows.target - explained

    def objective(point: Array) -> tuple[float, Array]:
        z = torch.from_numpy(point).requires_grad_()
        constant = reduction.mean(partial(residuals, z.detach()), prepared)

        def loss(rows: _Prepared) -> tuple[Tensor, Tensor]:
            distance = (offset + ratio * z[: start.size]).square().sum() + z[start.size :].square().sum()
            found = problem.mean_square(residuals(z, rows), constant) + prior * distance
            return found, found

        shown = reduction.gradient(loss, prepared, [z])
        gradient = z.grad
        return shown, np.zeros_like(point) if gradient is None else gradient.numpy()

    n_shaping = 0 if potential is None else prepared[0][1].shaping.shape[1]
    found = scipy.optimize.minimize(
        objective,
        np.concatenate([start.start, np.zeros(n_shaping)]),
        jac=True,
        method="L-BFGS-B",
        bounds=[*zip(start.low, start.high, strict=True), *[(None, None)] * n_shaping],
        options={"maxiter": max_iterations},
    )
    if not np.isfinite(found.x).all():
        raise MPCOfflineError(
            "(FIT)", expected="a finite cost", actual="NaN or inf in its weights", hint="Raise prior, or lower trim."
        )
    if found.nit >= max_iterations:
        _log.info("(FIT) of the cost stopped at its bound of %d iterations", max_iterations)
    z = torch.from_numpy(found.x)
    fitted = canonical(mpc, start.theta(z[: start.size]).numpy())
    if potential is not None:
        potential.coefficients = problem.unit * z[start.size :]
    level, error = _left(problem, prepared, reduction, torch.from_numpy(fitted), z[start.size :])
    return Refit(with_level(mpc, fitted, level), error, potential)


class _Prepared(NamedTuple):
    """Transitions with what does not depend on the cost: what it has to explain, and what the potential multiplies."""

    columns: Columns
    target: Tensor
    shaping: Tensor

    @classmethod
    def of(cls, problem: BellmanProblem, potential: Potential | None, rows: Columns, theta: Array) -> _Prepared:
        """That of some rows, for the model of theta."""
        with torch.no_grad():
            target = problem.target(rows) - problem.predicted_value(rows, torch.from_numpy(theta))
            return cls(rows, target, problem.unit * _shaping(potential, problem, rows, theta))


def _left(
    problem: BellmanProblem,
    prepared: Sequence[tuple[float, _Prepared]],
    reduction: Reduction,
    theta: Tensor,
    coefficients: Tensor,
) -> tuple[float, float]:
    """The mean of what a cost leaves unexplained, and its variance in units of the cost's."""

    def missed(rows: _Prepared) -> Tensor:
        return rows.target - problem.stage_cost(rows.columns, theta) - rows.shaping @ coefficients

    with torch.no_grad():
        constant = reduction.mean(missed, prepared)
        if constant is None:
            ((_, rows),) = prepared
            found = missed(rows)
            return float(found.mean()), float(problem.mean_square(found))
        error = reduction.mean(lambda rows: ((missed(rows) - constant) / problem.unit).square(), prepared)
    return float(constant), float(torch.nan if error is None else error)


def _shaping(potential: Potential | None, problem: BellmanProblem, sample: Columns, theta: Array) -> Tensor:
    """The columns m_j(s) - gamma m_j(f(s,a)) that the potential's coefficients multiply, ``(n, size)``."""
    if potential is None:
        return torch.zeros(len(sample.costs), 0, dtype=torch.float64)
    reached = problem.predicted(sample, torch.from_numpy(theta))
    after = problem.discounted(sample)[:, None] * potential.monomials(reached)
    return potential.monomials(sample.observations) - after
