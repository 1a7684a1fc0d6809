"""(FIT): the parameters of the MPC by regression on the data; no MPC is solved (arXiv:2301.01667)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.optimize
import torch
from numpy.typing import NDArray
from torch import Tensor

from mpcoffline.datasets.transitions import Columns, TransitionTable
from mpcoffline.errors import InvalidArgumentError
from mpcoffline.mpc import MPC
from mpcoffline.mpc.torch_twin import TorchTwin

from .checks import check_integers, check_number
from .progress import Report, silent
from .value import ValueFunction, cosine

Array = NDArray[np.float64]

_OFF_SADDLE = 0.1  # in scaled coordinates


@dataclass(frozen=True)
class FitConfig:
    """How theta is learned.

    Attributes:
        prior: l2, the weight of |z - z_0|^2, where z are the scaled coordinates of :class:`Coordinates` and the
            regression error is measured in units of the cost's variance.
        n_steps: Gradient steps on cost and model together (none where the model is fixed).
        batch_size: Transitions a step.
        learning_rate: Adam's at the start, in scaled coordinates; falls to zero on a cosine.
        clip: Bound on the gradient's norm.
        refit_rows: Transitions of the full-batch fit of the cost; a random subset where there are more.
        refit_iterations: Bound on its L-BFGS iterations.
    """

    prior: float = 1e-3
    n_steps: int = 1_000
    batch_size: int = 512
    learning_rate: float = 0.03
    clip: float = 100.0
    refit_rows: int = 20_000
    refit_iterations: int = 300

    def __post_init__(self) -> None:
        check_number("prior", self.prior, 0.0, open_low=False)
        for name in ("learning_rate", "clip"):
            check_number(name, getattr(self, name), 0.0)
        counts = ("n_steps", "batch_size", "refit_rows", "refit_iterations")
        check_integers(1, **{name: getattr(self, name) for name in counts})


@dataclass(frozen=True)
class FitResult:
    """What (FIT) found.

    Attributes:
        theta: The learned parameters, ``(size,)``.
        loss_before: The regression error of (FIT) at theta_0, in units of the cost's variance.
        loss_after: The same at theta.
    """

    theta: Array
    loss_before: float
    loss_after: float


class Coordinates:
    """Scaled coordinates z of the learned part of theta, in which a step of one size means the same everywhere.

    A parameter with a positive lower bound (a mass, a length) is learned by its logarithm; the entries of a row of a
    matrix factor are measured in the size of that row, other numbers in the size of their block. Bounds on theta
    become bounds on z. The factor C of a matrix C C' is free here: the sign of a column means nothing, and a diagonal
    held at zero would block the way to the same matrix with the column reversed; :func:`canonical` restores the signs.

    Args:
        mpc: The MPC; its parameters are theta_0, and z = 0 there.
        groups: The parameter groups that are learned, ``("cost",)`` or ``("cost", "model")``.
    """

    def __init__(self, mpc: MPC, groups: tuple[str, ...]) -> None:
        space = mpc.space
        self.mask = space.mask(groups)
        theta, low, high = (v[self.mask] for v in (space.theta, space.low, space.high))
        factor = np.concatenate([np.full(block.size, block.kind == "psd") for block in space])[self.mask]
        self._stuck = factor & (low == 0.0) & (theta == 0.0)
        low = np.where(factor, -np.inf, low)
        self.logarithmic = (low > 0.0) & (theta > 0.0)
        scale = np.concatenate([_block_scale(block.theta, block.kind) for block in space])[self.mask]
        self.scale = np.where(self.logarithmic, 1.0, scale)
        self._theta_0 = theta
        self._full = space.theta
        with np.errstate(divide="ignore", invalid="ignore"):
            self.low, self.high = (
                np.where(self.logarithmic, np.log(bound / theta), (bound - theta) / self.scale) for bound in (low, high)
            )

    @property
    def size(self) -> int:
        """Number of learned coordinates."""
        return int(self.mask.sum())

    @property
    def start(self) -> Array:
        """Where a descent begins, ``(size,)``: z = 0, but for the zeros on the diagonal of a factor C.

        With a zero column C is a saddle of any loss in C C', which a descent would never leave.
        """
        return np.where(self._stuck, _OFF_SADDLE, 0.0)

    def theta(self, z: Tensor) -> Tensor:
        """The full theta ``(size,)`` of z, differentiable in z."""
        theta_0, scale = torch.from_numpy(self._theta_0), torch.from_numpy(self.scale)
        logarithmic = torch.from_numpy(self.logarithmic)
        # The exponent is masked too: exp of a large linear coordinate would turn its unused gradient into NaN.
        grown = theta_0 * torch.exp(torch.where(logarithmic, z, 0.0))
        learned = torch.where(logarithmic, grown, theta_0 + scale * z)
        return torch.from_numpy(self._full).masked_scatter(torch.from_numpy(self.mask), learned)


def _block_scale(theta: Array, kind: str) -> Array:
    """The size of each coordinate of a block: its row's for a matrix factor, otherwise the block's largest entry."""
    if kind != "psd":
        return np.full(len(theta), float(np.abs(theta).max(initial=0.0)) or 1.0)
    n = round((np.sqrt(8 * len(theta) + 1) - 1) / 2)
    rows, columns = np.tril_indices(n)
    factor = np.zeros((n, n))
    factor[rows, columns] = theta
    sizes = np.linalg.norm(factor, axis=1)
    largest = sizes.max() or 1.0
    return np.asarray(np.maximum(sizes, 0.1 * largest)[rows])


class BellmanFit:
    """The regression error of (FIT), as torch expression.

    ::

        E_D[ (L(s,a) + gamma V(s+) - gamma V(f_th(s,a)) - Lhat_th(s,a))^2 ] / Var_D[L]

    After a terminal state both V vanish.

    Args:
        mpc: The MPC whose functions f and Lhat are fitted.
        value: V_phi, constant here.
        unit: The variance that the error is divided by.
    """

    def __init__(self, mpc: MPC, value: ValueFunction, unit: float) -> None:
        self._f, self._stage = TorchTwin(mpc.dynamics_function), TorchTwin(mpc.stage_function)
        self._value, self._discount, self._unit = value, mpc.discount, unit

    def target(self, batch: Columns) -> Tensor:
        """L(s,a) + gamma V(s+), ``(B,)``: what does not depend on theta."""
        alive = 1.0 - batch.terminations.double()
        target: Tensor = batch.costs.double() + self._discount * alive * self._value(batch.next_observations).double()
        return target

    def predicted_value(self, batch: Columns, theta: Tensor) -> Tensor:
        """The discounted value of the predicted successor, gamma V(f_th(s,a)), ``(B,)``."""
        reached = self._f(batch.observations.double(), batch.actions.double(), theta)
        alive = 1.0 - batch.terminations.double()
        value: Tensor = self._discount * alive * self._value(reached.float()).double()
        return value

    def stage_cost(self, batch: Columns, theta: Tensor) -> Tensor:
        """Lhat_th(s,a), ``(B,)``."""
        cost: Tensor = self._stage(batch.observations.double(), batch.actions.double(), theta)
        return cost.squeeze(-1)

    def error(self, batch: Columns, theta: Tensor) -> Tensor:
        """The mean squared error over a minibatch, a scalar."""
        explained = self.predicted_value(batch, theta) + self.stage_cost(batch, theta)
        return self.mean_square(self.target(batch) - explained)

    def mean_square(self, residuals: Tensor) -> Tensor:
        """The mean square of residuals in units of the cost's variance."""
        return residuals.square().mean() / self._unit


def fit_parameters(
    mpc: MPC,
    value: ValueFunction,
    table: TransitionTable,
    groups: tuple[str, ...],
    config: FitConfig,
    *,
    seed: int,
    epoch: int = 100,
    report: Report = silent,
) -> FitResult:
    """Learns theta by (FIT): cost and model together by Adam, then the cost by full-batch L-BFGS, model fixed.

    The second step minimises the same objective over the cost alone, where it is a linear least-squares problem in the
    weights; it takes the minimum that stochastic gradients only approach. Where the model is not learned, it is all.

    Args:
        mpc: The MPC; its parameters are theta_0.
        value: V_phi.
        table: The transitions.
        groups: ``("cost",)`` for MPC_2, ``("cost", "model")`` for MPC_3.
        config: Prior and schedules.
        seed: Seeds the minibatches.
        epoch: Steps between reports.
        report: Called with ``{"fit_loss": ...}``.

    Returns:
        The parameters and the errors before and after.

    Raises:
        InvalidArgumentError: If model, cost or V is not finite at theta_0 on the data.
    """
    rng = np.random.default_rng(seed)
    unit = float(table.costs.var(dtype=np.float64)) or 1.0
    problem = BellmanFit(mpc, value, unit)
    rows = np.sort(rng.permutation(len(table))[: config.refit_rows])
    sample = table.columns(torch.from_numpy(table.rows[rows]))
    theta = mpc.theta
    with torch.no_grad():
        before = float(problem.error(sample, torch.from_numpy(theta)))
    if not np.isfinite(before):
        raise InvalidArgumentError(
            "mpc",
            expected="a model and a cost that are finite on the data",
            actual=f"a regression error of {before}",
            hint="Evaluate mpc.dynamics_function and mpc.stage_function at the logged states and actions.",
        )
    n_steps = config.n_steps if "model" in groups else 0
    total = n_steps + config.refit_iterations
    if n_steps:
        theta = _gradient_steps(mpc, problem, table, groups, config, rng, epoch, total, report)
    theta, after = _refit_cost(mpc, theta, problem, sample, config)
    report(total, total, {"fit_loss": after})
    return FitResult(theta, before, after)


def _gradient_steps(
    mpc: MPC,
    problem: BellmanFit,
    table: TransitionTable,
    groups: tuple[str, ...],
    config: FitConfig,
    rng: np.random.Generator,
    epoch: int,
    total: int,
    report: Report,
) -> Array:
    """Adam on (FIT) over all learned coordinates, projected onto their bounds after each step."""
    coordinates = Coordinates(mpc, groups)
    low, high = torch.from_numpy(coordinates.low), torch.from_numpy(coordinates.high)
    z = torch.from_numpy(coordinates.start).requires_grad_()
    optimiser = torch.optim.Adam([z], lr=config.learning_rate)
    batches = table.batches(config.batch_size, rng)
    losses: list[float] = []
    for step in range(1, config.n_steps + 1):
        optimiser.param_groups[0]["lr"] = config.learning_rate * cosine(step, config.n_steps)
        error = problem.error(table.columns(next(batches)), coordinates.theta(z))
        optimiser.zero_grad()
        (error + config.prior * z.square().sum()).backward()  # type: ignore[no-untyped-call]
        norm = torch.nn.utils.clip_grad_norm_([z], config.clip)
        if torch.isfinite(norm):  # one NaN would stay in Adam's moments for ever
            optimiser.step()
            with torch.no_grad():
                z.clamp_(low, high)
            losses.append(float(error.detach()))
        if step % epoch == 0 or step == config.n_steps:
            report(step, total, {"fit_loss": float(np.mean(losses)) if losses else np.nan})
            losses.clear()
    return canonical(mpc, coordinates.theta(z.detach()).numpy())


def _refit_cost(mpc: MPC, theta: Array, problem: BellmanFit, sample: Columns, config: FitConfig) -> tuple[Array, float]:
    """The cost parameters that minimise (FIT) for a fixed model, by L-BFGS-B; returns theta and the error."""
    nominal = Coordinates(mpc, ("cost",))
    start = Coordinates(mpc.with_theta(theta), ("cost",))
    with torch.no_grad():
        target = problem.target(sample) - problem.predicted_value(sample, torch.from_numpy(theta))
    # The prior pulls towards theta_0 also when the gradient steps have left it.
    offset = torch.from_numpy((theta - mpc.theta)[nominal.mask] / nominal.scale)
    ratio = torch.from_numpy(start.scale / nominal.scale)

    def objective(point: Array) -> tuple[float, Array]:
        z = torch.from_numpy(point).requires_grad_()
        error = problem.mean_square(target - problem.stage_cost(sample, start.theta(z)))
        loss = error + config.prior * (offset + ratio * z).square().sum()
        loss.backward()  # type: ignore[no-untyped-call]
        gradient = z.grad
        return float(loss.detach()), np.zeros_like(point) if gradient is None else gradient.numpy()

    found = scipy.optimize.minimize(
        objective,
        start.start,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(start.low, start.high, strict=True)),
        options={"maxiter": config.refit_iterations},
    )
    fitted = canonical(mpc, start.theta(torch.from_numpy(found.x)).numpy())
    with torch.no_grad():
        error = problem.mean_square(target - problem.stage_cost(sample, torch.from_numpy(fitted)))
    return fitted, float(error)


def canonical(mpc: MPC, theta: Array) -> Array:
    """The same parameters with matrix factors of non-negative diagonal, and rounding beyond the bounds removed."""
    result = theta.copy()
    for block in mpc.space:
        if block.kind == "psd":
            rows, columns = np.tril_indices(block.shape[0])
            part = mpc.space.slices[block.name]
            signs = np.where(theta[part][rows == columns] < 0.0, -1.0, 1.0)
            result[part] = theta[part] * signs[columns]
    return np.clip(result, mpc.space.low, mpc.space.high)
