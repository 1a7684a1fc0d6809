"""The best costs that are known: optimisation of whole episodes with the true plant and cost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import gymnasium as gym
import numpy as np

from mpcoffline.core.checks import check_known
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.types import Array
from mpcoffline.envs import PLANTS, Plant
from mpcoffline.envs.episode import EPISODE_STEPS
from mpcoffline.mpc import MPC, LiftedCost, Model, QuadraticCost
from mpcoffline.solvers import Plan, make_solver


def best_known_costs(task: str, states: Array, guesses: Sequence[Array] = (), discount: float = 1.0) -> Array:
    """The smallest costs of whole episodes that are known: an upper bound of the optimum.

    Plans of 100 steps are optimised with the true equations of motion and the true stage cost, from scratch and from
    the actions of controllers. Everything is replayed in the environment, the guesses too, and the cheapest counts. At
    gamma near one most starting points end in poor local minima; the guesses are what matters there.

    Args:
        task: Name of a plant whose cost is a sum of squares of states and inputs.
        states: Initial states s, ``(n, ns)``.
        guesses: Actions of controllers from these states, each ``(n, 100, nu)``.
        discount: gamma of the cost; 1 for J.

    Returns:
        Costs, ``(n,)``.

    Raises:
        UnknownIdError: For a name of no plant.
        InvalidArgumentError: For a plant with another cost, or without an equation of motion.
    """
    check_known("task", task, PLANTS)
    plant, states = PLANTS[task], np.asarray(states, dtype=np.float64)
    solver = make_solver(_episode(plant, discount), "auto")
    plans = [solver.solve(states).u, *guesses]
    for actions in guesses:
        x = replay(plant.id, states, actions, discount).states
        if plant.angle is not None:
            x[..., plant.angle] = np.unwrap(x[..., plant.angle], axis=1)
        plans.append(solver.solve(states, warm_start=Plan(x, actions)).u)
    return np.asarray(np.min([replay(plant.id, states, u, discount).cost for u in plans], axis=0))


def _episode(plant: Plant, discount: float) -> MPC:
    """A whole episode as one optimal control problem in s; the cost wraps the angle, as the environment's does."""
    nx, nu, p = len(plant.states), len(plant.inputs), {q.name: q.value for q in plant.parameters}

    def ode(s: ca.SX, u: ca.SX, _: Any) -> ca.SX:
        y = plant.lift(ca.vertsplit(s), ca.cos, ca.sin)
        rates: Any = plant.dynamics(y, ca.vertsplit(u), p)
        return ca.SX(ca.vertcat(*rates))

    def wrapped(s: ca.SX) -> ca.SX:
        angles = (ca.atan2(ca.sin(value), ca.cos(value)) for value in ca.vertsplit(s))
        return ca.vertcat(*(a if c.angle else s[c.index] for c, a in zip(plant.states, angles, strict=True)))

    state_weights, input_weights, rest = _weights(plant)
    return MPC(
        model=Model(ode, nx, nu, plant.dt, integrator="rk4"),  # the plant's own step
        stage_cost=LiftedCost(wrapped, np.zeros(nx), state_weights, input_weights, u_ref=rest),
        terminal_cost=QuadraticCost(np.zeros((nx, nx))),
        horizon=EPISODE_STEPS,
        discount=discount,
        action_low=[c.low for c in plant.inputs],
        action_high=[c.high for c in plant.inputs],
    )


def _weights(plant: Plant) -> tuple[Array, Array, Array]:
    """W, R and the input at rest of a cost ``s'Ws + (u - rest)'R(u - rest)``, from its derivatives."""
    nx, nu = len(plant.states), len(plant.inputs)
    z = ca.SX.sym("z", nx + nu)
    entries = ca.vertsplit(z)
    hessian, gradient = ca.hessian(plant.cost(entries[:nx], entries[nx:]), z)
    if plant.discrete or ca.symvar(hessian):
        expected = "a plant with an equation of motion and a cost that is a sum of squares of states and inputs"
        raise InvalidArgumentError("task", expected=expected, actual=repr(plant.name))
    H = np.asarray(ca.Function("H", [], [hessian])()["o0"].full()) / 2.0
    slope = ca.Function("g", [z], [gradient])(np.zeros(nx + nu)).full().ravel() / 2.0
    return H[:nx, :nx], H[nx:, nx:], -np.linalg.solve(H[nx:, nx:], slope[nx:])


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
