"""The units of a nonlinear program: ipopt's tolerances are absolute, and so are those of the tests of its results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.types import Array

if TYPE_CHECKING:
    from .transcription import Expansion, Transcription

_ROUNDING = 1e-7  # of the size of a state: movements that are smaller are no unit
_LEAST = 1e-6  # of what the starts reach, likewise


@dataclass(frozen=True)
class Units:
    """What the variables, constraints and the cost of a program are measured by.

    Attributes:
        centre: What is zero, of the variables, ``(n,)``.
        variables: ``(n,)``.
        constraints: ``(m,)``.
        cost: Scalar.
        A: The derivatives of x_{k+1} by x_k there, ``(N, nx, nx)``; those by x_0, which is given, are left at 0.
        B: Those by u_k, ``(N, nx, nu)``.
    """

    centre: Array
    variables: Array
    constraints: Array
    cost: float
    A: Array
    B: Array

    @property
    def parameters(self) -> Array:
        """The numbers that the scaled program takes."""
        return np.concatenate([self.centre, self.variables, self.constraints, [self.cost]])


def units_at(problem: Transcription, w: Array, p: Array, reached: Array | None = None) -> Units:
    """The units that a trajectory and the derivatives there give.

    A state's unit is how far it moves, from x_0 and the reference on; an input's, what moves a state by its unit in a
    step, or its range if that is less; a constraint's, how far it changes when all variables do by their units; the
    cost's, the largest part of its gradient, or what inputs change of it if that is less.

    Args:
        problem: The program.
        w: Its variables, ``(n,)``.
        p: Its parameters.
        reached: States of several trajectories ``(K, nx)``, a little part of whose spread is the least unit.
    """
    mpc = problem.mpc
    N, nx, nu = mpc.horizon, mpc.nx, mpc.nu
    states, _ = problem.unpack(w)
    points = np.vstack([p[:nx], states, *problem.reference(p)])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    least = _ROUNDING * np.abs(points).max(axis=0)
    if reached is not None:
        least = np.maximum(least, _LEAST * np.ptp(reached, axis=0))
    expansion = problem.expansion(w, p)
    A, B = _linearised(expansion, N, nx, nu)
    width = np.asarray(mpc.action_high) - np.asarray(mpc.action_low)
    bounded = np.isfinite(width)
    # A state that does not move at all: as far as the inputs can move it.
    effect = np.abs(B).max(axis=0)
    moved = (effect * np.where(bounded, width, 0.0)).max(axis=1)
    state_units = _positive(np.maximum(high - low, least), moved, np.ones(nx))
    strongest = (effect / state_units[:, None]).max(axis=0)
    with np.errstate(divide="ignore"):
        input_units = _positive(np.minimum(1.0 / strongest, width), width, np.ones(nu))
    n_trajectory = N * (nu + nx)
    variables = np.r_[np.tile(np.r_[input_units, state_units], N), np.zeros(len(w) - n_trajectory)]
    slopes = np.where(np.isfinite(expansion.slopes), np.abs(expansion.slopes), 0.0)
    changes: Array = np.zeros(len(expansion.constraints))
    np.add.at(changes, expansion.rows, slopes * variables[expansion.columns])
    changes[: N * nx] = np.tile(state_units, N)
    changes = _positive(changes, np.abs(expansion.constraints), np.ones(len(changes)))
    variables[n_trajectory:] = changes[len(changes) - (len(w) - n_trajectory) :]
    # Where the gradient is zero, as at rest, what it becomes a unit away.
    gradients = np.stack([expansion.gradient, problem.gradient(w + variables, p)])
    gradients = np.where(np.isfinite(gradients), gradients, 0.0)
    by_inputs = _effects(gradients[:, :n_trajectory].reshape(2, N, nu + nx), A, B, input_units)
    centre = np.where(bounded, np.asarray(mpc.action_high) - np.where(bounded, width, 0.0) / 2.0, 0.0)
    centres = np.r_[np.tile(np.r_[centre, (low + high) / 2.0], N), np.zeros(len(w) - n_trajectory)]
    largest = float(np.abs(gradients * variables).max())
    cost = min(size for size in (largest, by_inputs, np.inf) if size > 0.0)
    return Units(centres, variables, changes, cost if np.isfinite(cost) else 1.0, A, B)


def _linearised(expansion: Expansion, N: int, nx: int, nu: int) -> tuple[Array, Array]:
    """A and B of :class:`Units`."""
    rows, (stages, entries) = expansion.rows, np.divmod(expansion.columns, nu + nx)
    slopes = np.where(np.isfinite(expansion.slopes), expansion.slopes, 0.0)
    A, B = np.zeros((N, nx, nx)), np.zeros((N, nx, nu))
    model = rows < N * nx
    of_input, of_state = model & (entries < nu), model & (entries >= nu) & (stages < rows // nx)
    B[rows[of_input] // nx, rows[of_input] % nx, entries[of_input]] = slopes[of_input]
    A[rows[of_state] // nx, rows[of_state] % nx, entries[of_state] - nu] = slopes[of_state]
    return A, B


def _effects(gradients: Array, A: Array, B: Array, input_units: Array) -> float:
    """The largest of the terms that make up the gradient by an input, over its unit.

    Args:
        gradients: Of the cost by ``u_k, x_{k+1}``, several of them: ``(K, N, nu + nx)``.
        A: See :class:`Units`.
        B: Likewise.
        input_units: ``(nu,)``.
    """
    nu = len(input_units)
    with np.errstate(over="ignore", invalid="ignore"):
        adjoint = np.abs(costates(gradients[:, :, nu:], A))
        terms = np.abs(gradients[:, :, :nu]) + np.einsum("skx,kxu->sku", adjoint, np.abs(B))
        largest = float((terms * input_units).max())
    return largest if np.isfinite(largest) else np.inf


def costates(gradients: Array, A: Array) -> Array:
    """What a cost of gradients ``(..., N, nx)`` by x_1 ... x_N changes with x_{k+1}, the later states moving along."""
    result = gradients.copy()
    for k in range(len(A) - 2, -1, -1):
        result[..., k, :] += result[..., k + 1, :] @ A[k + 1]
    return result


def _positive(*choices: Array) -> Array:
    """Element by element the first of the numbers that is finite and positive."""
    found = choices[-1]
    for choice in reversed(choices[:-1]):
        found = np.where(np.isfinite(choice) & (choice > 0.0), choice, found)
    return np.asarray(found)
