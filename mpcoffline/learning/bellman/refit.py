"""The cost part of (FIT): for a fixed model, a convex least-squares problem over the whole data set."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np
import scipy.optimize
import torch
from torch import Tensor

from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import Columns
from mpcoffline.learning.potential import Potential
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

    Raises:
        MPCOfflineError: If the fit is lost.
    """
    nominal = Coordinates(mpc, ("cost",), scaling)
    start = Coordinates(mpc.with_theta(theta), ("cost",), scaling)
    with torch.no_grad():
        target = problem.target(sample) - problem.predicted_value(sample, torch.from_numpy(theta))
        potential = Potential(sample.observations) if shaped else None
        shaping = problem.unit * _shaping(potential, problem, sample, theta)
    offset = torch.from_numpy(nominal.z(theta))
    ratio = torch.from_numpy(start.scale / nominal.scale)

    def residuals(z: Tensor) -> Tensor:
        explained = problem.stage_cost(sample, start.theta(z[: start.size])) + shaping @ z[start.size :]
        return target - explained

    def objective(point: Array) -> tuple[float, Array]:
        z = torch.from_numpy(point).requires_grad_()
        distance = (offset + ratio * z[: start.size]).square().sum() + z[start.size :].square().sum()
        loss = problem.mean_square(residuals(z)) + prior * distance
        loss.backward()  # type: ignore[no-untyped-call]
        gradient = z.grad
        return float(loss.detach()), np.zeros_like(point) if gradient is None else gradient.numpy()

    n_shaping = shaping.shape[1]
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
    with torch.no_grad():
        missed = target - problem.stage_cost(sample, torch.from_numpy(fitted)) - shaping @ z[start.size :]
    return Refit(with_level(mpc, fitted, float(missed.mean())), float(problem.mean_square(missed)), potential)


def _shaping(potential: Potential | None, problem: BellmanProblem, sample: Columns, theta: Array) -> Tensor:
    """The columns m_j(s) - gamma m_j(f(s,a)) that the potential's coefficients multiply, ``(n, size)``."""
    if potential is None:
        return torch.zeros(len(sample.costs), 0, dtype=torch.float64)
    reached = problem.predicted(sample, torch.from_numpy(theta))
    after = problem.discounted(sample)[:, None] * potential.monomials(reached)
    return potential.monomials(sample.observations) - after
