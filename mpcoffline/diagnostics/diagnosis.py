"""May I trust this fit? Everything that the log can say about a learned MPC, and a verdict."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.memory import with_memory
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Identification, fit_residual, with_residual
from mpcoffline.estimation.plant import settled
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.learning import ValueFunction
from mpcoffline.learning.known_cost import as_logged, identify_as_logged
from mpcoffline.mpc import MPC
from mpcoffline.mpc.seen import sees_memory
from mpcoffline.simulation.closed_loop import Simulation, initial_rows, signals_along, simulate
from mpcoffline.simulation.ensemble import Ensemble
from mpcoffline.simulation.logged_cost import LoggedCost

from .figure import Traces
from .measures import (
    bound_names,
    fit_errors,
    goal_share,
    lag_check,
    one_step_error,
    outside_support,
    predicted_states,
    returns_of,
    value_check,
)
from .report import PredictionCheck, Report
from .stability import TheoremCheck, closed_loop_eigenvalues, value_growth, weight_checks
from .verdict import Comparison, decide

if TYPE_CHECKING:
    from minari import MinariDataset

_STARTS = 20
_FEW_STARTS = 3
_SLOW = 10.0  # times as fast as ipopt, below which simulating all starts takes minutes
_SCARCE_GOAL = 1e-3
_BLIND_VALUE = 0.3
_WORSE_MODEL = 2.0


def diagnose(
    learner: OfflineMPCLearner,
    dataset: MinariDataset | TransitionTable | str,
    *,
    n_starts: int | None = None,
    n_steps: int = 100,
    seed: int = 0,
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

    Returns:
        The report.

    Raises:
        MPCOfflineError: If the learner was not fitted.
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    check_integers(1, n_steps=n_steps, **({} if n_starts is None else {"n_starts": n_starts}))
    nominal, learned = learner.nominal_mpc, learner.mpc
    if learner.value_function is None:
        raise MPCOfflineError("learner", expected="a fitted learner", actual="no fit yet", hint="Call fit(dataset).")
    policies = MPCPolicy(nominal), MPCPolicy(learned)
    if nominal.layout.delay != learned.layout.delay:  # of the dead time that the learner has found
        nominal = nominal.with_delay(learned.layout.delay)
    table = with_memory(TransitionTable.of(dataset), learned.layout)
    known = None if learner.result is None else learner.result.cost
    found, clean = identify_as_logged(nominal, table, as_logged(learned, table, known), seed=seed)
    identified = nominal.replace(model=found.model)
    if learner.result is not None and learner.result.residual_share is not None:
        found, identified = _completed(found, identified, seed)
    ensemble = Ensemble(identified, found.table, found, seed=seed)
    seen = None if sees_memory(learned.layout, learned.stage_cost) else learned.ny
    cost = LoggedCost(clean, seed, seen, mpc=nominal, logged=table)
    slow = min(policy.solver.relative_speed for policy in policies) < _SLOW
    rows = initial_rows(clean, n_starts or (_FEW_STARTS if slow else _STARTS), seed)
    starts, signals = clean.take(rows).values().observations, signals_along(clean, rows, n_steps, learned.layout)
    first, second = (simulate(policy, ensemble, cost, clean, starts, n_steps, signals) for policy in policies)
    comparison = Comparison.of(first, second, cost.r2)
    lag = lag_check(identified, clean)
    verdict, reasons = decide(comparison, lag, found.noise, len(table))
    reference = None if getattr(learned.stage_cost, "tracks", None) else learned.reference  # a signal is no fixed one
    report = Report(
        verdict=verdict,
        reasons=reasons,
        notes=(),
        comparison=comparison,
        value=value_check(learner.value_function, clean, learned.discount),
        fit=fit_errors(nominal, learned, learner.value_function, clean, learner.result),
        prediction=_prediction(nominal, identified, learned, found),
        theorem=_theorem(learned, policies[1], learner.value_function, clean, second, reference),
        weights=weight_checks(nominal, learned),
        at_bounds=bound_names(learned, nominal, clean),
        outside_support=outside_support(clean, predicted_states(learned, clean)),
        lag=lag,
        noise=found.noise,
        goal_share=None if reference is None else goal_share(clean, reference),
        failed_solves=(policies[0].solver_stats.failed_share, policies[1].solver_stats.failed_share),
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
    return report.with_notes(_notes(report, smoothed=learner.method.options.get("init") == "identified"))


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
    reference: Array | None,
) -> TheoremCheck:
    """The condition of Theorem 1, along rollouts on the identified model."""
    states = simulation.states.reshape(-1, learned.nx)
    return TheoremCheck(
        value_growth(value, table, states, bool(simulation.lost[0].any())),
        outside_support(table, states),
        () if reference is None else closed_loop_eigenvalues(learned, policy.solver, table, settled(learned, table)),
    )


def _notes(report: Report, *, smoothed: bool) -> tuple[str, ...]:
    """What explains the verdict or may spoil the next fit, with what to do; ``smoothed``: the fit did so, too."""
    notes = []
    if report.goal_share is not None and report.goal_share < _SCARCE_GOAL:
        notes.append("The log never reaches the goal: V is a guess there. Record episodes that end at the reference.")
    if not report.noise.negligible:
        advice = "as in the fit" if smoothed else "fit with init='identified', which does the same"
        notes.append(f"Measurement noise of {report.noise.level:.1%}: states were smoothed here; {advice}.")
    if report.value.n and report.value.correlation < _BLIND_VALUE:
        notes.append("V hardly follows the measured returns: learn it longer, or by another method.")
    if report.prediction.learned > _WORSE_MODEL * report.prediction.identified + 0.01:
        advice = "a larger prediction_weight keeps it closer" if smoothed else "init='identified' is the safer start"
        notes.append(
            f"The learned model misses {report.prediction.learned:.1%} of an increment, the identified one"
            f" {report.prediction.identified:.1%}: Theorem 1 allows that, but {advice}."
        )
    if report.prediction.undetermined:
        notes.append(
            f"The data do not determine {', nor '.join(report.prediction.undetermined)}: vary the"
            " inputs more; or, if they enter the model as ratios alone, fix one of them as a plain number."
        )
    if report.at_bounds:
        notes.append(f"On a bound: {', '.join(report.at_bounds)}. Widen it if the physics allow, or raise the prior.")
    if report.theorem.value_growth > 1.5:
        notes.append(
            "V grows along the model's rollouts beyond anything in the data: Theorem 1's condition is doubtful."
        )
    if report.theorem.eigenvalues and report.theorem.eigenvalues[0] > 1.0 + 1e-3:
        notes.append("The learned closed loop is unstable at the reference, on its own model: do not use it there.")
    for weight in report.weights:
        if weight.after[0] < 1e-6 * max(weight.after[-1], 1e-300) and weight.before[0] > 1e-6 * weight.before[-1]:
            notes.append(
                f"{weight.name} has lost a direction (smallest eigenvalue 0): raise the prior if that one matters."
            )
    return tuple(notes)
