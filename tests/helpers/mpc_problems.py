"""Random MPCs, and what their solutions must satisfy, computed in numpy with the CasADi functions of the MPC."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from task_ids import CARTPOLE, LINEAR, PENDULUM

from mpcoffline.envs import PLANTS
from mpcoffline.mpc import MPC, Model, QuadraticCost
from mpcoffline.solvers import Solution

Array = NDArray[np.float64]


def random_states(env_id: str, n: int, seed: int = 0, speed: float = 3.0) -> Array:
    """States of a task, ``(n, nx)``."""
    rng = np.random.default_rng(seed)
    if env_id == LINEAR:
        return rng.uniform(-1, 1, size=(n, 4))
    if env_id not in (PENDULUM, CARTPOLE):
        plant = next(plant for plant in PLANTS.values() if plant.id == env_id)
        draw = next(iter(plant.starts.values()))
        return np.array([plant.lift(draw(rng), np.cos, np.sin) for _ in range(n)])
    angle, rate = rng.uniform(-np.pi, np.pi, n), rng.uniform(-speed, speed, n)
    y = np.stack([np.cos(angle), np.sin(angle), rate], axis=1)
    return y if env_id == PENDULUM else np.hstack([rng.uniform(-1, 1, size=(n, 2)), y])


def random_theta(mpc: MPC, seed: int, spread: float = 0.3) -> Array:
    """Theta within its bounds: model parameters off by factors, full random weights."""
    rng = np.random.default_rng(seed)
    theta = mpc.theta
    for block in mpc.space:
        part = mpc.space.slices[block.name]
        if block.kind == "psd":
            size = 0.5 * float(np.sqrt(np.trace(block.value) / len(block.value)))
            theta[part] += size * rng.normal(size=block.size)
        elif block.group == "model":
            matrix = block.size > 1  # of the linear task: unstable, but not beyond what the inputs can hold
            factors = 1.0 + rng.normal(size=block.size) * 0.01 if matrix else np.exp(spread * rng.uniform(-1, 1))
            theta[part] *= factors
            theta[part] += 0.02 * rng.normal(size=block.size) if matrix else 0.0
        else:
            theta[part] += 0.1 * rng.normal(size=block.size)
    return np.clip(theta, mpc.space.low, mpc.space.high)


def random_linear(seed: int, nx: int = 4, nu: int = 3, **changes: Any) -> MPC:
    """A random linear system, stable or not, with quadratic costs and tight input bounds."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(nx, nx))
    A *= rng.uniform(0.6, 1.15) / np.abs(np.linalg.eigvals(A)).max()
    factor, input_factor = rng.normal(size=(nx, nx)), rng.normal(size=(nu, nu))
    bound = rng.uniform(0.1, 1.0, nu)
    arguments: dict[str, Any] = {
        "model": Model(
            lambda x, u, p: p["A"] @ x + p["B"] @ u,
            nx,
            nu,
            0.1,
            {"A": A, "B": rng.normal(size=(nx, nu))},
            discrete=True,
        ),
        "stage_cost": QuadraticCost(factor @ factor.T, 0.1 * input_factor @ input_factor.T),
        "terminal_cost": QuadraticCost(np.eye(nx)),
        "horizon": 12,
        "discount": 0.95,
        "action_low": -bound,
        "action_high": bound * rng.uniform(0.5, 2.0, nu),
    }
    return MPC(**(arguments | changes))


def simulated(mpc: MPC, x: ArrayLike, inputs: Array, theta: Array | None = None) -> tuple[Array, Array]:
    """States ``(B, N + 1, nx)`` and costs ``(B,)`` of input sequences ``(B, N, nu)`` from states ``(B, nx)``."""
    p = mpc.theta if theta is None else theta
    state = np.asarray(x, dtype=np.float64).T
    path, cost, weight = [state.T], np.zeros(len(inputs)), 1.0
    for k in range(mpc.horizon):
        u = inputs[:, k].T
        cost += weight * mpc.stage_function(state, u, p).full().ravel()
        state = mpc.dynamics_function(state, u, p).full()
        path.append(state.T)
        weight *= mpc.discount
    return np.stack(path, axis=1), cost + weight * mpc.terminal_function(state, p).full().ravel()


def residual_and_cost(mpc: MPC, solution: Solution, theta: Array | None = None) -> tuple[Array, Array]:
    """How far each step is from the model's, relative to its states, and the cost along the trajectory, ``(B,)`` each.

    Step by step, as far-out states can be chaotic: re-simulated as a whole they differ by rounding alone.
    """
    with np.errstate(all="ignore"):  # of rows that are no solutions
        return _residual_and_cost(mpc, solution, mpc.theta if theta is None else theta)


def _residual_and_cost(mpc: MPC, solution: Solution, p: Array) -> tuple[Array, Array]:
    error, cost = np.zeros(len(solution.x)), np.zeros(len(solution.x))
    for k in range(mpc.horizon):
        x, u = solution.x[:, k], solution.u[:, k].T
        off = np.abs(mpc.dynamics_function(x.T, u, p).full().T - solution.x[:, k + 1]).max(axis=1)
        error = np.maximum(error, off / (1.0 + np.abs(x).max(axis=1) + np.abs(solution.x[:, k + 1]).max(axis=1)))
        cost += mpc.discount**k * mpc.stage_function(x.T, u, p).full().ravel()
    return error, cost + mpc.discount**mpc.horizon * mpc.terminal_function(solution.x[:, -1].T, p).full().ravel()


def projected_gradient(mpc: MPC, solution: Solution, theta: Array | None = None) -> Array:
    """Largest component of the projected gradient of J by the inputs, |u - clip(u - dJ/du)|, ``(B,)``.

    By the adjoint recursion lambda = gamma f_x' lambda+ + L_x.
    """
    p = mpc.theta if theta is None else theta
    x, u, slope = ca.SX.sym("x", mpc.nx), ca.SX.sym("u", mpc.nu), ca.SX.sym("slope", mpc.nx)
    t = ca.SX.sym("theta", mpc.space.size)
    action_value = mpc.stage_function(x, u, t) + mpc.discount * ca.dot(slope, mpc.dynamics_function(x, u, t))
    back = ca.Function("back", [x, u, slope, t], [ca.gradient(action_value, x), ca.gradient(action_value, u)])
    end = ca.Function("end", [x, t], [ca.gradient(mpc.terminal_function(x, t), x)])
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    adjoint = end(solution.x[:, -1].T, p).full()
    largest = np.zeros(len(solution.x))
    for k in reversed(range(mpc.horizon)):
        inputs = solution.u[:, k]
        adjoint_next, gradient = (v.full() for v in back(solution.x[:, k].T, inputs.T, adjoint, p))
        adjoint = adjoint_next
        g = np.abs(inputs - np.clip(inputs - gradient.T, low, high))  # as far as the bounds let it
        largest = np.maximum(largest, mpc.discount**k * np.abs(g).max(axis=1))
    return largest
