"""Limits along trajectories: their elements by name, and what counts as a violation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import casadi as ca
import numpy as np

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC, Penalty
from mpcoffline.mpc.penalties import limit_expressions

TRIFLE = 1e-3  # of how far h moves: a violation by less is rounding and noise


class LimitFunction(NamedTuple):
    """A limit along the horizon.

    Attributes:
        name: Of the constraint.
        soft: Its prices; None for a hard one.
        function: ``(x, u, theta) -> h``.
    """

    name: str
    soft: Penalty | None
    function: ca.Function

    def along(self, x: Array, u: Array, theta: Array) -> Array:
        """H along trajectories ``(..., nx)``, ``(..., nu)``: ``(..., n)``."""
        flat = [part.reshape(-1, part.shape[-1]).T for part in (x, u)]
        h: Array = self.function(*flat, theta).full().T
        return h.reshape(*x.shape[:-1], -1)


def limit_functions(mpc: MPC) -> Iterator[LimitFunction]:
    """All limits along the horizon; those at its end hold nowhere in an episode."""
    x, u, theta = (ca.SX.sym(name, n) for name, n in (("x", mpc.nx), ("u", mpc.nu), ("theta", mpc.space.size)))
    for name, soft, h in limit_expressions(mpc, x, u, theta):
        yield LimitFunction(name, soft, ca.Function("h", [x, u, theta], [h]))


def moved(h: Array) -> Array:
    """How far each element moves, ``(n,)``, among all its values ``(..., n)``."""
    together = h.reshape(-1, h.shape[-1])
    return np.asarray(np.ptp(np.where(np.isfinite(together), together, 0.0), axis=0))
