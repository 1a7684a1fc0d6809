"""From a log to the place where controllers are tried: its models, its cost, its starts, signals and disturbances."""

from __future__ import annotations

import numpy as np

from mpcoffline.datasets.table.memory import with_memory
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Identification, smooth
from mpcoffline.mpc import MPC
from mpcoffline.mpc.seen import sees_memory

from .choice import STARTS
from .closed_loop import initial_rows
from .logged_cost import LoggedCost
from .models import LogModels
from .trials import Surroundings

_MOST_STEPS = 400
_ENOUGH = 16  # episodes, from which on all start where one of the log did


def surroundings_of(
    mpc: MPC,
    nominal: MPC,
    table: TransitionTable,
    found: Identification,
    *,
    n_starts: int = STARTS,
    n_steps: int | None = None,
    most_steps: int = _MOST_STEPS,
    most_models: int | None = None,
    seed: int = 0,
) -> Surroundings:
    """Builds all that controllers are tried in.

    Args:
        mpc: A learned MPC, for what its states are made of.
        nominal: MPC_1; its stage cost may be the logged one.
        table: The transitions as they were logged.
        found: What was identified.
        n_starts: Number of episodes on each model.
        n_steps: Their length; that of the longest logged one by default.
        most_steps: What that is at most.
        most_models: Take no more than the best of so many, beside the identified one.
        seed: Of models, starts and noise.

    Raises:
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    logged = with_memory(table, mpc.layout)
    identified = nominal.with_delay(mpc.layout.delay).replace(model=found.model)
    clean = logged
    if len(found.table) == len(logged):
        clean = found.table
    elif not found.noise.negligible:
        clean = smooth(identified, logged, found.theta, found.noise)
    models = LogModels.of(identified, clean, found, seed=seed).asked(most_models)
    seen = None if sees_memory(mpc.layout, mpc.stage_cost) else mpc.ny
    cost = LoggedCost(clean, seed, seen, mpc=nominal.with_delay(mpc.layout.delay), logged=logged)
    if _ENOUGH <= clean.n_episodes < n_starts:  # others than these begin nearer to where a controller rests
        n_starts = clean.n_episodes
    rows = initial_rows(clean, n_starts, seed)
    rows = np.random.default_rng([seed, 1]).permutation(rows)  # those that judge are like those that choose
    n_steps = n_steps or min(most_steps, int(table.episodes.lengths.max()))
    return Surroundings(models, cost, clean, rows, n_steps, mpc.layout, seed)
