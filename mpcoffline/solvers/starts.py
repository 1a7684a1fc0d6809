"""Starting points of cold solves: fixed input sequences that are rolled out, the cheapest of which are refined."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpcoffline.mpc import MPC

N_CANDIDATES = 64
SEGMENT = 5  # steps for which a random input sequence holds its value


def candidate_inputs(mpc: MPC, n: int = N_CANDIDATES) -> NDArray[np.float64]:
    """Input sequences ``(n, N, nu)``: zero, then piecewise-constant random ones within the bounds.

    They are the same at each call, so that equal problems get equal solutions.
    """
    rng = np.random.default_rng(0)
    low, high = (np.asarray(bound) for bound in (mpc.action_low, mpc.action_high))
    low, high = np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)
    segments = -(-mpc.horizon // SEGMENT)
    values = rng.uniform(low, high, size=(n, segments, mpc.nu))
    inputs = np.repeat(values, SEGMENT, axis=1)[:, : mpc.horizon].copy()
    inputs[0] = np.clip(0.0, low, high)
    return inputs
