"""Linear tracking: drive a point mass with an uncertain linear plant to the origin."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from .base import Array, ControlTask, Observation, float32_box, float64_box
from .vector import ControlTaskVectorEnv

A0 = np.array([[1.0, 0.0, 0.1, 0.0], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.9, 0.0], [0.0, 0.0, 0.0, 0.9]])
B0 = np.array([[0.0, 0.0], [0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
DELTA_A = 1e-2 * np.array(
    [
        [0.68, -1.15, -2.29, -2.42],
        [1.57, 2.06, 0.53, 1.15],
        [0.22, 2.17, 1.58, -2.49],
        [1.79, -2.33, 1.15, -1.62],
    ]
)
DELTA_B = 1e-2 * np.array([[1.82, 0.21], [-1.00, -0.39], [-2.36, -1.88], [0.85, 0.74]])

STATE_WEIGHT = np.diag([9.0, 9.0, 1.0, 1.0])
ACTION_WEIGHT = np.diag([0.1, 0.1])

MAX_FORCE = 10.0
# Twice what the plant can reach in 100 steps from a start in the box with any admissible input, at the largest alpha.
MAX_STATE = 1e4
MAX_ALPHA = 4.0


class LinearTrackingEnv(ControlTask):
    r"""Drive a point mass to the origin of the plane although its dynamics are not the nominal ones.

    ## Dynamics
    $s_+ = (A_0 + \alpha\,\Delta_A)\,s + (B_0 + \alpha\,\Delta_B)\,a$, sampled every 0.1 s. A controller that knows
    only $A_0, B_0$ meets a model error that grows with $\alpha$; from about $\alpha = 0.2$ the plant is unstable.

    ## Action space
    `Box(-10, 10, (2,), float32)`

    | Index | Action | Min | Max | Unit |
    |-------|--------|-----|-----|------|
    | 0     | Fx     | -10 | 10  | N    |
    | 1     | Fy     | -10 | 10  | N    |

    ## Observation space
    `Box(-1e4, 1e4, (4,), float32)`; the state $s$ (`info["state"]`) is the same in float64.

    | Index | Observation | Unit |
    |-------|-------------|------|
    | 0, 1  | x, y        | m    |
    | 2, 3  | xd, yd      | m/s  |

    ## Reward
    $-L$ with $L = 9(x^2 + y^2) + \dot x^2 + \dot y^2 + 0.1(F_x^2 + F_y^2)$.

    ## Start, end, success
    $s_0 \sim U[-1, 1]^4$. Never terminates; truncated after 100 steps. Success: $|(x, y)| < 0.05$.
    `options={"state": s}` takes any state from which no input leaves the observation bounds.

    ## Arguments
    `alpha` (default 1.0): size of the model error, from 0 to 4.

    ## References
    Sawant, Anand, Reinhardt, Gros, "Learning-based MPC from Big Data Using Reinforcement Learning",
    arXiv:2301.01667. The paper gives no action bounds and no distribution of $s_0$: the ones here are ours.

    ## Version history
    * v0: first release.
    """

    dt = 0.1

    def __init__(self, alpha: float = 1.0) -> None:
        if not 0.0 <= alpha <= MAX_ALPHA:
            raise ValueError(f"alpha: expected a number from 0 to {MAX_ALPHA}, got {alpha}.")
        self.alpha = float(alpha)
        self.A, self.B = plant_matrices(self.alpha)
        self.action_space = float32_box([-MAX_FORCE] * 2, [MAX_FORCE] * 2)
        self.observation_space = float32_box([-MAX_STATE] * 4, [MAX_STATE] * 4)
        self.state_space = float64_box([start_bound(self.A, self.B)] * 4)

    def next_state(self, state: Array, action: Array) -> Array:
        """The plant: A s + B a."""
        return _product(self.A, state) + _product(self.B, action)

    def cost(self, state: Array, action: Array) -> Array:
        """The stage cost s'Ws + a'Ra."""
        squares = np.concatenate(
            [np.square(state) * np.diag(STATE_WEIGHT), np.square(action) * np.diag(ACTION_WEIGHT)], axis=-1
        )
        return np.asarray(sum(squares[..., i] for i in range(squares.shape[-1])))

    def observe(self, state: Array) -> Observation:
        """The state itself."""
        return state.astype(np.float32)

    def is_success(self, state: Array) -> NDArray[np.bool_]:
        """Whether the mass is within 0.05 m of the origin."""
        return np.asarray(np.hypot(state[..., 0], state[..., 1]) < 0.05)

    def sample_state(self, start: str) -> Array:
        """Uniform in [-1, 1]^4."""
        return self.np_random.uniform(-1.0, 1.0, size=4)


def start_bound(A: Array, B: Array, n_steps: int = 100) -> float:
    """The largest b such that from every |s| <= b no admissible input leaves the observation bounds in an episode."""
    bound, power, forced = MAX_STATE, np.eye(len(A)), np.zeros(len(A))
    for _ in range(n_steps):
        forced += MAX_FORCE * np.abs(power @ B).sum(axis=1)
        power = power @ A
        bound = min(bound, float(((MAX_STATE - forced) / np.abs(power).sum(axis=1)).min()))
    return bound


class LinearTrackingVectorEnv(ControlTaskVectorEnv):
    """Many copies of :class:`LinearTrackingEnv` stepped as arrays; see :class:`ControlTaskVectorEnv`."""

    task_class = LinearTrackingEnv


def plant_matrices(alpha: float) -> tuple[Array, Array]:
    """The matrices A ``(4, 4)`` and B ``(4, 2)`` of the plant; ``alpha = 0`` is the nominal model."""
    return A0 + alpha * DELTA_A, B0 + alpha * DELTA_B


def _product(matrix: Array, vectors: Array) -> Array:
    """``matrix`` times each of ``vectors (..., n)``, summed column by column.

    BLAS sums in an order that depends on the machine and on the number of vectors; this does not, so that a recorded
    episode replays bit for bit, alone or among others.
    """
    columns = (vectors[..., j, None] * matrix[:, j] for j in range(matrix.shape[1]))
    return functools.reduce(np.add, columns)
