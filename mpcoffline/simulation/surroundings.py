"""From a log to the place where controllers are tried: its models, its cost, its starts, signals and disturbances."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mpcoffline.datasets.table.memory import with_memory
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Identification, smooth
from mpcoffline.estimation.plant import state_rows
from mpcoffline.estimation.sensors import Sensors
from mpcoffline.mpc import MPC
from mpcoffline.mpc.seen import sees_memory

from .logged_cost import LoggedCost
from .models import LogModels
from .starts import costs_before, initial_rows
from .trials import Surroundings

STARTS = 64
_FEWEST = 24  # where each is dear
_LABOUR = (
    8e7  # multiplications of one iteration of all solves from all starts on a model; 64 starts of nearly all plants
)
_SPARE_CHOOSING, _SPARE = 40, 128  # beside 64
_MOST_STEPS = 400
_MOST_MODELS, _CHOOSING_MODELS = 7, 4
_FEW_STARTS, _FEW_STEPS, _FEW_MODELS = 4, 60, 3  # where it would take an hour else
_LEAST_STEPS = 20  # of an episode, or a horizon
_AS_MUCH = 2.0  # times what a model misses elsewhere
_NEXT_TO_NOTHING = 0.01  # spreads of the increments


def surroundings_of(
    mpc: MPC,
    nominal: MPC,
    table: TransitionTable,
    found: Identification,
    *,
    are_slow: Callable[[], bool] = lambda: False,
    choosing: bool = False,
    n_starts: int | None = None,
    n_steps: int | None = None,
    seed: int = 0,
    sensors: Sensors | None = None,
) -> Surroundings:
    """Builds all that controllers are tried in.

    Args:
        mpc: A learned MPC, for what its states are made of.
        nominal: MPC_1; its stage cost may be the logged one.
        table: The transitions as they were logged, or of the MPC's states.
        found: What was identified.
        are_slow: Says whether a controller's solver is slow (ipopt): then few starts, short episodes, and the best
            models only. It is asked when the models are there: solvers may be compiled meanwhile.
        choosing: Whether many controllers are tried: then on the four best models, whichever they are.
        n_starts: Number of episodes on each model; by default 64, of large problems fewer (24 at least), and others for
            where these decide nothing. They begin where those of the log did; where it has fewer, in like states, too.
        n_steps: Their length; by default that of the logged ones that no end cut short, 400 at most.
        seed: Of models, starts and noise.
        sensors: What MPCs see in place of states.

    Raises:
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    logged = state_rows(mpc, table)
    identified = nominal.with_delay(mpc.layout.delay).replace(model=found.model, applied_before=mpc.applied_before)
    clean = logged
    if len(found.table) == len(logged):
        clean = found.table
    elif not found.noise.negligible:
        clean = smooth(identified, logged, found.theta, found.noise)
    seen = None if sees_memory(mpc.layout, mpc.stage_cost) else mpc.ny
    cost = LoggedCost(clean, seed, seen, mpc=nominal.with_delay(mpc.layout.delay), logged=logged)
    models = LogModels.of(identified, clean, found, seed=seed, believed=cost.as_applied)
    slow = are_slow()
    most_models = _FEW_MODELS if slow else _CHOOSING_MODELS if choosing else _MOST_MODELS
    models = models.asked(most_models, identified=not choosing)
    if n_steps is None:
        most = _FEW_STEPS if slow else _MOST_STEPS
        n_steps = min(most, max(_usual_length(table), min(_LEAST_STEPS, mpc.horizon)))
    starts = _FEW_STARTS if slow else affordable_starts(mpc, n_steps)
    spare = 0 if n_starts or slow else (_SPARE_CHOOSING if choosing else _SPARE) * starts // STARTS
    fresh = False
    if len(clean) < len(table):
        whole = with_memory(table, mpc.layout, identified.usual_input)
        if _begins_as_usual(identified, whole):
            logged, clean, fresh = whole, whole, True
            if not found.noise.negligible:
                clean = smooth(identified, whole, found.theta, found.noise)
    rows = initial_rows(clean, n_starts or starts, seed, mpc.ny, spare)
    n_before = mpc.layout.steps if len(clean) < len(table) else 0
    before = costs_before(table, clean, rows, n_before)
    parts = models, cost, clean, rows, max(1, n_steps - n_before), mpc.layout, seed, spare
    return Surroundings(*parts, before, n_before, logged, fresh, sensors)


def affordable_starts(mpc: MPC, n_steps: int) -> int:
    """From how many starts an MPC is tried for episodes of some steps: 64, of large problems 24 at least.

    By the products of matrices in an iteration of its solver, ``horizon (nx + nu)^2 nx``, once a step: so the time that
    trials take stays bounded where states are many or horizons long.

    Args:
        mpc: The MPC; only its sizes matter.
        n_steps: Length of an episode, at least 1.
    """
    labour = n_steps * mpc.horizon * (mpc.nx + mpc.nu) ** 2 * mpc.nx
    return int(np.clip(_LABOUR / labour, _FEWEST, STARTS))


def _begins_as_usual(mpc: MPC, table: TransitionTable) -> bool:
    """Whether the first transitions of episodes look as if the usual input had been applied before, as the table says.

    That is: whether the model misses them by no more than twice what it misses others.
    """
    values, n = table.values(), mpc.layout.n_states
    missed = (values.next_observations - mpc.model(values.observations, values.actions))[:, :n]
    _, firsts, lengths = table.episodes
    order = np.argsort(firsts)
    first = np.arange(len(table)) - np.repeat(firsts[order], lengths[order]) < mpc.layout.steps
    if first.all():
        return False
    moved = (values.next_observations - values.observations)[:, :n].std(axis=0)
    size, others = (np.sqrt(np.mean(missed[rows] ** 2, axis=0)) for rows in (first, ~first))
    return bool((size <= np.maximum(_AS_MUCH * others, _NEXT_TO_NOTHING * moved)).all())


def _usual_length(table: TransitionTable) -> int:
    """Steps of an episode of the log that was not ended by the plant; of the longest where all were.

    That of the episode in which half of the rows are reached, so that fragments of a log do not count as much as what
    they were cut from.
    """
    _, firsts, lengths = table.episodes
    whole = np.sort(lengths[np.asarray(table.terminations)[firsts + lengths - 1] == 0.0])
    if not len(whole):
        return int(lengths.max())
    rows = np.cumsum(whole)
    return int(whole[np.searchsorted(rows, 0.5 * rows[-1])])
