"""The plant's own map behind an MPC whose state holds past inputs: what it is given, and where it comes to rest."""

from __future__ import annotations

import numpy as np
import scipy.optimize

from mpcoffline.core.types import Array
from mpcoffline.datasets.table.memory import plant_table, with_memory
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

_ROWS = 5_000


def state_rows(mpc: MPC, table: TransitionTable) -> TransitionTable:
    """A table of the MPC's states: past inputs beside the observations, where they are not there yet.

    Raises:
        InvalidDataError: If the data have other dimensions than the MPC, or hold no row whose past inputs are known.
    """
    return table if table.ny == mpc.nx and table.nu == mpc.nu else with_memory(table, mpc.layout)


def plant_rows(mpc: MPC, table: TransitionTable) -> TransitionTable:
    """What the plant's map is given, from a table of observations or one of the MPC's states.

    Past inputs are known exactly: what is identified, what has noise and what is smoothed is this.

    Raises:
        InvalidDataError: As :func:`state_rows`.
    """
    return plant_table(state_rows(mpc, table), mpc.layout)


def settled(mpc: MPC, table: TransitionTable) -> Array:
    """Where the MPC's state is at rest at its reference, ``(nx,)``; the reference (zero without one) for a plain state.

    Signals are at their mean, and what tracks one is there.

    For past inputs that is what holds the model at the reference, as well as the bounds allow::

        argmin_u |(f(x_ref, u) - x_ref) / scale|^2          scale: spread of the logged increments

    Args:
        mpc: The MPC.
        table: Transitions of its states, for scales and the input to begin with.
    """
    reference, n = np.zeros(mpc.layout.n_states) if mpc.reference is None else mpc.reference, mpc.layout.n_states
    if mpc.layout.is_plain:
        return reference
    rows, low, high = table.sample(_ROWS, 0).values(), *_bounds(mpc)
    if mpc.layout.signals:
        signals = rows.observations[:, n : mpc.ny].mean(axis=0)
        means = {s.name: signals[i - n] for s, i in zip(mpc.layout.signals, mpc.layout.present, strict=True)}
        tracks = getattr(mpc.stage_cost, "tracks", {})
        followed = [means[tracks[i]] if i in tracks else 0.0 for i in range(n)]
        reference = np.concatenate([reference + followed, signals])
        if not mpc.layout.n_memory:
            return reference
    spread = (rows.next_observations - rows.observations)[:, :n].std(axis=0)
    scale, size = (np.where(v > 0.0, v, 1.0) for v in (spread, rows.actions.std(axis=0)))

    def drift(u: Array) -> Array:
        z = mpc.state(reference, mpc.layout.filled(u))
        return np.asarray(np.nan_to_num((mpc.model(z, u) - z)[:n] / scale))

    usual = np.clip(rows.actions.mean(axis=0), low, high)
    found = scipy.optimize.least_squares(drift, usual, bounds=(low, high), x_scale=size)
    return mpc.state(reference, mpc.layout.filled(found.x))


def _bounds(mpc: MPC) -> tuple[Array, Array]:
    return np.asarray(mpc.action_low), np.asarray(mpc.action_high)
