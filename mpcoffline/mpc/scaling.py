"""The units of a problem, from its data: what size of step in theta, state, input and cost means something.

An affine change of the cost, the states, the inputs or time changes no result of learning: whatever is compared with
a number of this package is measured in these units first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array

if TYPE_CHECKING:
    from .problem import MPC

_ROWS = 500  # on which derivatives are taken
_MAX_ENTRIES = 2_000_000  # of such a derivative
_LEAST_ROW = 0.1  # of the largest row of a matrix factor: what a row may be measured in
_ROUNDING = 1e-6  # of float32, relative


@dataclass(frozen=True)
class Scaling:
    """States and inputs of a log, and how much they and its cost vary.

    Attributes:
        states: Some of the MPC's states, ``(n, nx)``; or of what the plant's map is given (``MPC.plant_function``),
            for the model alone.
        inputs: The inputs there, ``(n, nu)``.
        increments: Spread of the increments s+ - s, ``(nx,)``.
        cost: Spread of the cost.
    """

    states: Array
    inputs: Array
    increments: Array
    cost: float = 1.0

    @classmethod
    def of(cls, states: Array, inputs: Array, costs: Array, reached: Array, centre: Array | float = 0.0) -> Scaling:
        """That of transitions ``(n, nx)``, ``(n, nu)``, ``(n,)``, ``(n, nx)``; see :func:`increments_scale`."""
        return cls(states, inputs, increments_scale(states, reached, centre), cost_spread(costs))

    def units(self, mpc: MPC, groups: tuple[str, ...]) -> Array:
        """The unit of each coordinate of theta that is in one of the groups, ``(size,)``; 1 elsewhere.

        Of a number that is not zero it is its own size; one that is zero is measured by what it does::

            unit = spread of the increments / |df / dp|    or, in the cost,    spread of the cost / |dLhat / dp|

        (root mean squares over the data, and over the states). The entries of an array have the size of the largest
        of them in these units, those of a row of a matrix factor C the norm of the row, and all rows at least a tenth
        of the largest.

        Args:
            mpc: The MPC; derivatives are taken at its parameters.
            groups: Groups of parameters.
        """
        units = np.ones(mpc.space.size)
        for block in mpc.space:
            if block.group in groups and block.size:
                part = mpc.space.slices[block.name]
                index = np.arange(part.start, part.stop)
                if block.kind == "psd":
                    units[part] = self._of_factor(mpc, index, block.theta)
                elif block.size == 1 and block.theta[0] != 0.0:
                    units[part] = np.abs(block.theta)
                else:
                    natural = self._natural(mpc, index, block.theta, in_model=block.group == "model")
                    units[part] = (float(np.max(np.abs(block.theta) / natural)) or 1.0) * natural
        return units

    def _natural(self, mpc: MPC, index: Array, theta: Array, *, in_model: bool) -> Array:
        """What changes prediction or cost by a spread, ``(p,)``; the block's size where nothing does."""
        of_plant = (self.states.shape[1], self.inputs.shape[1]) != (mpc.nx, mpc.nu)  # without what it remembers
        x, u, p = _symbols(mpc, self.states.shape[1], self.inputs.shape[1])
        model = mpc.plant_function if of_plant else mpc.dynamics_function
        function, spread = (model, self.increments) if in_model else (mpc.stage_function, self.cost)
        slopes = ca.jacobian(function(x, u, p) / spread, p)[:, index.tolist()]
        squares = self._mean_squares(slopes, (x, u, p), mpc.theta).reshape(-1, len(index), order="F")
        sensitivity = np.sqrt(squares.sum(axis=0))
        known = np.isfinite(sensitivity) & (sensitivity > 0.0)
        return np.where(known, 1.0 / np.where(known, sensitivity, 1.0), np.abs(theta).max() or 1.0)

    def _of_factor(self, mpc: MPC, index: Array, theta: Array) -> Array:
        """The unit of each entry of a factor C, whose square is what acts."""
        n = round((np.sqrt(8 * len(theta) + 1) - 1) / 2)
        rows, columns = np.tril_indices(n)
        x, u, p = _symbols(mpc, mpc.nx, mpc.nu)
        cost = mpc.stage_function(x, u, p)
        diagonal = [p[int(k)] for k in index[rows == columns]]
        curvatures = ca.vertcat(*(ca.jacobian(ca.jacobian(cost, c), c) for c in diagonal)) / (2.0 * self.cost)
        acts = np.sqrt(np.sqrt(self._mean_squares(curvatures, (x, u, p), mpc.theta)))
        known = np.isfinite(acts) & (acts > 0.0)
        factor = np.zeros((n, n))
        factor[rows, columns] = theta
        sizes = np.linalg.norm(factor, axis=1)
        natural = np.where(known, 1.0 / np.where(known, acts, 1.0), sizes.max() or 1.0)
        least = _LEAST_ROW * (float(np.max(sizes / natural)) or 1.0 / _LEAST_ROW) * natural
        return np.asarray(np.maximum(sizes, least)[rows])

    def _mean_squares(self, expression: ca.SX, symbols: tuple[ca.SX, ca.SX, ca.SX], theta: Array) -> Array:
        """The mean over the data of the squares of an expression's entries, column by column."""
        function = ca.Function("derivatives", list(symbols), [ca.vec(ca.densify(expression))])
        most = max(1, min(_ROWS, _MAX_ENTRIES // max(1, expression.numel())))
        chosen = np.unique(np.linspace(0, len(self.states) - 1, most).round().astype(int))
        values = function(self.states[chosen].T, self.inputs[chosen].T, theta).full()
        good = np.isfinite(values).all(axis=0)
        return np.asarray(np.square(values[:, good]).mean(axis=1)) if good.any() else np.zeros(len(values))


def _symbols(mpc: MPC, nx: int, nu: int) -> tuple[ca.SX, ca.SX, ca.SX]:
    return ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("theta", mpc.space.size)


def spread_of(values: NDArray[np.floating[Any]], rounding: float = 0.0) -> Array:
    """The standard deviation of each column ``(d,)``; its size where it does not vary, and 1 where that is zero.

    Args:
        values: ``(n, d)``.
        rounding: Share of its size below which a deviation is none.
    """
    spread, size = (np.asarray(v, dtype=np.float64) for v in (values.std(axis=0), np.abs(values).max(axis=0)))
    return np.where(spread > rounding * size, spread, np.where(size > 0.0, size, 1.0))


def cost_spread(costs: NDArray[np.floating[Any]]) -> float:
    """The standard deviation of costs ``(n,)``, the unit of whatever is compared with them; of one cost only, its size.

    Where that is 0 too, 1.
    """
    constant = np.ptp(costs) == 0.0
    return float(abs(costs[0]) if constant else costs.std(dtype=np.float64)) or 1.0


def increments_scale(x: Array, reached: Array, centre: Array | float = 0.0) -> Array:
    """Spread of the increments of each coordinate ``(nx,)``; of the coordinate itself where nothing moves, else 1.

    Args:
        x: States, ``(n, nx)``.
        reached: Those after them, ``(n, nx)``.
        centre: What the table that they are from was packed without, ``(nx,)``: it was not rounded to float32.
    """
    spread = (reached - x).std(axis=0)
    rounding, least = (_ROUNDING * np.abs(x - offset).max(axis=0) for offset in (centre, 0.0))
    return np.where(spread > rounding, spread, np.where(least > 0.0, x.std(axis=0) + least, 1.0))
