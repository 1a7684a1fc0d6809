"""The prediction model x_{k+1} = f_theta(x_k, u_k) of (MPC), written once in CasADi."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core import limits
from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.limits import check_limit
from mpcoffline.core.types import Array

from .component import Component, blocks_from_json
from .expressions import function_from_json, function_to_json, traced
from .parameters import Block, Parameter, ParameterSpace
from .torch_import import TorchExpression

Dynamics = Callable[[ca.SX, ca.SX, dict[str, ca.SX]], ca.SX]


class Model(Component):
    """A model f_theta, from an ordinary differential equation or from a discrete-time map.

    An ODE is integrated with one RK4 step of length ``dt``, the input held.

    Example:
        >>> def ode(x, u, p):
        ...     return ca.vertcat(x[1], (u[0] - p["c"] * x[1]) / p["m"])
        >>> model = Model(ode, nx=2, nu=1, dt=0.05, parameters={"m": Parameter(1.0, low=0.1, unit="kg"), "c": 0.1})

    Args:
        dynamics: ``(x, u, p) -> dx/dt``, or ``-> x+`` with ``discrete=True``. ``x`` is ``(nx, 1)``, ``u`` is
            ``(nu, 1)``, ``p`` maps parameter names to CasADi matrices of their shapes.
        nx: Number of model states (the policy's observation is the model state).
        nu: Number of inputs.
        dt: Sampling time in s.
        parameters: Numbers, arrays or :class:`Parameter`; what learning may change.
        discrete: Whether ``dynamics`` is already the discrete-time map.

    Raises:
        InvalidArgumentError: For non-positive sizes or ``dt``, or dynamics that return something of another shape or
            that CasADi cannot evaluate symbolically.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        nx: int,
        nu: int,
        dt: float,
        parameters: Mapping[str, Parameter | ArrayLike] | None = None,
        *,
        discrete: bool = False,
    ) -> None:
        _check_sizes(nx, nu)
        if not (np.isfinite(dt) and dt > 0.0):
            raise InvalidArgumentError("dt", expected="a positive number of seconds", actual=str(dt))
        self.nx, self.nu, self.dt = int(nx), int(nu), float(dt)
        blocks = [Block.free(name, value, "model") for name, value in (parameters or {}).items()]
        self.space = ParameterSpace(blocks)
        self.function = self._discretised(dynamics, discrete)

    @classmethod
    def from_torch(
        cls,
        module: Any,
        nx: int,
        nu: int,
        dt: float,
        *,
        discrete: bool = True,
        residual: bool = False,
        learn_weights: bool = False,
    ) -> Model:
        """A model from a ``torch.nn.Module`` that was trained elsewhere.

        The module maps rows of ``nx + nu`` numbers, or two arguments ``(x, u)``, to rows of ``nx``. What it is made of
        becomes CasADi arithmetic: Linear, LayerNorm, BatchNorm1d (as in ``eval()``), Tanh, ReLU, LeakyReLU, ELU, GELU,
        SiLU, Sigmoid, Softplus, Softsign, Hardtanh, Identity, Dropout (left out), torch's functions of that kind, sums
        and products with buffers (normalisation), ``torch.cat(..., dim=-1)`` and ``x[..., a:b]``.

        Example:
            >>> import torch
            >>> net = torch.nn.Sequential(torch.nn.Linear(3, 64), torch.nn.Tanh(), torch.nn.Linear(64, 2))
            >>> Model.from_torch(net, nx=2, nu=1, dt=0.05, residual=True).nx
            2

        Args:
            module: The network, in any precision; it is copied.
            nx: Number of states.
            nu: Number of inputs.
            dt: Sampling time in s.
            discrete: Whether it gives the next state; with False it gives dx/dt.
            residual: Whether it gives the change of the state in a step, ``x+ = x + module(x, u)``.
            learn_weights: Whether its weights are parameters that learning may change, named as in the module with
                underscores (``0_weight``); by default they are fixed numbers, with which C computes much faster.

        Raises:
            InvalidArgumentError: For what cannot be traced, a layer that is not known (it is named), or sizes that do
                not fit.
        """
        network = TorchExpression(module)

        def dynamics(x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
            try:
                out = network(x, u, p if learn_weights else None)
            except (RuntimeError, IndexError) as error:
                raise InvalidArgumentError(
                    "module", expected=f"one of {nx} + {nu} numbers a row", actual=str(error).splitlines()[-1][:200]
                ) from error
            return x + out if residual else out

        return cls(dynamics, nx, nu, dt, network.weights if learn_weights else None, discrete=discrete or residual)

    def _discretised(self, dynamics: Dynamics, discrete: bool) -> ca.Function:
        """The map (x, u, p) -> x+ as SX function, p being this model's flat parameter vector."""
        x, u = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu)
        theta = ca.SX.sym("p", self.space.size)
        p = self.space.symbols(theta)

        def f(state: ca.SX) -> ca.SX:
            value = ca.densify(ca.SX(dynamics(state, u, p)))
            if value.shape != (self.nx, 1):
                raise InvalidArgumentError(
                    "dynamics", expected=f"a column of {self.nx} expressions", actual=f"shape {value.shape}"
                )
            return value

        try:
            reached = f(x) if discrete else rk4_expression(f, x, self.dt)
            function = ca.Function("model", [x, u, theta], [ca.cse(reached)], ["x", "u", "p"], ["x_next"])
        except KeyError as error:
            raise InvalidArgumentError(
                "dynamics",
                expected=f"parameters {', '.join(block.name for block in self.space) or 'none'}",
                actual=f"p[{error}]",
                hint="Give each parameter a name and a value in parameters.",
            ) from error
        except (TypeError, NotImplementedError, RuntimeError) as error:
            raise InvalidArgumentError(
                "dynamics",
                expected="a function of CasADi SX expressions",
                actual=f"{type(error).__name__}: {error}",
                hint="Use casadi.sin, casadi.vertcat, casadi.if_else ... instead of numpy, math and Python's if.",
            ) from error
        return traced("dynamics", function)

    def expression(self, x: ca.SX, u: ca.SX, theta: ca.SX) -> ca.SX:
        """The successor state ``(nx, 1)`` for x ``(nx, 1)``, u ``(nu, 1)`` and this model's flat parameters."""
        return self.function(x, u, theta)

    def __call__(self, x: ArrayLike, u: ArrayLike) -> Array:
        """The successor states ``(..., nx)`` of x ``(..., nx)`` under u ``(..., nu)``, with the current parameters.

        Raises:
            InvalidArgumentError: For a last dimension other than nx or nu.
        """
        states, inputs = np.asarray(x, np.float64), np.asarray(u, np.float64)
        for name, array, size in (("x", states, self.nx), ("u", inputs, self.nu)):
            if array.ndim < 1 or array.shape[-1] != size:
                raise InvalidArgumentError(name, expected=f"shape (..., {size})", actual=f"shape {array.shape}")
        batch = np.broadcast_shapes(states.shape[:-1], inputs.shape[:-1])
        states = np.broadcast_to(states, (*batch, self.nx)).reshape(-1, self.nx)
        inputs = np.broadcast_to(inputs, (*batch, self.nu)).reshape(-1, self.nu)
        flat = self.function(states.T, inputs.T, self.space.theta)
        return np.asarray(flat.full().T).reshape(*batch, self.nx)

    def to_json(self) -> dict[str, Any]:
        """A JSON-able description; the function as a list of instructions."""
        return super().to_json() | {
            "nx": self.nx,
            "nu": self.nu,
            "dt": self.dt,
            "function": function_to_json(self.function),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Model:
        """The inverse of ``to_json``.

        Raises:
            FileFormatError: If the function is damaged or of other shapes.
        """
        model = cls.__new__(cls)
        _check_sizes(data["nx"], data["nu"])
        model.nx, model.nu, model.dt = data["nx"], data["nu"], float(data["dt"])
        if not (np.isfinite(model.dt) and model.dt > 0.0):
            raise FileFormatError("model.dt", expected="a positive number of seconds", actual=str(data["dt"]))
        model.space = blocks_from_json(data)
        sizes = (model.nx, model.nu, model.space.size)
        model.function = function_from_json(data["function"], "model", inputs=sizes, output=model.nx)
        return model


def _check_sizes(nx: object, nu: object) -> None:
    """Refuses numbers of states and inputs that are none, or more than can be solved with."""
    check_integers(1, nx=nx, nu=nu)
    for name, size, most in (("nx", nx, limits.STATES), ("nu", nu, limits.INPUTS)):
        check_limit(name, "of them", int(str(size)), most, error=InvalidArgumentError)


def rk4_expression(f: Callable[[ca.SX], ca.SX], x: ca.SX, dt: float) -> ca.SX:
    """One classical Runge-Kutta step of dx/dt = f(x) from ``x (nx, 1)`` over ``dt`` s."""
    k1 = f(x)
    k2 = f(x + 0.5 * dt * k1)
    k3 = f(x + 0.5 * dt * k2)
    k4 = f(x + dt * k3)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
