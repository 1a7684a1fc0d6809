"""The prediction model x_{k+1} = f_theta(x_k, u_k) of (MPC), written once in CasADi."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.types import Array

from .component import Component, blocks_from_json
from .expressions import function_from_json, function_to_json, traced
from .layout import Layout
from .parameters import Block, Parameter, ParameterSpace

Dynamics = Callable[[ca.SX, ca.SX, dict[str, ca.SX]], ca.SX]


class Model(Component):
    """A model f_theta, from an ordinary differential equation or from a discrete-time map.

    An ODE is integrated with one RK4 step of length ``dt``, the input held.

    Where inputs act late (``delay``), or their changes have a price, the model's state is z = [y, past inputs], y being
    the observation (:class:`~mpcoffline.mpc.layout.Layout`); else it is y itself.

    Example:
        >>> def ode(x, u, p):
        ...     return ca.vertcat(x[1], (u[0] - p["c"] * x[1]) / p["m"])
        >>> model = Model(ode, nx=2, nu=1, dt=0.05, parameters={"m": Parameter(1.0, low=0.1, unit="kg"), "c": 0.1})

    Args:
        dynamics: ``(x, u, p) -> dx/dt``, or ``-> x+`` with ``discrete=True``. ``x`` is ``(nx, 1)``, ``u`` is
            ``(nu, 1)``, ``p`` maps parameter names to CasADi matrices of their shapes.
        nx: Number of the plant's states (these are the policy's observation).
        nu: Number of inputs.
        dt: Sampling time in s.
        parameters: Numbers, arrays or :class:`Parameter`; what learning may change.
        discrete: Whether ``dynamics`` is already the discrete-time map.
        delay: Dead time of the inputs in sampling steps, one number or one an input: the input of step k acts from step
            k + delay on. None, the default, is not known: the learner looks for it in the data. 0 is known to be none.

    Attributes:
        layout: What z is made of.
        delay: As given; one number an input where it is known.
        plant: The plant's map (x, u, p) -> x+ as CasADi function, without dead time.
        function: The map (z, u, p) -> z+, with it.

    Raises:
        InvalidArgumentError: For non-positive sizes or ``dt``, a negative delay or one of another length, or dynamics
            that return something of another shape or that CasADi cannot evaluate symbolically.
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
        delay: int | Sequence[int] | None = None,
    ) -> None:
        layout = Layout.of(nx, nu, delay)
        if not (np.isfinite(dt) and dt > 0.0):
            raise InvalidArgumentError("dt", expected="a positive number of seconds", actual=str(dt))
        self.dt = float(dt)
        blocks = [Block.free(name, value, "model") for name, value in (parameters or {}).items()]
        self.space = ParameterSpace(blocks)
        self.delay = None if delay is None else layout.delay
        self._lay_out(layout, self._discretised(dynamics, layout, discrete))

    def _lay_out(self, layout: Layout, plant: ca.Function) -> None:
        self.layout, self.plant, self.function = layout, plant, layout.wrapped(plant)

    @property
    def nx(self) -> int:
        """Number of states: the size of z."""
        return self.layout.nx

    @property
    def ny(self) -> int:
        """Size of an observation; nx where there is no memory."""
        return self.layout.ny

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.layout.nu

    def with_delay(self, delay: int | Sequence[int] | None) -> Self:
        """The same model with another dead time, see ``delay`` of the class; None where it is not known.

        Raises:
            InvalidArgumentError: For a negative delay, or one of another length.
        """
        other = copy.copy(self)
        other._lay_out(self.layout.with_delay(delay), self.plant)
        other.delay = None if delay is None else other.layout.delay
        return other

    def with_previous(self) -> Self:
        """The same model with the inputs of the step before in its state, as prices on changes need them."""
        other = copy.copy(self)
        other._lay_out(self.layout.with_previous(), self.plant)
        return other

    def _discretised(self, dynamics: Dynamics, layout: Layout, discrete: bool) -> ca.Function:
        """The map (x, u, p) -> x+ as SX function, p being this model's flat parameter vector."""
        x, u = ca.SX.sym("x", layout.n_states), ca.SX.sym("u", layout.nu)
        theta = ca.SX.sym("p", self.space.size)
        p = self.space.symbols(theta)

        def f(state: ca.SX) -> ca.SX:
            value = ca.densify(ca.SX(dynamics(state, u, p)))
            if value.shape != (layout.n_states, 1):
                raise InvalidArgumentError(
                    "dynamics", expected=f"a column of {layout.n_states} expressions", actual=f"shape {value.shape}"
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

        With dead time, x is z = [y, past inputs].

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
            "nx": self.layout.n_states,
            "nu": self.nu,
            "dt": self.dt,
            "delay": None if self.delay is None else list(self.delay),
            "previous": self.layout.has_previous,
            "function": function_to_json(self.plant),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Model:
        """The inverse of ``to_json``.

        Raises:
            FileFormatError: If the function is damaged or of other shapes.
        """
        model = cls.__new__(cls)
        layout = Layout.of(data["nx"], data["nu"], data["delay"])
        if data["previous"]:
            layout = layout.with_previous()
        model.dt, model.delay = float(data["dt"]), None if data["delay"] is None else layout.delay
        if not (np.isfinite(model.dt) and model.dt > 0.0):
            raise FileFormatError("model.dt", expected="a positive number of seconds", actual=str(data["dt"]))
        model.space = blocks_from_json(data)
        sizes = (layout.n_states, layout.nu, model.space.size)
        model._lay_out(layout, function_from_json(data["function"], "model", inputs=sizes, output=layout.n_states))
        return model


def rk4_expression(f: Callable[[ca.SX], ca.SX], x: ca.SX, dt: float) -> ca.SX:
    """One classical Runge-Kutta step of dx/dt = f(x) from ``x (nx, 1)`` over ``dt`` s."""
    k1 = f(x)
    k2 = f(x + 0.5 * dt * k1)
    k3 = f(x + 0.5 * dt * k2)
    k4 = f(x + dt * k3)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
