"""Cart-pole swing-up: move a cart so that the pole hinged on it swings up and stays there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .base import Array, ControlTask, Observation, float32_box, float64_box, rk4, wrap_angle
from .vector import ControlTaskVectorEnv

GRAVITY = 9.8
CART_MASS = 0.2
POLE_MASS = 0.2
HALF_LENGTH = 0.5
FRICTION = 0.5
MAX_FORCE = 2.0
MAX_POSITION = 1e3
MAX_CART_SPEED = 200.0
MAX_POLE_SPEED = 500.0
# Starts from which no input leaves the observation bounds, and from which RK4 at this sampling time is stable.
MAX_START = (100.0, 20.0, np.pi, 20.0)


class CartPoleSwingUpEnv(ControlTask):
    r"""Swing up the pole of a cart with viscous friction, and bring the cart back to the middle.

    ## Dynamics
    The cart-pole with half-length $l = 0.5$ m, $m_c = m_p = 0.2$ kg, friction $\mu = 0.5$ N s/m, $M = m_c + m_p$,
    $\varphi = 0$ upright:

    $\ddot\varphi = \dfrac{g\sin\varphi + \cos\varphi\,(\mu\dot x - u - m_p l\dot\varphi^2\sin\varphi)/M}
    {l\,(4/3 - m_p\cos^2\varphi/M)}$,
    $\quad\ddot x = \dfrac{u - \mu\dot x + m_p l(\dot\varphi^2\sin\varphi - \ddot\varphi\cos\varphi)}{M}$

    integrated with one Runge-Kutta (RK4) step of 0.05 s, the force held. The track has no end.

    ## Action space
    `Box(-2, 2, (1,), float32)`

    | Index | Action  | Min | Max | Unit |
    |-------|---------|-----|-----|------|
    | 0     | force u | -2  | 2   | N    |

    ## Observation space
    `Box([-1000, -200, -1, -1, -500], [1000, 200, 1, 1, 500], (5,), float32)`, wide enough for any reachable state.

    | Index | Observation | Unit  |
    |-------|-------------|-------|
    | 0     | x           | m     |
    | 1     | xd          | m/s   |
    | 2     | cos(phi)    |       |
    | 3     | sin(phi)    |       |
    | 4     | phid        | rad/s |

    The state $s = [x, \dot x, \varphi, \dot\varphi]$, $\varphi$ wrapped to $(-\pi, \pi]$, is in `info["state"]`.

    ## Reward
    $-L$ with $L = 2x^2 + \varphi^2 + 0.1\dot x^2 + 0.1\dot\varphi^2 + 0.1u^2$.

    ## Start, end, success
    `options={"start": "broad"}` (default): $x \sim U(-1, 1)$, $\dot x \sim U(-0.5, 0.5)$, $\varphi \sim U(-\pi, \pi)$,
    $\dot\varphi \sim U(-1, 1)$; `"hanging"`: $\varphi = \pi + U(-0.2, 0.2)$, the rest $U(-0.1, 0.1)$. Never terminates;
    truncated after 100 steps. Success: $|\varphi| < 0.3$. `options={"state": s}` takes $|x| \le 100$ m,
    $|\dot x| \le 20$ m/s, $|\dot\varphi| \le 20$ rad/s.

    ## References
    Sawant, Anand, Reinhardt, Gros, arXiv:2301.01667; Barto, Sutton, Anderson (1983) for the equations.

    ## Version history
    * v0: first release.
    """

    dt = 0.05
    starts = ("broad", "hanging")

    def __init__(self) -> None:
        self.action_space = float32_box([-MAX_FORCE], [MAX_FORCE])
        bounds = np.array([MAX_POSITION, MAX_CART_SPEED, 1.0, 1.0, MAX_POLE_SPEED])
        self.observation_space = float32_box(-bounds, bounds)
        self.state_space = float64_box(list(MAX_START))

    def derivative(self, state: Array, action: Array) -> Array:
        """The equations of motion: d[x, xd, phi, phid]/dt, ``(..., 4)``."""
        xd, phi, phid = state[..., 1], state[..., 2], state[..., 3]
        u, sin, cos = action[..., 0], np.sin(phi), np.cos(phi)
        mass, moment = CART_MASS + POLE_MASS, POLE_MASS * HALF_LENGTH
        drive = FRICTION * xd - u - moment * np.square(phid) * sin
        inertia = HALF_LENGTH * (4.0 / 3.0 - POLE_MASS * np.square(cos) / mass)
        phidd = (GRAVITY * sin + cos * drive / mass) / inertia
        xdd = (u - FRICTION * xd + moment * (np.square(phid) * sin - phidd * cos)) / mass
        return np.stack([xd, xdd, phid, phidd], axis=-1)

    def next_state(self, state: Array, action: Array) -> Array:
        """The plant: one RK4 step, then the angle wrapped."""
        reached = rk4(self.derivative, state, action, self.dt)
        reached[..., 2] = wrap_angle(reached[..., 2])
        return reached

    def cost(self, state: Array, action: Array) -> Array:
        """The stage cost 2 x^2 + phi^2 + 0.1 xd^2 + 0.1 phid^2 + 0.1 u^2."""
        x, xd, phi, phid = (state[..., i] for i in range(4))
        return np.asarray(
            2.0 * np.square(x)
            + np.square(phi)
            + 0.1 * np.square(xd)
            + 0.1 * np.square(phid)
            + 0.1 * np.square(action[..., 0])
        )

    def observe(self, state: Array) -> Observation:
        """The observation [x, xd, cos phi, sin phi, phid]."""
        x, xd, phi, phid = (state[..., i] for i in range(4))
        return np.stack([x, xd, np.cos(phi), np.sin(phi), phid], axis=-1).astype(np.float32)

    def is_success(self, state: Array) -> NDArray[np.bool_]:
        """Whether the pole is within 0.3 rad of upright."""
        return np.asarray(np.abs(state[..., 2]) < 0.3)

    def sample_state(self, start: str) -> Array:
        """Draws [x, xd, phi, phid]; see the class."""
        rng = self.np_random
        if start == "hanging":
            state = rng.uniform([-0.1, -0.1, np.pi - 0.2, -0.1], [0.1, 0.1, np.pi + 0.2, 0.1])
            state[2] = wrap_angle(state[2])
            return state
        return rng.uniform([-1.0, -0.5, -np.pi, -1.0], [1.0, 0.5, np.pi, 1.0])


class CartPoleSwingUpVectorEnv(ControlTaskVectorEnv):
    """Many copies of :class:`CartPoleSwingUpEnv` stepped as arrays; see :class:`ControlTaskVectorEnv`."""

    task_class = CartPoleSwingUpEnv
