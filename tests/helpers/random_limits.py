"""Random problems with limits, in any units: what ddp and ipopt are compared on by the thousand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline.mpc import MPC, Constraint, Model, Penalty, QuadraticCost, StateBounds

Array = NDArray[np.float64]
KINDS = ("linear", "chain", "bent", "obstacle", "bilinear")


class Units(NamedTuple):
    """What a problem is multiplied by.

    Attributes:
        x: States, ``(nx,)``.
        u: Inputs, ``(nu,)``.
        h: Each of the limits, ``(n,)``.
        cost: Stage and terminal cost.
    """

    x: Array
    u: Array
    h: Array
    cost: float


@dataclass(frozen=True)
class Limit:
    """h(x, u) <= 0, or h(x) <= 0 at the end, in units of its own; bounds of states where ``bounds`` are given."""

    h: Callable[..., Any] | None
    soft: Penalty | None = None
    terminal: bool = False
    bounds: tuple[Array, Array] | None = None


@dataclass(frozen=True)
class RandomProblem:
    """A problem that a seed gives: model, costs, one to three limits.

    Attributes:
        kind: One of :data:`KINDS`.
    """

    seed: int
    kind: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", KINDS[self.seed % len(KINDS)])

    def mpc(self, units: Units | None = None) -> MPC:
        """The problem, in other units if they are given."""
        rng = np.random.default_rng([self.seed, 1])
        step, nx, nu = _step(self.kind, rng)
        horizon = int(rng.integers(8, 41))
        weights, reference = rng.uniform(0.1, 2.0, nx), 0.3 * rng.normal(size=nx)
        efforts = 10.0 ** rng.uniform(-2.0, 0.0, nu)
        end = 10.0 ** rng.uniform(-1.0, 1.0) * weights
        bound = rng.uniform(0.5, 2.0, nu)
        limits = _limits(self.kind, rng, nx, nu)
        unit = units or Units(np.ones(nx), np.ones(nu), np.ones(len(limits)), 1.0)
        discount = rng.uniform(0.9, 1.0)

        def scaled(x: Any, u: Any, p: Any) -> Any:
            return unit.x * step(x / unit.x, u / unit.u)

        return MPC(
            Model(scaled, nx, nu, 0.1, discrete=True),
            QuadraticCost(
                np.diag(weights / unit.x**2) * unit.cost,
                np.diag(efforts / unit.u**2) * unit.cost,
                x_ref=reference * unit.x,
            ),
            QuadraticCost(np.diag(end / unit.x**2) * unit.cost, x_ref=reference * unit.x),
            horizon=horizon,
            discount=discount,
            action_low=-bound * unit.u,
            action_high=bound * unit.u,
            constraints=[_in_units(limit, i, unit) for i, limit in enumerate(limits)],
        )

    def units(self, decades: float = 3.0) -> Units:
        """Random ones, from 10^-decades to 10^decades."""
        rng, plain = np.random.default_rng([self.seed, 2]), self.mpc()
        n = len(plain.constraints or ())
        x, u, h = (10.0 ** rng.uniform(-decades, decades, size) for size in (plain.nx, plain.nu, n))
        return Units(x, u, h, float(10.0 ** rng.uniform(-decades, decades)))

    def states(self, n: int) -> Array:
        """``(n, nx)``, some of them beyond the limits, or where these cannot be kept."""
        rng, nx = np.random.default_rng([self.seed, 3]), self.mpc().nx
        states = rng.uniform(0.2, 1.5, (n, 1)) * rng.normal(size=(n, nx))
        if self.kind == "obstacle":
            states[:, :2] = rng.uniform(1.2, 2.4, (n, 2))
            states[:, 2:] *= 0.3
        return states


def _step(kind: str, rng: np.random.Generator) -> tuple[Callable[[Any, Any], Any], int, int]:
    """``(x, u) -> x+`` in CasADi, and its sizes."""
    if kind == "obstacle":
        return (lambda x, u: ca.vertcat(x[:2] + 0.1 * x[2:] + 0.005 * u, x[2:] + 0.1 * u)), 4, 2
    nx, nu = int(rng.integers(2, 6)), int(rng.integers(1, 3))
    A, B = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
    A = rng.uniform(0.8, 1.05) * A / np.abs(np.linalg.eigvals(A)).max()
    if kind == "chain":
        A, B = np.eye(nx) + 0.3 * np.eye(nx, k=1), np.zeros((nx, nu))
        B[-1, 0] = 0.3
        B[0, -1] += 0.3 * (nu - 1)
    C, D = 0.3 * rng.normal(size=(nx, nx)), 0.3 * rng.normal(size=(nx, nx))
    A, B, C, D = map(ca.DM, (A, B, C, D))
    if kind == "bent":
        return (lambda x, u: A @ x + B @ u + C @ ca.sin(x)), nx, nu
    if kind == "bilinear":
        return (lambda x, u: A @ ca.tanh(x) + B @ u + (D @ ca.tanh(x)) * u[0]), nx, nu
    return (lambda x, u: A @ x + B @ u), nx, nu


def _limits(kind: str, rng: np.random.Generator, nx: int, nu: int) -> list[Limit]:
    """One to three of the ways to write one, hard in half of the cases."""
    found = []
    if kind == "obstacle":
        found.append(Limit(lambda x, u: 0.25 - (x[0] - 1.0) ** 2 - (x[1] - 0.9) ** 2, _penalty(rng)))
    for way in rng.permutation(5)[: int(rng.integers(1, 4))].tolist():
        i, a, level = int(rng.integers(nx)), rng.normal(size=nx), rng.uniform(0.3, 1.5)
        b, soft = rng.normal(size=nu), _penalty(rng)
        if way == 0:
            low, high = np.full(nx, -np.inf), np.full(nx, np.inf)
            low[i], high[i] = -level, rng.uniform(0.3, 1.5)
            found.append(Limit(None, soft, bounds=(low, high)))
        elif way == 1:
            found.append(Limit(lambda x, u, a=a, c=level: ca.dot(a, x) - 2.0 * c, soft))
        elif way == 2:
            found.append(
                Limit(
                    lambda x, u, a=0.3 * a, b=b, c=level: ca.vertcat(
                        ca.dot(a, x) + ca.dot(b, u) - c, -ca.dot(a, x) - ca.dot(b, u) - c
                    ),
                    soft,
                )
            )
        elif way == 3:
            found.append(Limit(lambda x, u, i=i, c=level: x[i] ** 2 + 0.3 * u[0] ** 2 - c, soft))
        else:
            found.append(Limit(lambda x, i=i, c=level: ca.vertcat(x[i] - c, -x[i] - c), soft, terminal=True))
    return found


def _penalty(rng: np.random.Generator) -> Penalty | None:
    """None, l1, l2, or both."""
    weights = 10.0 ** rng.uniform(-1.0, 2.0, 2)
    return [None, None, None, Penalty(weights[0]), Penalty(0.0, weights[1]), Penalty(*weights)][int(rng.integers(6))]


def _in_units(limit: Limit, i: int, unit: Units) -> Constraint | StateBounds:
    size = float(unit.h[i])
    if limit.bounds is not None:  # of one state, whose unit they have
        low, high = (unit.x * bound for bound in limit.bounds)
        size = float(unit.x[np.flatnonzero(np.isfinite(limit.bounds[0]))[0]])
        return StateBounds(low, high, f"limit {i}", _priced(limit.soft, size, unit.cost))
    soft, h = _priced(limit.soft, size, unit.cost), limit.h
    if limit.terminal:
        return Constraint(lambda x, p: size * h(x / unit.x), f"limit {i}", soft, terminal=True)
    return Constraint(lambda x, u, p: size * h(x / unit.x, u / unit.u), f"limit {i}", soft)


def _priced(soft: Penalty | None, size: float, cost: float) -> Penalty | None:
    return None if soft is None else Penalty(soft.l1 * cost / size, soft.l2 * cost / size**2)
