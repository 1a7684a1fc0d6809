"""Pendulum swing-up: a torque-limited pendulum that must gather momentum to stand upright."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .base import Array, ControlTask, Observation, float32_box, float64_box, rk4, wrap_angle
from .vector import ControlTaskVectorEnv

GRAVITY = 9.8
MASS = 1.0
LENGTH = 1.0
MAX_TORQUE = 2.0
MAX_SPEED = 200.0
MAX_START_SPEED = 90.0  # gravity and torque add at most 20.7 rad/s^2, 103.5 rad/s in the 5 s of an episode


class PendulumSwingUpEnv(ControlTask):
    r"""Swing a rod up with a torque too weak to lift it directly, and hold it upright.

    ## Dynamics
    $\ddot\varphi = \frac{3g}{2l}\sin\varphi + \frac{3}{m l^2}u$ with $\varphi = 0$ upright,
    $g = 9.8$ m/s², $m = 1$ kg, $l = 1$ m; integrated with one Runge-Kutta (RK4) step of 0.05 s, the torque held.

    ## Action space
    `Box(-2, 2, (1,), float32)`

    | Index | Action | Min | Max | Unit |
    |-------|--------|-----|-----|------|
    | 0     | torque u | -2 | 2 | N m |

    ## Observation space
    `Box([-1, -1, -200], [1, 1, 200], (3,), float32)`. The speed bound holds for any reachable state of an episode.

    | Index | Observation | Unit |
    |-------|-------------|------|
    | 0     | cos(phi)    |      |
    | 1     | sin(phi)    |      |
    | 2     | phid        | rad/s |

    The state $s = [\varphi, \dot\varphi]$, $\varphi$ wrapped to $(-\pi, \pi]$, is in `info["state"]`.

    ## Reward
    $-L$ with $L = \varphi^2 + 0.1\dot\varphi^2 + 0.1u^2$.

    ## Start, end, success
    `options={"start": "broad"}` (default): $\varphi \sim U(-\pi, \pi)$, $\dot\varphi \sim U(-1, 1)$; `"hanging"`:
    $\varphi = \pi + U(-0.2, 0.2)$, $\dot\varphi \sim U(-0.1, 0.1)$. Never terminates; truncated after 100 steps.
    Success: $|\varphi| < 0.3$. `options={"state": s}` takes $|\dot\varphi| \le 90$ rad/s.

    ## References
    Sawant, Anand, Reinhardt, Gros, arXiv:2301.01667; the plant is Gymnasium's `Pendulum` with other constants.

    ## Version history
    * v0: first release.
    """

    dt = 0.05
    starts = ("broad", "hanging")

    def __init__(self) -> None:
        self.action_space = float32_box([-MAX_TORQUE], [MAX_TORQUE])
        self.observation_space = float32_box([-1.0, -1.0, -MAX_SPEED], [1.0, 1.0, MAX_SPEED])
        self.state_space = float64_box([np.pi, MAX_START_SPEED])

    def derivative(self, state: Array, action: Array) -> Array:
        """The equation of motion: d[phi, phid]/dt, ``(..., 2)``."""
        acceleration = 1.5 * GRAVITY / LENGTH * np.sin(state[..., 0]) + 3.0 / (MASS * LENGTH**2) * action[..., 0]
        return np.stack([state[..., 1], acceleration], axis=-1)

    def next_state(self, state: Array, action: Array) -> Array:
        """The plant: one RK4 step, then the angle wrapped."""
        reached = rk4(self.derivative, state, action, self.dt)
        reached[..., 0] = wrap_angle(reached[..., 0])
        return reached

    def cost(self, state: Array, action: Array) -> Array:
        """The stage cost phi^2 + 0.1 phid^2 + 0.1 u^2."""
        return np.asarray(np.square(state[..., 0]) + 0.1 * np.square(state[..., 1]) + 0.1 * np.square(action[..., 0]))

    def observe(self, state: Array) -> Observation:
        """The observation [cos phi, sin phi, phid]."""
        phi, phid = state[..., 0], state[..., 1]
        return np.stack([np.cos(phi), np.sin(phi), phid], axis=-1).astype(np.float32)

    def is_success(self, state: Array) -> NDArray[np.bool_]:
        """Whether the rod is within 0.3 rad of upright."""
        return np.asarray(np.abs(state[..., 0]) < 0.3)

    def sample_state(self, start: str) -> Array:
        """Draws [phi, phid]; see the class."""
        if start == "hanging":
            angle = wrap_angle(np.pi + self.np_random.uniform(-0.2, 0.2, size=1))[0]
            return np.array([angle, self.np_random.uniform(-0.1, 0.1)])
        return self.np_random.uniform([-np.pi, -1.0], [np.pi, 1.0])


class PendulumSwingUpVectorEnv(ControlTaskVectorEnv):
    """Many copies of :class:`PendulumSwingUpEnv` stepped as arrays; see :class:`ControlTaskVectorEnv`."""

    task_class = PendulumSwingUpEnv
