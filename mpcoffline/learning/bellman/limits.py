"""The part of (FIT) that is about limits: parameters of soft ones, as back-offs, by what their prices must explain."""

from __future__ import annotations

import logging
from collections.abc import Callable

import casadi as ca
import numpy as np
import scipy.optimize
import torch
from torch import Tensor

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import Columns
from mpcoffline.learning.limit_costs import LimitCosts
from mpcoffline.mpc import MPC
from mpcoffline.mpc.penalties import limit_expressions, penalty_function
from mpcoffline.mpc.torch_twin import TorchTwin

from .equation import BellmanProblem

_log = logging.getLogger(__name__)

_ITERATIONS = 100
_DIGITS = 1e-6  # of the regression error: what is no better by more stays


def limit_parameters(mpc: MPC) -> tuple[str, ...]:
    """Names of the parameters that soft limits along the horizon depend on, and model and stage cost do not.

    Those are the ones that (FIT) can move: a hard limit has no price that could explain a cost.
    """
    function = penalty_function(mpc)
    if function is None:
        return ()
    x, u, theta = (ca.SX.sym(name, n) for name, n in (("x", mpc.nx), ("u", mpc.nu), ("theta", mpc.space.size)))
    others = ca.vertcat(mpc.dynamics_function(x, u, theta), mpc.stage_function(x, u, theta))
    price, slices = function(x, u, theta), mpc.space.slices
    return tuple(
        block.name
        for block in mpc.space
        if block.size and ca.depends_on(price, theta[slices[block.name]])
        if not ca.depends_on(others, theta[slices[block.name]])
    )


def check_limit_parameters(mpc: MPC) -> None:
    """Refuses to learn limits where there is nothing to learn.

    Raises:
        InvalidArgumentError: If no soft limit has a parameter of its own.
    """
    if not limit_parameters(mpc):
        raise InvalidArgumentError(
            "learn",
            expected="soft limits with a parameter of their own, as x[0] + p['backoff'] - 1",
            actual="none: hard limits have no price that (FIT) could find in costs"
            if mpc.constraints
            else "an MPC without limits",
        )


def refit_limits(
    mpc: MPC, theta: Array, problem: BellmanProblem, sample: Columns, limits: LimitCosts, *, prior: float
) -> tuple[Array, float]:
    """The parameters of soft limits that minimise (FIT), model and stage cost as they are, by L-BFGS-B.

    ::

        min_q Var_D[ L + P_0(s,a) + gamma V(s+) - gamma V(f(s,a)) - Lhat(s,a) - P_q(s,a) ] / Var_D[L] + l2 |q - q_0|^2

    where P_0 are the prices with the given parameters, which V has learned (Theorem 1 of Gros & Zanon,
    doi:10.1109/TAC.2019.2913768: the stage cost that makes an MPC with a wrong model optimal is Q* - gamma V*(f), and
    prices of limits are a part of it).

    Args:
        mpc: The MPC; its parameters are theta_0.
        theta: The parameters found so far.
        problem: The regression error without limits.
        sample: The transitions, without P_0 in their costs.
        limits: P_0.
        prior: l2; distances in the parameter's range, else its size, else what moves its limit as far as the data do.

    Returns:
        All parameters, and the regression error there.
    """
    names, price = limit_parameters(mpc), penalty_function(mpc)
    assert price is not None  # noqa: S101 -- there are limit costs; narrows the type
    index = np.concatenate([np.arange(mpc.space.size)[mpc.space.slices[name]] for name in names])
    twin, s, a = TorchTwin(price), sample.observations.double(), sample.actions.double()
    with torch.no_grad():
        fixed = torch.from_numpy(theta)
        rest = problem.target(sample) - problem.predicted_value(sample, fixed) - problem.stage_cost(sample, fixed)
        rest = rest + torch.from_numpy(limits(s.numpy(), a.numpy()))
    start, low, high = theta[index], mpc.space.low[index], mpc.space.high[index]
    size = _sizes(start, low, high, lambda: _reach(mpc, theta, index, s.numpy(), a.numpy()))

    def error(z: Tensor) -> Tensor:
        full = fixed.index_put((torch.from_numpy(index),), torch.from_numpy(start) + torch.from_numpy(size) * z)
        return problem.mean_square(rest - limits.scale * twin(s, a, full).squeeze(-1))

    def objective(point: Array) -> tuple[float, Array]:
        z = torch.from_numpy(point).requires_grad_()
        loss = error(z) + prior * z.square().sum()
        loss.backward()  # type: ignore[no-untyped-call]
        gradient = z.grad
        return float(loss.detach()), np.zeros_like(point) if gradient is None else gradient.numpy()

    bounds = list(zip((low - start) / size, (high - start) / size, strict=True))
    z = np.zeros(len(index))
    before, _ = objective(z)
    found = scipy.optimize.minimize(
        objective, z, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": _ITERATIONS}
    )
    if np.isfinite(found.x).all() and found.fun < before * (1.0 - _DIGITS):
        z = found.x
    result = theta.copy()
    result[index] = np.clip(start + size * z, low, high)
    _log.info("(FIT) of limits: %s", ", ".join(f"{n} {v:.4g}" for n, v in zip(names, result[index], strict=False)))
    with torch.no_grad():
        return result, float(error(torch.from_numpy(z)))


def _sizes(value: Array, low: Array, high: Array, reach: Callable[[], Array]) -> Array:
    """What each is measured by, ``(p,)``: its range, else its size, else what its limit says."""
    ranges = np.where(np.isfinite(high - low), high - low, 0.0)
    size = np.where(ranges > 0.0, ranges, np.abs(value))
    return size if (size > 0.0).all() else np.where(size > 0.0, size, reach())


def _reach(mpc: MPC, theta: Array, index: Array, s: Array, a: Array) -> Array:
    """By how much a parameter must move so that a limit of it does as much as over the data, ``(p,)``.

    ::

        unit = spread of h / |dh / dp|          (of the limit that it moves most; root mean square over the data)

    Args:
        mpc: The MPC with the limits.
        theta: Where derivatives are taken.
        index: The parameters, ``(p,)``.
        s: States, ``(B, nx)``.
        a: Inputs, ``(B, nu)``.
    """
    x, u, p = (ca.SX.sym(name, n) for name, n in (("x", mpc.nx), ("u", mpc.nu), ("theta", mpc.space.size)))
    h = ca.vertcat(*(h for _, soft, h in limit_expressions(mpc, x, u, p) if soft is not None))
    slopes = ca.jacobian(h, p)[:, index.tolist()]
    both = ca.Function("limits", [x, u, p], [ca.densify(h), ca.vec(ca.densify(slopes))])
    at, moved = (v.full() for v in both(s.T, a.T, theta))
    known = np.isfinite(at).all(axis=0) & np.isfinite(moved).all(axis=0)
    if not known.any():
        return np.ones(len(index))
    spread = at[:, known].std(axis=1)
    moved = np.sqrt(np.mean(moved[:, known] ** 2, axis=1)).reshape(len(index), -1)  # vec goes down the columns
    share = np.divide(moved, spread, out=np.zeros_like(moved), where=spread > 0.0).max(axis=1)
    return np.asarray(1.0 / np.where(share > 0.0, share, 1.0))  # 1 where nothing depends on it
