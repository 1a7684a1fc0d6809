"""May I trust this fit? Everything that the log can say about a learned MPC, and a verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.checks import check_integers, check_known
from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.memory import with_memory
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Identification, fit_residual, identify, with_residual
from mpcoffline.estimation.plant import settled
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.learning import ValueFunction
from mpcoffline.mpc import MPC
from mpcoffline.mpc.seen import sees_memory
from mpcoffline.simulation.closed_loop import Simulation, initial_rows, signals_along, simulate
from mpcoffline.simulation.ensemble import Ensemble
from mpcoffline.simulation.logged_cost import LoggedCost
from mpcoffline.simulation.trials import Trials

from .figure import Traces
from .measures import (
    bound_names,
    fit_errors,
    goal_check,
    lag_check,
    one_step_error,
    outside_support,
    predicted_states,
    returns_of,
    value_check,
)
from .notes import Fit, notes_on
from .report import PredictionCheck, Report
from .stability import TheoremCheck, closed_loop_eigenvalues, leaves_reference, value_growth, weight_checks
from .verdict import decide
from .withholding import DEFAULT_RULES, RULES

if TYPE_CHECKING:
    from minari import MinariDataset

_STARTS = 20
_FEW_STARTS = 3
_SLOW = 10.0  # times as fast as ipopt, below which simulating all starts takes minutes


def diagnose(
    learner: OfflineMPCLearner,
    dataset: MinariDataset | TransitionTable | str,
    *,
    n_starts: int | None = None,
    n_steps: int = 100,
    seed: int = 0,
    rules: Sequence[str] = DEFAULT_RULES,
) -> Report:
    """Diagnoses a fit from the log alone.

    Both controllers, MPC_1 and the learned one, are simulated on an ensemble of models identified from the log (see
    :class:`~mpcoffline.simulation.ensemble.Ensemble`), from initial states of the log, with a stage cost learned from
    the logged costs (:class:`~mpcoffline.simulation.logged_cost.LoggedCost`). That decides the verdict
    (``mpcoffline.diagnostics.verdict``); all else is reported beside it.

    Example:
        >>> report = mpcoffline.diagnose(learner, "mpcoffline/pendulum/ddpg-v0")
        >>> print(report)
        >>> report.figure("diagnosis.pdf")

    Args:
        learner: A fitted learner.
        dataset: What it was fitted on, or another log of the same plant.
        n_starts: Episodes simulated on each model; 20 by default, 3 where a controller needs a slow solver (ipopt,
            with constraints), which takes minutes even so.
        n_steps: Their length.
        seed: Seeds the ensemble and the choice of starts.
        rules: Names of the rules that may withhold a recommendation, of ``mpcoffline.diagnostics.withholding.RULES``.

    Returns:
        The report.

    Raises:
        MPCOfflineError: If the learner was not fitted.
        UnknownIdError: For a rule that there is none of.
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    check_integers(1, n_steps=n_steps, **({} if n_starts is None else {"n_starts": n_starts}))
    for name in rules:
        check_known("rule", name, RULES)
    nominal, learned = learner.nominal_mpc, learner.mpc
    if learner.value_function is None:
        raise MPCOfflineError("learner", expected="a fitted learner", actual="no fit yet", hint="Call fit(dataset).")
    policies = MPCPolicy(nominal), MPCPolicy(learned)
    if nominal.layout.delay != learned.layout.delay:  # of the dead time that the learner has found
        nominal = nominal.with_delay(learned.layout.delay)
    table = with_memory(TransitionTable.of(dataset), learned.layout)
    found = identify(nominal, table, seed=seed)
    clean, identified = found.table, nominal.replace(model=found.model)
    if learner.result is not None and learner.result.residual_share is not None:
        found, identified = _completed(found, identified, seed)
    ensemble = Ensemble(identified, clean, found, seed=seed)
    seen = None if sees_memory(learned.layout, learned.stage_cost) else learned.ny
    cost = LoggedCost(clean, seed, seen, mpc=nominal, logged=table)
    slow = min(policy.solver.relative_speed for policy in policies) < _SLOW
    rows = initial_rows(clean, n_starts or (_FEW_STARTS if slow else _STARTS), seed)
    starts, signals = clean.take(rows).values().observations, signals_along(clean, rows, n_steps, learned.layout)
    first, second = (simulate(policy, ensemble, cost, clean, starts, n_steps, signals) for policy in policies)
    lag = lag_check(identified, clean)
    failed = (policies[0].solver_stats.failed_share, policies[1].solver_stats.failed_share)
    trials = _trials(first, second, ensemble, cost, table, rows, n_steps)
    judgement = decide(
        trials,
        "learned",
        lag=lag,
        noise=found.noise,
        n_rows=len(table),
        cost_r2=cost.r2,
        failed=failed[1],
        rules=tuple(rules),
    )
    reference = None if getattr(learned.stage_cost, "tracks", None) else learned.reference  # a signal is no fixed one
    report = Report(
        judgement=judgement,
        trials=trials,
        notes=(),
        cost_r2=cost.r2,
        value=value_check(learner.value_function, clean, learned.discount),
        fit=fit_errors(nominal, learned, learner.value_function, clean, learner.result),
        prediction=_prediction(nominal, identified, learned, found),
        theorem=_theorem(learned, policies[1], learner.value_function, clean, second),
        weights=weight_checks(nominal, learned, clean),
        at_bounds=bound_names(learned, nominal, clean),
        outside_support=outside_support(clean, predicted_states(learned, clean)),
        lag=lag,
        noise=found.noise,
        goal=goal_check(nominal, clean),
        failed_solves=failed,
        findings=learner.findings,
        n_rows=len(table),
        n_episodes=table.n_episodes,
        traces=Traces(
            first.states[..., : learned.layout.n_states],
            second.states[..., : learned.layout.n_states],
            np.stack(returns_of(learner.value_function, clean, learned.discount)),
            reference,
        ),
    )
    cost_kept = learner.result is not None and learner.result.cost is not None and learner.result.cost.constant
    fit = Fit(learner.method.options.get("init") == "identified", learner.learn == "cost+model", not cost_kept)
    return report.with_notes(notes_on(report, fit))


def _trials(
    first: Simulation,
    second: Simulation,
    ensemble: Ensemble,
    cost: LoggedCost,
    table: TransitionTable,
    rows: NDArray[np.intp],
    n_steps: int,
) -> Trials:
    """Both simulations side by side."""
    costs = np.stack([first.cost, second.cost]) + n_steps * cost.low
    return Trials(
        names=("MPC_1", "learned"),
        models=("identified", *(f"variation {k}" for k in range(1, len(ensemble)))),
        votes=np.ones(len(ensemble), dtype=bool),
        cost=costs,
        second=costs,
        lost=np.stack([first.lost, second.lost]),
        rows=rows,
        returns=_logged_costs(table, rows, n_steps),
        judged=np.ones(len(rows), dtype=bool),
        n_steps=n_steps,
    )


def _logged_costs(table: TransitionTable, rows: NDArray[np.intp], n_steps: int) -> Array:
    """What the log cost from these rows over so many steps, ``(starts,)``; NaN where an episode ends before."""
    ends = table.episode_ids
    found = np.full(len(rows), np.nan)
    for i, row in enumerate(rows):
        if row + n_steps <= len(table) and ends[row] == ends[row + n_steps - 1]:
            found[i] = table.take(slice(int(row), int(row) + n_steps)).costs.astype(np.float64).sum()
    return found


def _completed(found: Identification, identified: MPC, seed: int) -> tuple[Identification, MPC]:
    """The identified model with a learned residual, as in the fit: without, all models here would lack the same."""
    residual = fit_residual(identified, found.table, seed)
    if not residual.taken:
        return found, identified
    mpc = with_residual(identified, residual)
    errors = np.full_like(found.errors_after, residual.one_step[1])
    return replace(found, model=mpc.model, errors_after=errors), mpc


def _prediction(nominal: MPC, identified: MPC, learned: MPC, found: Identification) -> PredictionCheck:
    before, best, after = (one_step_error(mpc, found.table) for mpc in (nominal, identified, learned))
    return PredictionCheck(before, best, after, found.undetermined)


def _theorem(
    learned: MPC,
    policy: MPCPolicy,
    value: ValueFunction,
    table: TransitionTable,
    simulation: Simulation,
) -> TheoremCheck:
    """The condition of Theorem 1, along rollouts on the identified model."""
    states = simulation.states.reshape(-1, learned.nx)
    found = TheoremCheck(
        value_growth(value, table, states, bool(simulation.lost[0].any())), outside_support(table, states), ()
    )
    if learned.reference is None:
        return found
    rest = settled(learned, table)
    moduli = closed_loop_eigenvalues(learned, policy.solver, table, rest)
    return replace(found, eigenvalues=moduli, leaves=moduli[:1] > (1.0,) and leaves_reference(policy, table, rest))
