"""Problems with corners that the exact functions' slopes do not solve: solved with the corners rounded."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.mpc.corners import Corner, rounded_mpc
from mpcoffline.solvers.plan import Plan

logger = logging.getLogger(__name__)

# Of a quantity's range: what is rounded over, first and then. Plans of the first cost up to 0.3 % more than they must;
# few problems can be solved from any start with the second.
SHARES = (0.01, 0.001)


class _Kernel(Protocol):
    """What is needed of a DDP solver."""

    mpc: MPC

    def run(self, x: Array, theta: Array, u0: Array | None, plan: Plan | None) -> dict[str, NDArray[Any]]:
        """Cold without a plan, warm with one."""


class Rounding:
    """A second solver, of the problem with rounded corners, for what the first one does not solve.

    At a minimum that lies on a corner no gradient vanishes; that a plan is one shows in that no plan which crosses the
    corner is better, on either side of it: the solution with the corner rounded looks on both. So a plan is accepted if
    the rounded problem was solved and the exact functions find none of its solution's cost better. The costs compared,
    and the one that is reported, are of the exact functions.

    Args:
        mpc: The problem.
        make: Makes a solver of a problem.
    """

    corners: list[Corner]

    def __init__(self, mpc: MPC, make: Callable[[MPC], _Kernel]) -> None:
        self._mpc = mpc
        first, self.corners = rounded_mpc(mpc, SHARES[0])
        rounded = [first, *(rounded_mpc(mpc, share)[0] for share in SHARES[1:])] if self.corners else []
        self._solvers = [make(each) for each in rounded]
        self._told = False

    def improve(
        self, exact: _Kernel, x: Array, theta: Array, u0: Array | None, result: dict[str, NDArray[Any]]
    ) -> None:
        """Solves again what is not solved, and puts the better plans into the result.

        Args:
            exact: The solver of the exact problem.
            x: Initial states ``(B, nx)``.
            theta: Parameters ``(size,)`` or ``(B, size)``.
            u0: First inputs ``(B, nu)``, if they are given.
            result: What the exact solver found; changed in place.
        """
        if not self._solvers:
            return
        rows = np.flatnonzero(result["status"])
        x, u0 = x[rows], None if u0 is None else u0[rows]
        theta = theta[rows] if theta.ndim == 2 else theta
        found = self._rounded(self._solvers[0], x, theta, u0, Plan(result["x"][rows], result["u"][rows]))
        solved, iterations = found["status"] == 0, found["iterations"]
        for solver in (*self._solvers[1:], exact):
            states, cost = self._rolled_out(x, found["u"], theta)
            self._take(rows, result, states, found["u"], cost)
            found = solver.run(x, theta, u0, Plan(states, found["u"]))
            iterations = iterations + found["iterations"]
        self._take(rows, result, found["x"], found["u"], found["J"])
        solved |= found["status"] == 0
        result["status"][rows[solved & np.isfinite(result["J"][rows])]] = 0
        result["iterations"][rows] += iterations
        self._tell(int(np.count_nonzero(result["status"][rows] == 0)), len(rows))

    @staticmethod
    def _take(rows: NDArray[np.intp], result: dict[str, NDArray[Any]], x: Array, u: Array, J: Array) -> None:
        """Puts plans of these rows into the result where they are better."""
        better = np.isfinite(J) & (np.nan_to_num(result["J"][rows], nan=np.inf) > J)
        for name, array in (("x", x), ("u", u), ("J", J)):
            result[name][rows[better]] = array[better]

    @staticmethod
    def _rounded(solver: _Kernel, x: Array, theta: Array, u0: Array | None, plan: Plan) -> dict[str, NDArray[Any]]:
        """From the exact problem's plan where that leads to a solution, else cold."""
        found = solver.run(x, theta, u0, plan)
        lost = found["status"] != 0
        if lost.any():
            cold = solver.run(
                x[lost], theta[lost] if theta.ndim == 2 else theta, None if u0 is None else u0[lost], None
            )
            taken = (cold["status"] == 0) | ~(cold["J"] >= found["J"][lost])
            for name in ("x", "u", "J", "status", "iterations"):
                found[name][np.flatnonzero(lost)[taken]] = cold[name][taken]
        return found

    def _rolled_out(self, x: Array, u: Array, theta: Array) -> tuple[Array, Array]:
        """The exact model's states ``(B, N + 1, nx)`` and costs ``(B,)`` under these inputs."""
        mpc, p = self._mpc, theta.T
        states, cost, weight = [x], np.zeros(len(x)), 1.0
        for k in range(mpc.horizon):
            cost += weight * mpc.stage_function(states[-1].T, u[:, k].T, p).full()[0]
            states.append(mpc.dynamics_function(states[-1].T, u[:, k].T, p).full().T)
            weight *= mpc.discount
        cost += weight * mpc.terminal_function(states[-1].T, p).full()[0]
        return np.stack(states, axis=1), cost

    def _tell(self, solved: int, tried: int) -> None:
        if self._told:
            return
        self._told = True
        logger.info(
            "ddp has corners to deal with (%s); %d of %d problems that stalled at them are solved with the corners "
            "rounded over %g of the range of what has the corner. Costs and states are the exact model's.",
            _listed(self.corners),
            solved,
            tried,
            SHARES[0],
        )


def _listed(corners: list[Corner]) -> str:
    """The operations, how often they occur, and their widths."""
    counts = Counter(corner.name for corner in corners)
    parts = []
    for name, count in counts.items():
        widths = [corner.width for corner in corners if corner.name == name]
        span = f"{min(widths):.2g}" if count == 1 else f"{min(widths):.2g} to {max(widths):.2g}"
        parts.append(f"{count} x {name}, half widths {span}" if count > 1 else f"{name}, half width {span}")
    return "; ".join(parts)
