"""How many substeps an ODE's Runge-Kutta step needs: by step doubling, on the log's rows or before there is a log."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from mpcoffline.core.types import Array

from .integrators import MOST_SUBSTEPS, rk4_expression
from .scaling import increments_scale

_TYPICAL, _WORST = 0.02, 0.2  # errors of a step that may be, in increments
_QUANTILE = 0.99
_POOR = 3.0  # the error of a smooth ODE falls by 16 a doubling, that of one with a kink by 2
_NEAR = 2.0
_MOST_OPERATIONS = 50_000  # of a step: half of what may be compiled
_SEQUENCES, _STEPS = 16, 10
_FREE_QUANTILE = 0.9  # some sequences of inputs lead where no controller goes
_MODE = 1e-3  # error of a mode of the linearised ODE


@dataclass(frozen=True)
class Doubling:
    """A number of substeps against twice as many.

    Attributes:
        substeps: The smaller number.
        typical: 99 % of the rows differ by less, in increments (the row's own one plus their spread).
        worst: The largest difference.
    """

    substeps: int
    typical: float
    worst: float

    @property
    def excess(self) -> float:
        """The error in units of what may be."""
        return max(self.typical / _TYPICAL, self.worst / _WORST)


@dataclass(frozen=True)
class Choice:
    """A number of substeps, and why.

    Attributes:
        substeps: The number to take.
        reason: ``"enough"``: the errors are small with it; ``"kink"``: they fall as slowly with more substeps as those
            of an ODE that is not smooth; ``"fast"``: as many as there may be are too few.
    """

    substeps: int
    reason: Literal["enough", "kink", "fast"] = "enough"


class Flow:
    """An ODE's solution over a sampling step by RK4, for many states at once.

    Args:
        ode: f as SX function ``(x, u, theta) -> dx/dt``.
        dt: Sampling time.
        theta: The model's flat parameters.
    """

    ode: ca.Function
    dt: float

    def __init__(self, ode: ca.Function, dt: float, theta: Array) -> None:
        self.ode, self.dt, self._theta = ode, dt, theta
        x, u, p = (ca.SX.sym(f"i{i}", *ode.size_in(i)) for i in range(3))
        h = ca.SX.sym("h")
        step = ca.cse(rk4_expression(lambda state: ode(state, u, p), x, h))
        self._substep = ca.Function("substep", [x, u, p, h], [step])
        self._slope = ca.Function("slope", [x, u, p], [ca.densify(ca.jacobian(ode(x, u, p), x))])

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self.ode.numel_in(0))

    @property
    def most(self) -> int:
        """As many substeps as a solver can be compiled with."""
        return int(np.clip(_MOST_OPERATIONS // max(1, self._substep.n_instructions()), 1, MOST_SUBSTEPS))

    def __call__(self, x: Array, u: Array, n: int) -> Array:
        """States ``(B, nx)`` a step after x ``(B, nx)`` under u ``(B, nu)``, with n substeps."""
        state, held = ca.DM(x.T), ca.DM(u.T)
        for _ in range(n):
            state = self._substep(state, held, self._theta, self.dt / n)
        return np.asarray(state.full().T)

    def exact(self, x: Array, u: Array) -> Array:
        """The same of an affine ODE, by the exponential of [[A, B, c], [0, 0, 0]] dt (scipy's ``expm``)."""
        nx, nu = x.shape[1], u.shape[1]
        c = self.ode(np.zeros(nx), np.zeros(nu), self._theta).full()
        A = self.ode(np.eye(nx), np.zeros((nu, nx)), self._theta).full() - c
        B = self.ode(np.zeros((nx, nu)), np.eye(nu), self._theta).full() - c
        augmented = np.zeros((nx + nu + 1, nx + nu + 1))
        augmented[:nx] = np.hstack([A, B, c])
        step = scipy.linalg.expm(self.dt * augmented)[:nx]
        return np.asarray(np.hstack([x, u, np.ones((len(x), 1))]) @ step.T)

    def defined(self, x: Array, u: Array) -> NDArray[np.bool_]:
        """Where dx/dt is finite, ``(B,)``."""
        finite: NDArray[np.bool_] = np.isfinite(self.ode(x.T, u.T, self._theta).full())
        return np.asarray(finite.all(axis=0))

    def modes(self, x: Array, u: Array) -> Array:
        """Eigenvalues of df/dx times dt at one state, ``(nx,)``; none where that is not finite."""
        slope = self.dt * self._slope(x, u, self._theta).full()
        return np.asarray(np.linalg.eigvals(slope) if np.isfinite(slope).all() else [], dtype=np.complex128)


def choice_on(flow: Flow, x: Array, u: Array, reached: Array, least: int = 1, spread: Array | None = None) -> Choice:
    """The substeps that rows ask for, logged ones or planned ones.

    Args:
        flow: The ODE's solution.
        x: States, ``(B, nx)``.
        u: Inputs, ``(B, nu)``.
        reached: States after them, ``(B, nx)``.
        least: The fewest substeps.
        spread: Of the increments that errors are measured in, ``(nx,)``; by default that of these rows.
    """
    known = flow.defined(x, u)
    if not known.any():
        return Choice(least)
    x, u, reached = x[known], u[known], reached[known]
    spread, coarse = increments_scale(x, reached) if spread is None else spread, {least: flow(x, u, least)}

    def compared(n: int) -> Doubling:
        coarse[2 * n] = flow(x, u, 2 * n)
        errors = relative(coarse[n] - coarse[2 * n], spread + np.abs(reached - x))
        return Doubling(n, _quantile(errors, _QUANTILE), float(errors.max()))

    return _doubled(compared, least, flow.most)


def choice_from(flow: Flow, start: Array, inputs: Array) -> Choice:
    """The substeps that the model's own answers to sequences of inputs ask for, before there is a log.

    Modes of the linearised ODE that no input excites count, too::

        |R(z / n)^n - e^z| <= 1e-3 max(1, |e^z|),      R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24 (RK4)

    for the eigenvalues z of df/dx times dt, at the start under each of the inputs.

    Args:
        flow: The ODE's solution.
        start: A state that matters, as the reference, ``(nx,)``.
        inputs: Inputs that may be applied, ``(m, nu)``.
    """
    modes, least = np.concatenate([flow.modes(start, u) for u in inputs]), 1
    while not _followed(modes, least):
        least *= 2
        if least > flow.most:
            return Choice(1, "fast")
    drawn = np.random.default_rng(0).uniform(size=(_STEPS, _SEQUENCES, inputs.shape[1]))
    low, high = inputs.min(axis=0), inputs.max(axis=0)
    held = np.broadcast_to(inputs, (_STEPS, *inputs.shape))
    sequences = np.concatenate([held, low + drawn * (high - low)], axis=1)

    def compared(n: int) -> Doubling:
        error = _quantile(_errors_along(flow, start, sequences, n), _FREE_QUANTILE)
        return Doubling(n, error, error)

    return _doubled(compared, least, flow.most)


def _followed(modes: NDArray[np.complex128], n: int) -> bool:
    """Whether n substeps follow the modes of a linear ODE; see :func:`choice_from`."""
    with np.errstate(over="ignore", invalid="ignore"):
        z, exact = modes / n, np.exp(modes)
        found = (1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))) ** n
        missed = np.abs(found - exact) / np.maximum(1.0, np.abs(exact))
    return bool((missed <= _MODE).all())


def _errors_along(flow: Flow, start: Array, sequences: Array, n: int) -> Array:
    """Errors of n substeps from the states that 2 n lead to, in increments."""
    x, rows = np.broadcast_to(start, (sequences.shape[1], len(start))), []
    for u in sequences:
        known = np.isfinite(x).all(axis=1) & flow.defined(x, u)
        fine = flow(x, u, 2 * n)
        rows.append(np.stack([x, flow(x, u, n), fine])[:, known])
        x = fine
    x, coarse, fine = np.concatenate(rows, axis=1)
    increments = fine - x
    finite = increments[np.isfinite(increments).all(axis=1)]
    with np.errstate(over="ignore"):
        spread = finite.std(axis=0) if len(finite) else 0.0
        return relative(coarse - fine, spread + np.abs(increments))


def _doubled(compared: Callable[[int], Doubling], least: int, most: int) -> Choice:
    """Doubles until the error is small, or falls twice by so little that it is no smooth ODE's.

    The error may grow at first, where RK4 is unstable. Where none is small, the fewest substeps with an error near the
    smallest are taken.
    """
    tried: list[Doubling] = [compared(least)]
    reason: Literal["fast", "kink"] = "fast"
    while tried[-1].excess > 1.0 and 2 * tried[-1].substeps <= most:
        tried.append(compared(2 * tried[-1].substeps))
        falls = [a.excess / b.excess for a, b in itertools.pairwise(tried[-3:]) if np.isfinite(a.excess)]
        if len(falls) == 2 and 1.0 <= min(falls) <= max(falls) < _POOR and tried[-1].excess > 1.0:
            reason = "kink"
            break
    smallest = min(one.excess for one in tried)
    if smallest <= 1.0:
        return Choice(tried[-1].substeps)
    return Choice(next(one.substeps for one in tried if one.excess <= _NEAR * smallest), reason)


def relative(errors: Array, size: Array) -> Array:
    """The largest of a row's errors relative to their size, ``(B,)``; infinite where they are not finite."""
    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.where(errors == 0.0, 0.0, np.abs(errors) / size)
    return np.asarray(np.where(np.isnan(found), np.inf, found).max(axis=1, initial=0.0))


def _quantile(errors: Array, q: float) -> float:
    """A quantile that is one of the errors, so that infinite ones do no harm; 0 of none."""
    return float(np.quantile(errors, q, method="higher")) if len(errors) else 0.0
