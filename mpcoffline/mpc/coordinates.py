"""Scaled coordinates of theta: what the regressions descend in."""

from __future__ import annotations

import casadi as ca
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC

from .scaling import Scaling

_OFF_SADDLE = 0.1  # in scaled coordinates
_AT_BOUND = 1e-6  # likewise


class Coordinates:
    """Scaled coordinates z of the learned part of theta, in which a step of one size means the same everywhere.

    A parameter with a positive lower bound (a mass, a length) is learned by its logarithm, all others in the units of
    :meth:`~mpcoffline.mpc.scaling.Scaling.units`. Bounds on theta become bounds on z. The factor C of a matrix C C' is
    free here: the sign of a column means nothing, and a diagonal held at zero would block the way to the same matrix
    with the column reversed; :func:`canonical` restores the signs.

    Args:
        mpc: The MPC; its parameters are theta_0, and z = 0 there.
        groups: The parameter groups that are learned, ``("cost",)`` or ``("cost", "model")``.
        scaling: The units of the data.
    """

    low: Array
    high: Array

    def __init__(self, mpc: MPC, groups: tuple[str, ...], scaling: Scaling) -> None:
        space = mpc.space
        self.mask: NDArray[np.bool_] = space.mask(groups)
        theta, low, high = (v[self.mask] for v in (space.theta, space.low, space.high))
        factor = np.array([b.kind == "psd" for b in space for _ in range(b.size)], dtype=bool)[self.mask]
        self._stuck = factor & (low == 0.0) & (theta == 0.0)
        low = np.where(factor, -np.inf, low)
        self._bounds = np.stack([low, high], axis=1)
        self._names = [name for name, learned in zip(space.names, self.mask, strict=True) if learned]
        self.logarithmic: NDArray[np.bool_] = (low > 0.0) & (theta > 0.0)
        self._sizes = scaling.units(mpc, groups)[self.mask]
        self.scale: Array = np.where(self.logarithmic, 1.0, self._sizes)
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

    def z(self, theta: Array) -> Array:
        """The coordinates ``(size,)`` of a full theta: the inverse of :meth:`theta`."""
        learned = theta[self.mask]
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithms = np.log(learned / self._theta_0)
        return np.where(self.logarithmic, logarithms, (learned - self._theta_0) / self.scale)

    def theta(self, z: Tensor) -> Tensor:
        """The full theta ``(..., size)`` of z, differentiable in z."""
        theta_0, scale = torch.from_numpy(self._theta_0), torch.from_numpy(self.scale)
        logarithmic = torch.from_numpy(self.logarithmic)
        # The exponent is masked too: exp of a large linear coordinate would turn its unused gradient into NaN.
        grown = theta_0 * torch.exp(torch.where(logarithmic, z, 0.0))
        learned = torch.where(logarithmic, grown, theta_0 + scale * z)
        full = torch.from_numpy(self._full).expand(*z.shape[:-1], -1)
        return full.masked_scatter(torch.from_numpy(self.mask), learned)

    def at_bounds(self, theta: Array) -> list[str]:
        """Names of the learned parameters that lie on one of their bounds."""
        learned = theta[self.mask]
        bounds = np.nan_to_num(self._bounds, posinf=np.nan, neginf=np.nan)
        near = np.abs(learned[:, None] - bounds) <= _AT_BOUND * np.fmax(np.abs(bounds), self._sizes[:, None])
        near &= (self._bounds[:, 0] < self._bounds[:, 1])[:, None]  # a fixed parameter is where it has to be
        return [name for name, on in zip(self._names, near.any(axis=1), strict=True) if on]


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


def with_level(mpc: MPC, theta: Array, level: float) -> Array:
    """The parameters with a constant added to the stage cost, where it has a parameter that adds one.

    Args:
        mpc: The MPC.
        theta: All parameters, ``(size,)``.
        level: What is added to Lhat, everywhere alike.
    """
    x, u, p = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX.sym("theta", len(theta))
    slopes = ca.densify(ca.jacobian(mpc.stage_function(x, u, p), p))
    result = theta.copy()
    for k in np.flatnonzero(mpc.space.mask(("cost",))):
        slope = slopes[int(k)]
        if slope.is_constant() and float(slope) != 0.0:
            result[k] = np.clip(theta[k] + level / float(slope), mpc.space.low[k], mpc.space.high[k])
            break
    return result
