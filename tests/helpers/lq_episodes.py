"""Episodes of the small linear plant, as it is or with what a linear model does not know."""

from __future__ import annotations

import lq_plant
import numpy as np
from numpy.typing import NDArray

from mpcoffline.datasets import TransitionTable

Array = NDArray[np.float64]


def episodes(n: int = 20, steps: int = 30, lag: int = 0, friction: float = 0.0, seed: int = 0) -> TransitionTable:
    """The plant under its logging policy with exploration, from random states."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (n, 2))
    rows: list[tuple[Array, Array, Array]] = []
    late = np.zeros((n, 1))
    for _ in range(steps):
        u = x @ lq_plant.GAIN.T + rng.uniform(-2.0, 2.0, (n, 1))
        reached = x @ lq_plant.A.T + (late if lag else u) @ lq_plant.B.T - friction * np.tanh(5.0 * x)
        rows.append((x, u, reached))
        x, late = reached, u
    s, a, after = (np.stack(part, axis=1).reshape(n * steps, -1) for part in zip(*rows, strict=True))
    cost = lq_plant.quadratic(lq_plant.W, s) + lq_plant.quadratic(lq_plant.R, a)
    return TransitionTable.from_arrays(s, a, cost, after, np.zeros(n * steps), np.repeat(np.arange(n), steps))
