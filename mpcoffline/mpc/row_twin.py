"""A CasADi function of rows of arrays, by whichever of torch and numpy is faster for it; without derivatives."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import casadi as ca
import numpy as np
import torch

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array

from .expressions import expanded
from .layers import may_be_layered
from .numpy_twin import NumpyTwin
from .torch_twin import LARGE, TorchTwin

_CHUNK = 4_096  # rows at a time, whose intermediate results stay in the cache


class RowTwin:
    """A CasADi function at many rows: numpy's, three to five times as fast as torch's; of large networks torch's.

    These are products of matrices in torch, but an operation a weight in numpy.

    Args:
        function: A CasADi function that can be expanded to SX, with column inputs and outputs; its first output counts.

    Raises:
        InvalidArgumentError: If it cannot be expanded to SX, or uses an operation that numpy and torch have not.
    """

    def __init__(self, function: ca.Function) -> None:
        flat = expanded(function)
        large = TorchTwin(function) if flat.n_instructions() > LARGE and may_be_layered(flat) else None
        self._twin = large if large is not None and large.in_layers else NumpyTwin(function)

    @property
    def by_numpy(self) -> bool:
        """Whether numpy evaluates it."""
        return isinstance(self._twin, NumpyTwin)

    def __call__(self, *inputs: Array) -> Array:
        """The first output, ``(..., m)``.

        Args:
            *inputs: One array an input, ``(..., n_i)``; leading dimensions broadcast, so that parameters ``(n,)``
                may go with states ``(B, nx)``.
        """
        if isinstance(self._twin, TorchTwin):
            with torch.no_grad():
                return np.asarray(self._twin(*(torch.tensor(each, dtype=torch.float64) for each in inputs)).numpy())
        shape = np.broadcast_shapes(*(each.shape[:-1] for each in inputs))
        count = int(np.prod(shape, dtype=int))
        columns = [_columns(each, shape) for each in inputs]
        found = np.empty((self._twin.n_out, count))
        for k in range(0, count, _CHUNK):
            some = (each[:, k : k + _CHUNK] if each.shape[1] == count else each for each in columns)
            found[:, k : k + _CHUNK] = self._twin(*some)
        return found.T.reshape(*shape, len(found))


def row_function(function: ca.Function) -> Callable[..., Array]:
    """The function at many rows: a :class:`RowTwin` where there can be one, else point by point as CasADi has it.

    Either takes rows ``(B, n_i)`` of each input, or ``(n_i,)`` for all, and gives its first output, ``(B, m)``.
    """
    try:
        return RowTwin(function)
    except InvalidArgumentError:
        return partial(_by_casadi, function)


def _by_casadi(function: ca.Function, *inputs: Array) -> Array:
    return np.asarray(function(*(each.T for each in inputs)).full().T)


def _columns(rows: Array, shape: tuple[int, ...]) -> Array:
    """Rows ``(..., n)`` as ``(n, count)``, or ``(n, 1)`` where they are one for all."""
    if rows.ndim == 1:
        return np.asarray(rows[:, None], dtype=np.float64)
    n = rows.shape[-1]
    every = np.moveaxis(np.broadcast_to(rows, (*shape, n)), -1, 0).reshape(n, -1)
    return np.ascontiguousarray(every, dtype=np.float64)
