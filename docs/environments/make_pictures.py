"""Makes the pictures of the environments that stand beside this file.

.venv/bin/python docs/environments/make_pictures.py
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pygame

Controller = Callable[[np.ndarray], Any]


def swing_pendulum(s: np.ndarray) -> Any:
    """Feeds energy until the rod comes near upright, then holds it there."""
    phi, phid = s
    missing = 4.9 - (phid**2 / 6.0 + 4.9 * np.cos(phi))
    return -14.0 * phi - 3.0 * phid if abs(phi) < 0.6 else 3.0 * phid * missing


def swing_cartpole(s: np.ndarray) -> Any:
    """Pushes against the swing of the pole, and a little towards the middle."""
    x, xd, phi, phid = s
    return -2.0 * np.sign(phid * np.cos(phi)) - 0.8 * x - 0.4 * xd


def track(s: np.ndarray) -> Any:
    """Linear feedback."""
    return -9.0 * s[:2] - 4.0 * s[2:]


def fly(s: np.ndarray) -> Any:
    """Tilts towards the target, and lifts what is below it."""
    x, z, phi, xd, zd, phid = s
    tilt = np.clip(-0.5 * x - 0.6 * xd, -0.6, 0.6)
    return [4.9 - 3.0 * z - 2.0 * zd, 0.2 * (tilt - phi) - 0.05 * phid]


#: Environment: picture, start, controller, steps.
SCENES: dict[str, tuple[str, list[float], Controller, int]] = {
    "mpcoffline/PendulumSwingUp-v0": ("pendulum", [2.9, 0.0], swing_pendulum, 20),
    "mpcoffline/CartPoleSwingUp-v0": ("cartpole", [-0.5, 0.0, 3.0, 0.0], swing_cartpole, 41),
    "mpcoffline/LinearTracking-v0": ("linear", [-0.9, 0.2, -0.4, 1.8], track, 3),
    "mpcoffline/PlanarQuadrotor-v0": ("quadrotor", [-1.1, -0.7, 0.6, 0.3, 0.0, 0.0], fly, 11),
}


def main(folder: Path = Path(__file__).parent) -> None:
    """Writes one PNG an environment."""
    for env_id, (name, start, controller, steps) in SCENES.items():
        env = gym.make(f"mpcoffline:{env_id}", render_mode="rgb_array")
        space: Any = env.action_space
        _, info = env.reset(options={"state": start})
        for _ in range(steps):
            action = np.clip(np.atleast_1d(controller(info["state"])), space.low, space.high)
            _, _, _, _, info = env.step(action.astype(np.float32))
        frame: Any = env.render()
        pygame.image.save(pygame.surfarray.make_surface(frame.swapaxes(0, 1)), folder / f"{name}.png")
        env.close()


if __name__ == "__main__":
    main()
