"""From a log to the place where controllers are tried: its models, its cost, its starts, signals and disturbances."""

from __future__ import annotations

import numpy as np

from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Identification, smooth
from mpcoffline.estimation.plant import state_rows
from mpcoffline.mpc import MPC
from mpcoffline.mpc.seen import sees_memory

from .choice import STARTS
from .logged_cost import LoggedCost
from .models import LogModels
from .starts import initial_rows
from .trials import Surroundings

_MOST_STEPS = 400
_MOST_MODELS = 7
_FEW_STARTS, _FEW_STEPS, _FEW_MODELS = 4, 60, 3  # where it would take an hour else
_LEAST_STEPS = 20  # of an episode, or a horizon


def surroundings_of(
    mpc: MPC,
    nominal: MPC,
    table: TransitionTable,
    found: Identification,
    *,
    slow: bool = False,
    n_starts: int | None = None,
    n_steps: int | None = None,
    seed: int = 0,
) -> Surroundings:
    """Builds all that controllers are tried in.

    Args:
        mpc: A learned MPC, for what its states are made of.
        nominal: MPC_1; its stage cost may be the logged one.
        table: The transitions as they were logged, or of the MPC's states.
        found: What was identified.
        slow: Whether a controller's solver is slow (ipopt): then few starts, short episodes, and the best models only.
        n_starts: Number of episodes on each model; 64 by default, half of them where an episode of the log began, if
            it has as many.
        n_steps: Their length; by default that of the logged ones that no end cut short, 400 at most.
        seed: Of models, starts and noise.

    Raises:
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    logged = state_rows(mpc, table)
    identified = nominal.with_delay(mpc.layout.delay).replace(model=found.model)
    clean = logged
    if len(found.table) == len(logged):
        clean = found.table
    elif not found.noise.negligible:
        clean = smooth(identified, logged, found.theta, found.noise)
    models = LogModels.of(identified, clean, found, seed=seed).asked(_FEW_MODELS if slow else _MOST_MODELS)
    seen = None if sees_memory(mpc.layout, mpc.stage_cost) else mpc.ny
    cost = LoggedCost(clean, seed, seen, mpc=nominal.with_delay(mpc.layout.delay), logged=logged)
    most_starts, most_steps = (_FEW_STARTS, _FEW_STEPS) if slow else (STARTS, _MOST_STEPS)
    if n_starts is None:
        n_starts = min(most_starts, max(STARTS // 2, 2 * clean.n_episodes))
    rows = initial_rows(clean, n_starts, seed)
    if n_steps is None:
        n_steps = min(most_steps, max(_usual_length(table), min(_LEAST_STEPS, mpc.horizon)))
    return Surroundings(models, cost, clean, rows, n_steps, mpc.layout, seed)


def _usual_length(table: TransitionTable) -> int:
    """Steps of an episode of the log that was not ended by the plant; of the longest where all were."""
    _, firsts, lengths = table.episodes
    whole = lengths[np.asarray(table.terminations)[firsts + lengths - 1] == 0.0]
    return int(np.median(whole)) if len(whole) else int(lengths.max())
