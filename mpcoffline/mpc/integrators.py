"""How an ordinary differential equation dx/dt = f_theta(x, u) becomes a map x_{k+1}: the schemes, in CasADi."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
import scipy.linalg

from mpcoffline.core import limits
from mpcoffline.core.errors import FileFormatError, InvalidArgumentError
from mpcoffline.core.limits import check_limit
from mpcoffline.core.types import Array

from .expressions import is_affine

#: The most substeps of RK4: with more, a solver's code takes minutes to compile.
MOST_SUBSTEPS = 64
_MOST_HALVINGS = 60
_TERMS = 8  # of the exponential's series: the last one left out is 1e-10 of the first at _SMALL
_SMALL = 0.25  # norm of A dt below which the series is summed
_MARGIN = 2  # more halvings than theta needs now: it will move
_LONGEST = 5_000  # multiplications of an exponential of theta that is taken unasked
_TEXT = re.compile(r"(exact|rk4)(?::([1-9][0-9]{0,18}))?")


@dataclass(frozen=True)
class Scheme:
    """How one sampling step is integrated, the input held.

    Attributes:
        kind: ``"exact"``: the exponential of an ODE that is affine in (x, u); ``"rk4"``: classical Runge-Kutta.
        substeps: RK4's substeps; of the exponential, in how many equal parts the step is halved for its series, a power
            of two.
    """

    kind: Literal["exact", "rk4"]
    substeps: int = 1

    def __str__(self) -> str:
        """As in ``integrator=``: ``"exact:16"``, ``"rk4:4"``."""
        return f"{self.kind}:{self.substeps}"

    @classmethod
    def of(cls, text: object, error: type[FileFormatError | InvalidArgumentError] = InvalidArgumentError) -> Scheme:
        """The inverse of ``str``; without a number of substeps it is 1.

        Raises:
            InvalidArgumentError: For anything else, or ``error``.
        """
        found = _TEXT.fullmatch(text) if isinstance(text, str) else None
        scheme = cls("exact" if found[1] == "exact" else "rk4", int(found[2] or 1)) if found else None
        if scheme is not None and scheme.substeps <= (MOST_SUBSTEPS if scheme.kind == "rk4" else 1 << _MOST_HALVINGS):
            return scheme
        expected = f"'auto', 'exact', 'rk4' or 'rk4:N' with N from 1 to {MOST_SUBSTEPS} substeps"
        raise error("integrator", expected=expected, actual=f"{text!r:.60}")


def integrated(ode: ca.Function, scheme: Scheme, dt: float, x: ca.SX, u: ca.SX, theta: ca.SX) -> ca.SX:
    """The state ``(nx, 1)`` after ``dt`` from ``x (nx, 1)``, ``u (nu, 1)`` held.

    Args:
        ode: f as SX function ``(x, u, theta) -> dx/dt``; affine in (x, u) for ``"exact"``.
        scheme: How.
        dt: Sampling time.
        x: States.
        u: Inputs.
        theta: The model's flat parameters.

    Raises:
        InvalidArgumentError: For more operations than an expression may have; before any is made.
    """
    if scheme.kind == "exact":
        return _exponential(ode, scheme.substeps, dt, x, u, theta)
    count, hint = 4 * scheme.substeps * ode.n_instructions(), "Take fewer substeps."
    check_limit("integrator", "operations", count, limits.EXPRESSION_NODES, hint=hint, error=InvalidArgumentError)
    for _ in range(scheme.substeps):
        x = rk4_expression(lambda state: ode(state, u, theta), x, dt / scheme.substeps)
    return x


def rk4_expression(f: Callable[[ca.SX], ca.SX], x: ca.SX, dt: float | ca.SX) -> ca.SX:
    """One classical Runge-Kutta step of dx/dt = f(x) from ``x (nx, 1)`` over ``dt`` s."""
    k1 = f(x)
    k2 = f(x + 0.5 * dt * k1)
    k3 = f(x + 0.5 * dt * k2)
    k4 = f(x + dt * k3)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def _exponential(ode: ca.Function, parts: int, dt: float, x: ca.SX, u: ca.SX, theta: ca.SX) -> ca.SX:
    """The exact step of dx/dt = A x + B u + c, up to rounding, as an expression in theta, too.

    ::

        x+ = E x + G [u; 1],     E = e^{A dt},     G = dt phi_1(A dt) [B, c],     phi_1(M) = sum_k M^k / (k + 1)!

    The series is summed for h = dt / parts; doubling h makes E E of E and E G + G of G. What depends on theta alone
    costs the solvers nothing: they compute it once a problem.
    """
    A, inhomogeneous = _affine_parts(ode, theta)
    count = _multiplications(A, inhomogeneous, parts)
    hint = "Take integrator='auto'."
    check_limit("integrator", "operations", count, limits.EXPRESSION_NODES, hint=hint, error=InvalidArgumentError)
    h, nx = dt / parts, x.numel()
    phi = ca.SX.eye(nx)
    for k in range(_TERMS, 1, -1):
        phi = ca.SX.eye(nx) + h / k * (A @ phi)
    E, G = ca.SX.eye(nx) + h * (A @ phi), h * (phi @ inhomogeneous)
    for _ in range(parts.bit_length() - 1):
        E, G = E @ E, E @ G + G
    return ca.densify(E @ x + G @ ca.vertcat(u, 1.0))


def _affine_parts(ode: ca.Function, theta: ca.SX) -> tuple[ca.SX, ca.SX]:
    """A ``(nx, nx)`` and [B, c] ``(nx, nu + 1)`` of an affine ODE, sparse where they are zero for every theta."""
    x, u = ca.SX.sym("x", *ode.size_in(0)), ca.SX.sym("u", *ode.size_in(1))
    rate = ode(x, u, theta)
    A, B = (ca.sparsify(ca.jacobian(rate, z)) for z in (x, u))
    return A, ca.horzcat(B, ca.sparsify(ode(ca.DM.zeros(x.shape), ca.DM.zeros(u.shape), theta)))


def exact_scheme(ode: ca.Function, dt: float, theta: Array, given: Scheme | None = None) -> Scheme:
    """The exponential whose series is exact up to rounding at theta and around it.

    Args:
        ode: An affine ODE.
        dt: Sampling time.
        theta: The model's flat parameters.
        given: The scheme there is; it stays where it is good enough at theta.
    """
    A = ca.Function("A", [p := ca.SX.sym("p", *ode.size_in(2))], [ca.densify(_affine_parts(ode, p)[0])])(theta).full()
    if not np.isfinite(A).all():
        return given or Scheme("exact", 1 << _MARGIN)
    balanced, _ = scipy.linalg.matrix_balance(A)  # by powers of two: units do not matter
    size = dt * float(np.linalg.norm(balanced, 1))
    needed = int(np.clip(np.ceil(np.log2(max(size / _SMALL, 1.0))), 0, _MOST_HALVINGS - _MARGIN))
    if given is not None and given.substeps >= 1 << needed:
        return given
    return Scheme("exact", 1 << (needed + _MARGIN))


def first_scheme(ode: ca.Function, dt: float, theta: Array, asked: Scheme | None) -> Scheme:
    """The scheme asked for, else the exponential of an affine ODE, else one RK4 step until more is known.

    Raises:
        InvalidArgumentError: If the exponential is asked for of an ODE that is not affine.
    """
    if asked is not None and asked.kind == "rk4":
        return asked
    if is_affine(ode):
        exact = exact_scheme(ode, dt, theta)
        if asked is not None or is_short(ode, exact):
            return exact
    elif asked is not None:
        expected = "'auto' or 'rk4:N' for dynamics that are not affine in (x, u)"
        raise InvalidArgumentError("integrator", expected=expected, actual=repr(asked.kind))
    return Scheme("rk4")


def is_short(ode: ca.Function, scheme: Scheme) -> bool:
    """Whether an affine ODE's exponential has few enough operations to be taken unasked."""
    theta = ca.SX.sym("theta", *ode.size_in(2))
    A, inhomogeneous = _affine_parts(ode, theta)
    longest = _LONGEST if ca.depends_on(A, theta) else limits.COMPILED_NODES
    return _multiplications(A, inhomogeneous, scheme.substeps) <= longest


def _multiplications(A: ca.SX, inhomogeneous: ca.SX, parts: int) -> int:
    """As many as :func:`_exponential` makes, found by where its matrices are not zero."""
    a, b = (np.asarray(ca.DM(m.sparsity(), 1.0).full()) for m in (A, inhomogeneous))
    phi, count = np.eye(len(a)), 0.0
    for _ in range(_TERMS):
        count += (a @ phi).sum()
        phi = np.minimum(np.eye(len(a)) + a @ phi, 1.0)
    squarings = parts.bit_length() - 1
    return int(count + (phi @ b).sum() + squarings * ((phi @ phi).sum() + (phi @ (phi @ b > 0.0)).sum()))
