"""What is known of an MPC's states and inputs before there are data: where it rests, and how far inputs may go."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.types import Array

if TYPE_CHECKING:
    from .problem import MPC


def at_rest(mpc: MPC) -> Array:
    """The MPC's state at its reference, zero without one, ``(nx,)``.

    Signals and past inputs are as usual (``Signal.usual``, ``MPC.usual_input``), and what tracks a signal is there.
    """
    n, usual = mpc.layout.n_states, {signal.name: signal.usual for signal in mpc.layout.signals}
    tracks = getattr(mpc.stage_cost, "tracks", None) or getattr(mpc.terminal_cost, "tracks", None) or {}
    reference = np.zeros(n) if mpc.reference is None else mpc.reference
    return mpc.state(reference + np.array([usual[tracks[i]] if i in tracks else 0.0 for i in range(n)]))


def extreme_inputs(mpc: MPC) -> Array:
    """The input at rest, and with one input after another on its bounds, ``(1 + 2 nu, nu)``.

    One without bounds is moved by its own size, by 1 where that is zero.
    """
    low, high = np.asarray(mpc.action_low), np.asarray(mpc.action_high)
    rest = mpc.values.get("stage_cost.u_ref", np.zeros(0))
    with np.errstate(invalid="ignore"):
        middle = np.nan_to_num((low + high) / 2.0, posinf=0.0, neginf=0.0)
    rest = np.clip(rest if rest.shape == (mpc.nu,) else middle, low, high)
    size = np.where(rest == 0.0, 1.0, np.abs(rest))
    ends = np.where(np.isfinite(low), low, rest - size), np.where(np.isfinite(high), high, rest + size)
    moved = [np.where(np.arange(mpc.nu) == i, end, rest) for end in ends for i in range(mpc.nu)]
    return np.stack([rest, *moved])
