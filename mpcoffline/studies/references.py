"""The best costs that are known: optimisation of whole episodes with the true plant and cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import gymnasium as gym
import numpy as np

from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.envs import cartpole_swing_up as cartpole
from mpcoffline.envs import pendulum_swing_up as pendulum
from mpcoffline.envs.episode import EPISODE_STEPS
from mpcoffline.mpc import MPC, LiftedCost, Model, QuadraticCost
from mpcoffline.solvers import make_solver
from mpcoffline.solvers.interface import Plan


class _SwingUp(NamedTuple):
    """A swing-up in the state s: the equation of motion, the cost's weights, the entry that is an angle."""

    env_id: str
    ode: Callable[[ca.SX, ca.SX, Any], ca.SX]
    weights: tuple[float, ...]
    angle: int
    bound: float
    dt: float = pendulum.PendulumSwingUpEnv.dt  # of both


def _pendulum(s: ca.SX, u: ca.SX, p: Any) -> ca.SX:
    gravity = 1.5 * pendulum.GRAVITY / pendulum.LENGTH
    return ca.vertcat(s[1], gravity * ca.sin(s[0]) + 3.0 / (pendulum.MASS * pendulum.LENGTH**2) * u)


def _cartpole(s: ca.SX, u: ca.SX, p: Any) -> ca.SX:
    sin, cos = ca.sin(s[2]), ca.cos(s[2])
    mass = cartpole.CART_MASS + cartpole.POLE_MASS
    moment = cartpole.POLE_MASS * cartpole.HALF_LENGTH
    force = cartpole.FRICTION * s[1] - u - moment * s[3] ** 2 * sin
    inertia = cartpole.HALF_LENGTH * (4.0 / 3.0 - cartpole.POLE_MASS * cos**2 / mass)
    phidd = (cartpole.GRAVITY * sin + cos * force / mass) / inertia
    xdd = (u - cartpole.FRICTION * s[1] + moment * (s[3] ** 2 * sin - phidd * cos)) / mass
    return ca.vertcat(s[1], xdd, s[3], phidd)


_SWING_UPS = {
    "pendulum": _SwingUp("mpcoffline/PendulumSwingUp-v0", _pendulum, (1.0, 0.1), 0, pendulum.MAX_TORQUE),
    "cartpole": _SwingUp("mpcoffline/CartPoleSwingUp-v0", _cartpole, (2.0, 0.1, 1.0, 0.1), 2, cartpole.MAX_FORCE),
}
_ACTION_WEIGHT = 0.1


def best_known_costs(task: str, states: Array, guesses: Sequence[Array] = (), discount: float = 1.0) -> Array:
    """The smallest costs of whole episodes that are known: an upper bound of the optimum.

    Plans of 100 steps are optimised with the true equations of motion and the true stage cost, from scratch and from
    the actions of controllers. Everything is replayed in the environment, the guesses too, and the cheapest counts. At
    gamma near one most starting points end in poor local minima; the guesses are what matters there.

    Args:
        task: ``"pendulum"`` or ``"cartpole"``.
        states: Initial states s, ``(n, ns)``.
        guesses: Actions of controllers from these states, each ``(n, 100, 1)``.
        discount: gamma of the cost; 1 for J.

    Returns:
        Costs, ``(n,)``.

    Raises:
        InvalidArgumentError: For another task.
    """
    if not isinstance(task, str) or task not in _SWING_UPS:
        raise InvalidArgumentError("task", expected=f"one of {', '.join(_SWING_UPS)}", actual=repr(task))
    swing_up, states = _SWING_UPS[task], np.asarray(states, dtype=np.float64)
    solver = make_solver(_episode(swing_up, discount), "auto")
    plans = [solver.solve(states).u, *guesses]
    for actions in guesses:
        x = replay(swing_up.env_id, states, actions, discount).states
        x[..., swing_up.angle] = np.unwrap(x[..., swing_up.angle], axis=1)
        plans.append(solver.solve(states, warm_start=Plan(x, actions)).u)
    return np.asarray(np.min([replay(swing_up.env_id, states, u, discount).cost for u in plans], axis=0))


def _episode(swing_up: _SwingUp, discount: float) -> MPC:
    """A whole episode as one optimal control problem in s; the cost wraps the angle, as the environment's does."""
    n, angle = len(swing_up.weights), swing_up.angle

    def wrapped(s: ca.SX) -> ca.SX:
        phi = ca.atan2(ca.sin(s[angle]), ca.cos(s[angle]))
        return ca.vertcat(*(phi if i == angle else s[i] for i in range(n)))

    return MPC(
        model=Model(swing_up.ode, n, 1, swing_up.dt),
        stage_cost=LiftedCost(wrapped, np.zeros(n), np.diag(swing_up.weights), [[_ACTION_WEIGHT]]),
        terminal_cost=QuadraticCost(np.zeros((n, n))),
        horizon=EPISODE_STEPS,
        discount=discount,
        action_low=[-swing_up.bound],
        action_high=[swing_up.bound],
    )


class Replay(NamedTuple):
    """Open loops: states ``(n, T + 1, ns)`` and discounted costs ``(n,)``."""

    states: Array
    cost: Array


def replay(env_id: str, states: Array, actions: Array, discount: float = 1.0) -> Replay:
    """Applies action sequences ``(n, T, nu)`` from states ``(n, ns)`` in the environment."""
    env = gym.make_vec(env_id, num_envs=len(states), vectorization_mode="vector_entry_point")
    _, info = env.reset(options={"state": states})
    along, total = [info["state"]], np.zeros(len(states))
    for step in range(actions.shape[1]):
        _, _, _, _, info = env.step(actions[:, step].astype(np.float32))
        along.append(info["state"])
        total += discount**step * info["cost"]
    env.close()
    return Replay(np.stack(along, axis=1), total)
