"""As many substeps as the plans of candidates ask for: an optimiser finds where a coarse step promises what is not."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation.plant import state_rows
from mpcoffline.learning import Known
from mpcoffline.mpc import MPC
from mpcoffline.mpc.integrators import Scheme
from mpcoffline.mpc.model import Model
from mpcoffline.mpc.substeps import Flow, choice_on
from mpcoffline.simulation.quick import are_slow, quick_policy
from mpcoffline.solvers.ddp import Ahead

logger = logging.getLogger(__name__)

_FIRST, _ANY = 64, 64  # rows of the log that are planned from: where episodes began, and anywhere
_FINEST = 16  # substeps
_WHOLE = ""  # the whole fit, among names of others


def fine_enough(
    known: Known,
    between: Mapping[str, MPC],
    table: TransitionTable,
    ready: Callable[[MPC], MPC] = lambda mpc: mpc,
) -> tuple[Known, dict[str, MPC]]:
    """What is known at the end of a fit, and candidates, with as many substeps as their own plans ask for.

    ``integrator="auto"`` takes the substeps that the log asks for. Plans go elsewhere: where one Runge-Kutta step is
    wrong in the planner's favour (a reactor ignites, and is cold again a step later), an optimiser finds that. So
    candidates plan from states of the log; and where twice as many substeps lead elsewhere than a plan says, by more
    than may be on a log, all take more, and plan again. This is the refinement of meshes that direct methods know
    (Betts, Practical Methods for Optimal Control, chapter 4), with one mesh for all.

    Args:
        known: What is known.
        between: Candidates beside the whole fit.
        table: The transitions as they were logged.
        ready: What becomes of each before it plans.

    Returns:
        Both; as they are where nothing asks for more, the user has said how the model is integrated, or solvers are
        slow.
    """
    if known.found is None:
        return known, dict(between)
    rows, mpcs = state_rows(known.mpc, table), {**between, _WHOLE: known.mpc}
    states, scale = _states(rows, known.seed), known.found.scale
    while True:
        free = [ready(mpc) for mpc in mpcs.values() if _is_free(mpc.model) and mpc.nx == states.shape[1]]
        now = max((_substeps(mpc.model) for mpc in free), default=_FINEST)
        if now >= _FINEST or are_slow(policies := _policies(free)):
            break
        needed = min(_FINEST, max(_asked(policy, states, scale) for policy in policies))
        if needed <= now:
            break
        logger.info("Plans ask for %d substeps of the model, where %d were enough for the log.", needed, now)
        mpcs = {name: mpc.replace(model=_finer(mpc.model, needed)) for name, mpc in mpcs.items()}
        found = replace(known.found, model=_finer(known.found.model, needed))
        known = replace(known, found=found, mpc=mpcs[_WHOLE])
    return known, {name: mpc for name, mpc in mpcs.items() if name != _WHOLE}


def _states(rows: TransitionTable, seed: int) -> Array:
    """Some states of a log, ``(n, nx)``: where episodes began, and any."""
    rng, firsts = np.random.default_rng(seed), rows.episodes.firsts
    some = [rng.permutation(firsts)[:_FIRST], rng.permutation(len(rows))[:_ANY]]
    return np.asarray(rows.take(np.unique(np.concatenate(some))).values().observations, dtype=np.float64)


def _policies(mpcs: list[MPC]) -> list[MPCPolicy]:
    """Their policies, whose solvers are compiled side by side."""
    with Ahead() as ahead:
        ahead.start(mpcs)
        return [quick_policy(mpc) for mpc in mpcs]


@np.errstate(over="ignore", invalid="ignore")  # where a plan goes far out, more substeps may lead nowhere
def _asked(policy: MPCPolicy, states: Array, scale: Array) -> int:
    """The substeps that the plans from some states ask for, in increments of the log ``(n_states,)``."""
    mpc, model, now = policy.mpc, policy.mpc.model, _substeps(policy.mpc.model)
    if model.ode is None:
        return now
    plans = policy.solver.solve(states)
    x, u = (each.reshape(-1, each.shape[-1]) for each in mpc.layout.split(plans.x[:, :-1], plans.u))
    flow = Flow(model.ode, model.dt, model.space.theta)
    reached = flow(x, u, flow.most)
    known = np.isfinite(np.hstack([x, u, reached])).all(axis=1)
    return choice_on(flow, x[known], u[known], reached[known], now, scale).substeps if known.any() else now


def _is_free(model: Model) -> bool:
    """Whether the user left open how an ODE is integrated, and no exact way is known."""
    return model.integrator == "auto" and model.ode is not None and getattr(model.scheme, "kind", "exact") != "exact"


def _substeps(model: Model) -> int:
    return 1 if model.scheme is None else model.scheme.substeps


def _finer(model: Model, substeps: int) -> Model:
    """The model with no fewer substeps."""
    return model.with_scheme(Scheme("rk4", max(substeps, _substeps(model)))) if _is_free(model) else model
