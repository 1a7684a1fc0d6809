"""Plants whose MPCs are hard to solve: singular at rest, without curvature, kinked, with bounds that can't be kept."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpcoffline import MPC, Model, MPCPolicy, QuadraticCost, StateBounds
from mpcoffline.mpc import Block, ParameterSpace
from mpcoffline.mpc.component import Component

Array = NDArray[np.float64]


class Prices(Component):
    """A cost linear in states and inputs, and ``effort`` times the squares of the inputs."""

    def __init__(self, prices: list[float], effort: float = 0.0) -> None:
        self.space = ParameterSpace([Block.free("c", prices, "cost")])
        self.effort = effort

    def expression(self, x: ca.SX, u: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        """As a stage cost."""
        return ca.dot(p["c"], ca.vertcat(x, u)) + self.effort * ca.sumsqr(u)

    def terminal_expression(self, x: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        """As a terminal cost."""
        return ca.dot(p["c"][: x.numel()], x)


def reactor(effort: float = 0.0) -> MPC:
    """A bilinear reactor that is paid for its product: the best input is between its bounds for long."""

    def rates(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        return ca.vertcat(u[0] * (1 - x[0]) - 0.5 * x[0] * x[1], -u[0] * x[1] + 0.5 * x[0])

    stage, terminal = Prices([-1.0, 0.0, 0.2], effort), Prices([-1.0, 0.0, 0.0])
    return MPC(Model(rates, 2, 1, 0.2), stage, terminal, 25, 0.95, [0.0], [2.0])


def vehicle(drag: str = "norm") -> MPC:
    """Quadratic drag in the plane, |v| v: CasADi's derivative of it is 0/0 at rest."""

    def rates(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        v = x[2:4]
        speed = ca.norm_2(v) if drag == "norm" else ca.hypot(v[0], v[1])
        return ca.vertcat(v, u - 0.3 * speed * v)

    stage, terminal = QuadraticCost(np.eye(4), 0.1 * np.eye(2)), QuadraticCost(np.eye(4))
    return MPC(Model(rates, 4, 2, 0.1), stage, terminal, 15, 0.95, [-1.0] * 2, [1.0] * 2)


def limited(unit: float = 1.0) -> MPC:
    """A double integrator with a hard speed limit of .3, in any unit of position and speed."""

    def step(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        return ca.vertcat(x[0] + 0.1 * x[1] + 0.005 * unit * u[0], x[1] + 0.1 * unit * u[0])

    limit = StateBounds([-np.inf, -0.3 * unit], [np.inf, 0.3 * unit])
    weight = np.eye(2) / unit**2
    model, stage = Model(step, 2, 1, 0.1, discrete=True), QuadraticCost(weight, [[0.1]])
    return MPC(model, stage, QuadraticCost(weight), 20, 0.95, [-1.0], [1.0], constraints=[limit])


def kinked() -> MPC:
    """An oscillator learned by a small network of rectifiers, with kinks everywhere."""
    rng = np.random.default_rng(4)
    first, bias = 0.7 * rng.normal(size=(24, 3)), 0.3 * rng.normal(size=24)

    def rates(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        hidden = ca.fmax(first @ ca.vertcat(x, u) + bias, 0.0)
        bend = 0.1 * ca.sum1(hidden) - 0.1 * ca.sum1(ca.fmax(-(first @ ca.vertcat(x, u)), 0.0))
        return ca.vertcat(x[1], u[0] - x[0] - 0.3 * x[1] + 0.2 * bend)

    return MPC(
        Model(rates, 2, 1, 0.1), QuadraticCost(np.eye(2), [[0.1]]), QuadraticCost(np.eye(2)), 20, 0.95, [-1.0], [1.0]
    )


def closed_loop(policy: MPCPolicy, start: list[float], n_steps: int = 60) -> float:
    """Undiscounted cost on the policy's own model."""
    mpc, x, state, cost = policy.mpc, np.array(start), None, 0.0
    for _ in range(n_steps):
        u, state = policy.predict(x, state)
        cost += float(mpc.stage_function(x, u, mpc.theta))
        x = mpc.model(x, u.astype(np.float64))
    return cost


def always_applied(policy: MPCPolicy, start: list[float], n_steps: int = 60) -> float:
    """The same where ``solution.u0`` is applied, whatever the solver says of it."""
    mpc, x, plan, cost = policy.mpc, np.array(start), None, 0.0
    for _ in range(n_steps):
        solution = policy.solver.solve(x, warm_start=plan)
        plan = solution.plan.shifted()
        cost += float(mpc.stage_function(x, solution.u0, mpc.theta))
        x = mpc.model(x, solution.u0)
    return cost


def heater(kink: bool) -> MPC:
    """A heated body whose heater can't cool; ``kink`` writes that into the model, exactly on the input bound."""

    def rates(x: ca.SX, u: ca.SX, p: object) -> ca.SX:
        power = ca.fmax(u[0], 0.0) if kink else u[0]
        return ca.vertcat(2.0 * power - 0.4 * (x[0] - x[1]) - 0.2 * x[0], 0.3 * (x[0] - x[1]) - 0.05 * x[1] ** 2)

    stage = QuadraticCost(np.diag([0.1, 1.0]), [[0.01]], x_ref=[0.6, 0.5])
    terminal = QuadraticCost(np.diag([0.1, 5.0]), x_ref=[0.6, 0.5])
    return MPC(Model(rates, 2, 1, 0.2), stage, terminal, 25, 0.97, [0.0], [1.0])
