"""The prediction model x_{k+1} = f_theta(x_k, u_k) of (MPC), written once in CasADi."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpcoffline.core.checks import check_number
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.places import warn_once
from mpcoffline.core.types import Array

from .component import Component, blocks_from_json
from .expressions import function_from_json, function_to_json, is_affine, traced
from .integration_check import IntegrationCheck, Rows, checked, sampled, shortfall
from .integrators import Scheme, exact_scheme, first_scheme, integrated
from .labels import Labels
from .layout import Layout
from .parameters import Block, Parameter, ParameterSpace
from .signals import Named, Signal, takes_signals
from .substeps import Choice, Flow, choice_from, choice_on
from .torch_import import TorchExpression

Dynamics = Callable[..., ca.SX]  # (x, u, p) or, with signals, (x, u, p, d)


class Model(Component):
    """A model f_theta, from an ordinary differential equation or from a discrete-time map.

    An ODE is integrated over ``dt`` with the input held. ``integrator="auto"`` solves one that is affine in (x, u)
    exactly, by the matrix exponential; any other by RK4, with as many substeps as it needs: first as the MPC's
    reference and input bounds tell (:class:`MPC` chooses when it is made), then as the log tells (a learner chooses on
    it, and again with the identified parameters). :meth:`check` says how good that is.

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
        integrator: ``"auto"``; ``"exact"``, for an ODE that is affine in (x, u); ``"rk4"``, one Runge-Kutta step a
            sampling time; ``"rk4:N"``, N of them.
        signals: What comes from outside: :class:`Signal` columns of the observation after the plant's states. Dynamics
            that take a fourth argument get their present values by name, ``(x, u, p, d)`` with ``d.price``.
        delay: Dead time of the inputs in sampling steps, one number or one an input: the input of step k acts from step
            k + delay on. None, the default, is not known: the learner looks for it in the data. 0 is known to be none.
        labels: What states and inputs are called, for messages, tables and comments in C.

    Raises:
        InvalidArgumentError: For non-positive sizes or ``dt``, a negative delay or one of another length, dynamics that
            return something of another shape or that CasADi cannot evaluate symbolically, or an integrator that is none
            or not for these dynamics.

    Attributes:
        ode: dx/dt as CasADi function ``(x, u, p)``, p flat; None of a discrete map.
        scheme: How it is integrated now; None of a discrete map.
        integrator: What was asked for; ``"map"`` of a discrete map.
        settled: Whether the scheme was asked for or chosen; a model with ``"auto"`` waits for its MPC.
        layout: What z is made of.
        delay: As given; one number an input where it is known.
        plant: The plant's map (x, u, p) -> x+ as CasADi function, without dead time.
        function: The map (z, u, p) -> z+, with it.
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
        integrator: str = "auto",
        delay: int | Sequence[int] | None = None,
        signals: Sequence[Signal] = (),
        labels: Labels | None = None,
    ) -> None:
        layout = replace(Layout.of(nx, nu, delay, signals), labels=labels or Labels())
        check_number("dt, in s", dt, 0.0)
        if discrete and integrator != "auto":
            raise InvalidArgumentError("integrator", expected="none for a discrete map", actual=repr(integrator))
        self.dt: float = float(dt)
        self.layout: Layout = layout
        self.delay: tuple[int, ...] | None = None if delay is None else layout.delay
        blocks = [Block.free(name, value, "model") for name, value in (parameters or {}).items()]
        self.space: ParameterSpace = ParameterSpace(blocks)
        function = self._traced(dynamics)
        if discrete:
            self._take(function, "map", None)
        else:
            asked = None if integrator == "auto" else Scheme.of(integrator)
            scheme = first_scheme(function, self.dt, self.space.theta, asked)
            self._take(function, integrator, scheme, settled=asked is not None)

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
        integrator: str = "auto",
        delay: int | Sequence[int] | None = None,
        signals: Sequence[Signal] = (),
    ) -> Model:
        """A model from a ``torch.nn.Module`` that was trained elsewhere.

        The module maps rows of ``nx + nu`` numbers, or two arguments ``(x, u)``, to rows of ``nx``; with ``signals``
        rows of ``nx + nu + len(signals)``, or three arguments ``(x, u, d)``. What it is made of
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
            integrator: As in the class, for ``discrete=False``.
            delay: As in the class.
            signals: As in the class; the module gets their present values, in this order.

        Raises:
            InvalidArgumentError: For what cannot be traced, a layer that is not known (it is named), or sizes that do
                not fit.
        """
        network = TorchExpression(module)

        def dynamics(x: ca.SX, u: ca.SX, p: dict[str, ca.SX], d: Named) -> ca.SX:
            outside = [ca.vertcat(*(d[signal.name] for signal in signals))] if signals else []
            try:
                out = network([x, u, *outside], p if learn_weights else None)
            except (RuntimeError, IndexError) as error:
                sizes = " + ".join(str(size) for size in (nx, nu, len(signals)) if size)
                raise InvalidArgumentError(
                    "module", expected=f"one of {sizes} numbers a row", actual=str(error).splitlines()[-1][:200]
                ) from error
            return x + out if residual else out

        options: dict[str, Any] = {"integrator": integrator, "delay": delay, "signals": signals}
        parameters = network.weights if learn_weights else None
        return cls(dynamics, nx, nu, dt, parameters, discrete=discrete or residual, **options)

    def _take(self, function: ca.Function, integrator: str, scheme: Scheme | None, *, settled: bool = True) -> None:
        """Takes an ODE with its scheme, or without one a map as it is."""
        self.ode: ca.Function | None = None if scheme is None else function
        self.integrator: str = integrator
        self.scheme: Scheme | None = scheme
        self.settled: bool = settled or scheme is None or scheme.kind == "exact"
        self._lay_out(self.layout, self._discretised(function))

    def _lay_out(self, layout: Layout, plant: ca.Function) -> None:
        self.layout = layout
        self.plant: ca.Function = plant
        self.function: ca.Function = layout.wrapped(plant)

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

    def with_signals(self, signals: Sequence[Signal]) -> Self:
        """The same model with signals of the same names and columns that go on otherwise, as by learned profiles."""
        other = copy.copy(self)
        other._lay_out(replace(self.layout, signals=tuple(signals)), self.plant)
        return other

    def with_previous(self) -> Self:
        """The same model with the inputs of the step before in its state, as prices on changes need them."""
        other = copy.copy(self)
        other._lay_out(self.layout.with_previous(), self.plant)
        return other

    def plus(self, addition: ca.Function) -> Self:
        """The same model with ``addition(x, u)`` on the plant's map, which is a discrete one then."""
        x, u, theta = (ca.SX.sym(name, *self.plant.size_in(i)) for i, name in enumerate("xup"))
        other, reached = copy.copy(self), self.plant(x, u, theta) + addition(x, u)
        other._take(ca.Function("dynamics", [x, u, theta], [reached]), "map", None)
        return other

    def _traced(self, dynamics: Dynamics) -> ca.Function:
        """What the user wrote as SX function (x, [u, d], p), p being this model's flat parameter vector."""
        x, u = ca.SX.sym("x", self.layout.n_states), ca.SX.sym("u", len(self.layout.acting))
        theta = ca.SX.sym("p", self.space.size)
        outside = [self.layout.named(u[self.nu :])] if takes_signals(dynamics) else []
        try:
            value = ca.densify(ca.SX(dynamics(x, u[: self.nu], self.space.symbols(theta), *outside)))
            if value.shape != (self.layout.n_states, 1):
                raise InvalidArgumentError(
                    "dynamics",
                    expected=f"a column of {self.layout.n_states} expressions",
                    actual=f"shape {value.shape}",
                )
            function = ca.Function("dynamics", [x, u, theta], [value])
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

    def _discretised(self, function: ca.Function) -> ca.Function:
        """The map of one step (x, u, p) -> x+ as SX function."""
        x, u, theta = (ca.SX.sym(name, *function.size_in(i)) for i, name in enumerate("xup"))
        if self.scheme is None:
            reached = function(x, u, theta)
        else:
            reached = integrated(function, self.scheme, self.dt, x, u, theta)
        return traced("dynamics", ca.Function("model", [x, u, theta], [ca.cse(reached)], ["x", "u", "p"], ["x_next"]))

    def with_scheme(self, scheme: Scheme) -> Model:
        """The same model, its ODE integrated otherwise.

        Raises:
            InvalidArgumentError: For a discrete map.
        """
        if self.ode is None:
            raise InvalidArgumentError("model", expected="one of an ODE", actual="a discrete map")
        if self.settled and scheme == self.scheme:
            return self
        other = copy.copy(self)
        other._take(self.ode, self.integrator, scheme)
        return other

    def suited_to(self, start: Array, inputs: Array) -> Model:
        """The model with the substeps that ``integrator="auto"`` takes before there is a log; itself once it has some.

        Args:
            start: A state that matters, as the reference, ``(n_states,)``.
            inputs: Inputs that may be applied, with usual signals beside them, ``(m, nu + n_signals)``.
        """
        if self.settled or self.ode is None:
            return self
        flow = Flow(self.ode, self.dt, self.space.theta)
        choice = choice_from(flow, start, inputs)
        return self._with_substeps(choice, "with the inputs that may be applied")

    def suited_to_log(self, table: Rows, *, finer: bool = False) -> Model:
        """The model with the substeps that ``integrator="auto"`` takes on a log; itself where another was asked for.

        Args:
            table: The transitions.
            finer: Whether there may only be more of them than now.
        """
        if self.integrator != "auto" or self.ode is None or self.scheme is None:
            return self
        if self.scheme.kind == "exact":
            return self.with_scheme(exact_scheme(self.ode, self.dt, self.space.theta, self.scheme))
        flow = Flow(self.ode, self.dt, self.space.theta)
        choice = choice_on(flow, *sampled(table, self.layout), self.scheme.substeps if finer else 1)
        return self._with_substeps(choice, "on this log")

    def _with_substeps(self, choice: Choice, where: str) -> Model:
        """The model with what was chosen; warns, once, where that is not enough."""
        if advice := shortfall(choice):
            warn_once(f"A step of {self.dt:g} s of the model {self!r} is not accurate {where}: {advice}")
        return self.with_scheme(Scheme("rk4", choice.substeps))

    def check(self, table: Rows) -> IntegrationCheck:
        """How large the errors of integration are on a log, and what to do about them.

        Args:
            table: Transitions, as a :class:`~mpcoffline.TransitionTable`.
        """
        if self.ode is None or self.scheme is None:
            return IntegrationCheck("map", 1, 0.0, 0.0, 0, "")
        flow, fixed = Flow(self.ode, self.dt, self.space.theta), self.integrator != "auto"
        return checked(flow, self.scheme, self._plant_step, table, self.layout, fixed=fixed)

    def _plant_step(self, x: Array, u: Array) -> Array:
        """The plant's states ``(B, n_states)`` after x, u acting."""
        return np.asarray(self.plant(x.T, u.T, self.space.theta).full().T)

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
        """A JSON-able description; the ODE, or the discrete map, as a list of instructions."""
        return super().to_json() | {
            "nx": self.layout.n_states,
            "nu": self.nu,
            "dt": self.dt,
            "integrator": self.integrator,
            "scheme": None if self.scheme is None else str(self.scheme),
            "settled": self.settled,
            "delay": None if self.delay is None else list(self.delay),
            "previous": self.layout.has_previous,
            "signals": [signal.to_json() for signal in self.layout.signals],
            "labels": self.layout.labels.to_json(),
            "function": function_to_json(self.plant if self.ode is None else self.ode),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Model:
        """The inverse of ``to_json``.

        Raises:
            FileFormatError: If the function is damaged or of other shapes, or its integrator is none or not for it.
        """
        model = cls.__new__(cls)
        layout = Layout.of(data["nx"], data["nu"], data["delay"], [Signal.from_json(s) for s in data["signals"]])
        layout = replace(layout, labels=Labels.from_json(data.get("labels", {"states": [], "inputs": []})))
        if data["previous"] is True:
            layout = layout.with_previous()
        model.dt, model.delay = float(data["dt"]), None if data["delay"] is None else layout.delay
        if not (np.isfinite(model.dt) and model.dt > 0.0):
            raise FileFormatError("model.dt", expected="a positive number of seconds", actual=str(data["dt"]))
        model.space = blocks_from_json(data)
        sizes = (layout.n_states, len(layout.acting), model.space.size)
        function = function_from_json(data["function"], "model", inputs=sizes, output=layout.n_states)
        integrator, scheme = data["integrator"], None
        if integrator != "map":
            scheme = Scheme.of(data["scheme"], FileFormatError)
            if integrator != "auto":
                Scheme.of(integrator, FileFormatError)
            if scheme.kind == "exact" and not is_affine(function):
                raise FileFormatError("model.scheme", expected="that of an affine model", actual=str(scheme))
        model.layout = layout
        model._take(function, integrator, scheme, settled=data["settled"] is True)
        return model
