"""The plant's one-step prediction s+ = f_theta(s, a) and its derivatives, for many transitions at once.

Past inputs in an MPC's state are known exactly; what is estimated is the plant's map alone, whose inputs are those that
act (:func:`~mpcoffline.datasets.table.memory.plant_table`).
"""

from __future__ import annotations

from functools import lru_cache, partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.types import Array
from mpcoffline.mpc import MPC
from mpcoffline.mpc.row_twin import RowTwin


class OneStep:
    """The model's one-step prediction and its derivatives, batched.

    Args:
        mpc: The MPC whose model it is.
        parameters: Which coordinates of theta derivatives are taken in, ``(size,)`` booleans.
    """

    def __init__(self, mpc: MPC, parameters: NDArray[np.bool_]) -> None:
        index, nx = np.flatnonzero(parameters), mpc.layout.n_states
        self._shapes = ((nx,), (nx, len(index)), (nx, nx))
        # Made where it is needed, and once for all that look at the same model: for some, that is most of the time.
        self._twin = partial(_twin, mpc.model.plant, len(parameters), tuple(index.tolist()))

    def predict(self, x: Array, u: Array, theta: Array) -> Array:
        """The prediction f_theta(x, u), ``(B, nx)``."""
        return self._evaluated(1, x, u, theta)[0]

    def with_slopes(self, x: Array, u: Array, theta: Array) -> tuple[Array, Array]:
        """The prediction ``(B, nx)`` and df/dtheta over the chosen parameters ``(B, nx, p)``."""
        predicted, slopes = self._evaluated(2, x, u, theta)
        return predicted, slopes

    def linearised(self, x: Array, u: Array, theta: Array) -> tuple[Array, Array, Array]:
        """The prediction, df/dtheta, and df/dx ``(B, nx, nx)``."""
        predicted, slopes, states = self._evaluated(3, x, u, theta)
        return predicted, slopes, states

    def _evaluated(self, n_parts: int, x: Array, u: Array, theta: Array) -> list[Array]:
        flat = self._twin(n_parts)(x, u, theta)
        shapes = self._shapes[:n_parts]
        ends = np.cumsum([np.prod(shape, dtype=int) for shape in shapes])
        parts = np.split(flat, ends[:-1], axis=1)
        return [part.reshape(len(x), *shape) for part, shape in zip(parts, shapes, strict=True)]


@lru_cache(maxsize=32)
def _twin(plant: ca.Function, size: int, index: tuple[int, ...], n_parts: int) -> RowTwin:
    """The first of prediction, df/dtheta and df/dx in one column; the model's parameters come first in theta."""
    x, u, theta = ca.SX.sym("x", plant.numel_in(0)), ca.SX.sym("u", plant.numel_in(1)), ca.SX.sym("theta", size)
    reached = plant(x, u, theta[: plant.numel_in(2)])
    parts = [reached]
    if n_parts > 1:
        parts.append(ca.jacobian(reached, theta)[:, list(index)].T)
    if n_parts > 2:
        parts.append(ca.jacobian(reached, x).T)
    column = ca.vertcat(*(ca.vec(ca.densify(part)) for part in parts))
    return RowTwin(ca.Function("one_step", [x, u, theta], [column]))
