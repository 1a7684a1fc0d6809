"""A CasADi function of rows and of one theta as a torch function of theta, whose values and gradient are numpy's."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from mpcoffline.core.errors import InvalidArgumentError

from .row_twin import RowTwin
from .torch_twin import TorchTwin

Gradient = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


class ThetaTwin:
    """A CasADi function f(s, a, theta) at many rows, differentiable in theta alone.

    Autograd keeps a graph of every scalar operation of f, which costs several times what the operations do. Here
    CasADi differentiates, once and for all, and each gradient is one more function of rows::

        d/dtheta sum_b v_b' f(s_b, a_b, theta)  =  sum_b (df/dtheta)(s_b, a_b, theta)' v_b

    What numpy is not faster at, large networks, or has no operation for, stays with :class:`~.TorchTwin`; so does a
    gradient that is not finite: torch knows that x^theta does not move at x = 0, CasADi multiplies 0 by log 0.

    Args:
        function: A CasADi function of columns s, a and theta that can be expanded to SX; its first output counts.

    Raises:
        InvalidArgumentError: If it cannot be expanded to SX, or uses an operation that numpy and torch have not.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        rows = self._by_numpy(function)
        self._rows = rows if rows is not None and rows.by_numpy else None
        if self._rows is None:
            _ = self._torch

    def __call__(self, s: Tensor, a: Tensor, theta: Tensor) -> Tensor:
        """The first output at states ``(B, n)`` and inputs ``(B, m)``, both float64 and constant, ``(B, k)``."""
        if self._rows is None:
            return self._torch(s, a, theta)
        found: Tensor = _AtRows.apply(theta, s, a, self._rows, self.gradient)  # type: ignore[no-untyped-call]
        return found

    def gradient(self, s: Tensor, a: Tensor, theta: Tensor, v: Tensor) -> Tensor:
        """The derivative of the sum of products with v ``(B, k)`` by theta, of its shape."""
        adjoint, found = self._adjoint, torch.zeros_like(theta)
        if adjoint is not None:
            each, which = adjoint
            rows = (s, a, theta, v)
            found[which] = torch.from_numpy(each(*(part.detach().numpy() for part in rows)).sum(axis=0))
            if torch.isfinite(found).all():
                return found
        with torch.enable_grad():
            moved = theta.detach().requires_grad_()
            (by_torch,) = torch.autograd.grad(self._torch(s, a, moved), moved, v)
        return by_torch

    @staticmethod
    def _by_numpy(function: ca.Function) -> RowTwin | None:
        try:
            return RowTwin(function)
        except InvalidArgumentError:
            return None

    @cached_property
    def _torch(self) -> TorchTwin:
        return TorchTwin(self._function)

    @cached_property
    def _adjoint(self) -> tuple[RowTwin, Tensor] | None:
        """(df/dtheta)'v of a row, and which elements of theta it is of; None where numpy lacks an operation of it."""
        f = self._function
        s, a, theta = (ca.SX.sym(name, f.numel_in(i)) for i, name in enumerate(("s", "a", "theta")))
        v = ca.SX.sym("v", f.numel_out(0))
        pulled = ca.jtimes(f(s, a, theta), theta, v, True)
        which = np.unique(pulled.sparsity().row())
        twin = self._by_numpy(ca.Function("adjoint", [s, a, theta, v], [ca.densify(pulled[which.tolist()])]))
        return None if twin is None else (twin, torch.from_numpy(which).long())


class _AtRows(torch.autograd.Function):
    """f(s, a, theta) by a :class:`RowTwin`, ``(B, k)``, and its gradient by what is given with it."""

    @staticmethod
    def forward(ctx: Any, theta: Tensor, s: Tensor, a: Tensor, values: RowTwin, gradient: Gradient) -> Tensor:
        ctx.save_for_backward(s, a, theta)
        ctx.gradient = gradient
        return torch.from_numpy(values(*(part.detach().numpy() for part in (s, a, theta))))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.gradient(*ctx.saved_tensors, grads[0]), None, None, None, None
