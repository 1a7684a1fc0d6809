"""The optimum of the pendulum swing-up by dynamic programming on a grid: an oracle that shares nothing with the MPC.

(Q*), (V*) of arXiv:2301.01667 with the environment's own step and cost, V interpolated bilinearly between the nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from mpcoffline.envs import PendulumSwingUpEnv

Array = NDArray[np.float64]


class GridOptimum:
    """V* on a grid of phi (periodic) and phid, solved by (modified) policy iteration.

    Args:
        n_angles: Nodes in phi, from -pi (included) to pi (excluded).
        n_speeds: Odd number of nodes in phid, so that upright at rest is a node.
        n_actions: Torques that are compared, from bound to bound.
        max_speed: Edge of the grid in rad/s; successors beyond count as on the edge. The optimal swing-up stays below.
        discount: gamma.
    """

    def __init__(
        self,
        n_angles: int = 200,
        n_speeds: int = 201,
        n_actions: int = 41,
        max_speed: float = 8.0,
        discount: float = 0.9,
    ) -> None:
        self.env = PendulumSwingUpEnv()
        self.discount, self.max_speed = discount, max_speed
        self.shape = (n_angles, n_speeds)
        angles = -np.pi + 2 * np.pi / n_angles * np.arange(n_angles)
        speeds = np.linspace(-max_speed, max_speed, n_speeds)
        self.nodes = np.stack(np.meshgrid(angles, speeds, indexing="ij"), axis=-1).reshape(-1, 2)
        high = float(self.env.action_space.high[0])
        self.actions = np.linspace(-high, high, n_actions)
        self.values = self._policy_iteration()

    def _policy_iteration(self) -> Array:
        """Values of the nodes: after each improvement of the greedy policy, many cheap sweeps with it alone."""
        n = len(self.nodes)
        transitions, costs = [], []
        for action in self.actions:
            torque = np.full((n, 1), action)
            columns, weights = self._stencil(self.env.next_state(self.nodes, torque))
            rows = 4 * np.arange(n + 1)
            transitions.append(sparse.csr_matrix((weights.ravel(), columns.ravel(), rows), shape=(n, n)))
            costs.append(self.env.cost(self.nodes, torque))
        everything, cost, all_nodes = sparse.vstack(transitions).tocsr(), np.array(costs), np.arange(n)
        values = np.zeros(n)
        for _ in range(200):
            backup = cost + self.discount * (everything @ values).reshape(cost.shape)
            greedy = backup.argmin(axis=0)
            change = np.abs(backup[greedy, all_nodes] - values).max()
            values = backup[greedy, all_nodes]
            if change < 1e-9:
                return values
            chosen, paid = everything[greedy * n + all_nodes], cost[greedy, all_nodes]
            for _ in range(60):
                values = paid + self.discount * (chosen @ values)
        raise RuntimeError("policy iteration did not converge")

    def _stencil(self, states: Array) -> tuple[NDArray[np.int64], Array]:
        """The four nodes around states ``(..., 2)`` and their bilinear weights, ``(..., 4)`` each."""
        n_angles, n_speeds = self.shape
        a = (states[..., 0] + np.pi) / (2 * np.pi) * n_angles
        b = (np.clip(states[..., 1], -self.max_speed, self.max_speed) / self.max_speed + 1) / 2 * (n_speeds - 1)
        i, j = np.floor(a).astype(np.int64), np.minimum(np.floor(b).astype(np.int64), n_speeds - 2)
        p, q = a - i, b - j
        corners = [(di, dj) for di in (0, 1) for dj in (0, 1)]
        nodes = np.stack([((i + di) % n_angles) * n_speeds + j + dj for di, dj in corners], axis=-1)
        weights = np.stack([(p if di else 1 - p) * (q if dj else 1 - q) for di, dj in corners], axis=-1)
        return nodes, weights

    def value(self, states: Array) -> Array:
        """V* at states [phi, phid] ``(..., 2)``."""
        nodes, weights = self._stencil(states)
        return np.asarray((self.values[nodes] * weights).sum(axis=-1))

    def q_values(self, states: Array, actions: Array) -> Array:
        """Q* of every action ``(K,)`` at every state ``(B, 2)``: ``(B, K)``."""
        shape = (len(states), len(actions))
        s = np.broadcast_to(states[:, None], (*shape, 2))
        torque = np.broadcast_to(actions[:, None], (*shape, 1))
        return self.env.cost(s, torque) + self.discount * self.value(self.env.next_state(s, torque))

    def policy(self, states: Array) -> Array:
        """The greedy torque ``(B, 1)``, refined between the grid's torques by a parabola through the best three."""
        q = self.q_values(states, self.actions)
        k = np.clip(q.argmin(axis=1), 1, len(self.actions) - 2)
        rows = np.arange(len(states))
        left, middle, right = q[rows, k - 1], q[rows, k], q[rows, k + 1]
        curvature = left - 2 * middle + right
        shift = np.where(curvature > 1e-12, 0.5 * (left - right) / np.maximum(curvature, 1e-12), np.sign(left - right))
        step = self.actions[1] - self.actions[0]
        return np.asarray(self.actions[k] + np.clip(shift, -1, 1) * step)[:, None]


class ClosedLoop(NamedTuple):
    """Per episode ``(B,)``: cost, discounted cost, success at the end; and the fastest |phid| met."""

    cost: Array
    discounted_cost: Array
    success: NDArray[np.bool_]
    top_speed: float


def simulate(optimum: GridOptimum, states: Array, n_steps: int = 100) -> ClosedLoop:
    """Episodes of the greedy policy from states ``(B, 2)``, stepped together."""
    env = optimum.env
    cost, discounted, top_speed = np.zeros(len(states)), np.zeros(len(states)), 0.0
    for k in range(n_steps):
        torque = optimum.policy(states)
        stage = env.cost(states, torque)
        cost += stage
        discounted += optimum.discount**k * stage
        states = env.next_state(states, torque)
        top_speed = max(top_speed, float(np.abs(states[:, 1]).max()))
    return ClosedLoop(cost, discounted, env.is_success(states), top_speed)


def start_states(seeds: range, start: str) -> Array:
    """The initial states of the environment for these reset seeds ``(B, 2)``."""
    env = PendulumSwingUpEnv()
    return np.array([env.reset(seed=seed, options={"start": start})[1]["state"] for seed in seeds])
