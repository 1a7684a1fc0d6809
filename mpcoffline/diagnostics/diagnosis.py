"""May I trust this fit? Everything that the log can say about a learned MPC, and a verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.checks import check_integers
from mpcoffline.core.errors import MPCOfflineError
from mpcoffline.core.threads import one_blas_thread
from mpcoffline.datasets.table.memory import with_memory
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.estimation import Identification, OutputIdentification
from mpcoffline.estimation.plant import settled
from mpcoffline.learner.candidates import FULL, whole_fit
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.learning import ValueFunction
from mpcoffline.learning.known_cost import as_logged, identify_as_logged
from mpcoffline.mpc import MPC
from mpcoffline.simulation.behaviour import Agreement, Behaviour, agreement
from mpcoffline.simulation.choice import FIRST
from mpcoffline.simulation.episodes import Controller, Episodes
from mpcoffline.simulation.quick import are_slow, quick_policy
from mpcoffline.simulation.surroundings import surroundings_of
from mpcoffline.simulation.trials import Surroundings, Trials

from .background import (
    Background,
    column_lines,
    episode_line,
    made_by,
    names_of,
    parameter_lines,
)
from .differences import TODAY, Difference
from .figure import Traces
from .limits import limit_checks, with_limits
from .loops import SHOWN_OF, chosen_loops
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
from .report import PredictionCheck, Report, Trust
from .stability import TheoremCheck, closed_loop_eigenvalues, leaves_reference, value_growth, weight_checks
from .travel import travels
from .verdict import decide

if TYPE_CHECKING:
    from minari import MinariDataset

_FRESH = 1_000  # added to the seed: other models and starts than those of the choice


@one_blas_thread()
def diagnose(
    learner: OfflineMPCLearner,
    dataset: MinariDataset | TransitionTable | OutputIdentification | str,
    *,
    n_starts: int | None = None,
    n_steps: int | None = None,
    seed: int = 0,
    today: int | None = None,
) -> Report:
    """Diagnoses a fit from the log alone.

    MPC_1, the controller that the learner hands out and a clone of the one that made the log act on models of the log
    (:class:`~mpcoffline.simulation.models.LogModels`), from the same starts of the log, under what disturbed it then,
    with the user's own stage cost or one learned from the logged costs
    (:class:`~mpcoffline.simulation.logged_cost.LoggedCost`); models and starts are others than those of the choice in
    ``fit``. That decides the verdict (``mpcoffline.diagnostics.verdict``); all else is reported beside it.

    Example:
        >>> report = mpcoffline.diagnose(learner, "mpcoffline/pendulum/ddpg-v0")
        >>> print(report)
        >>> report.figure("diagnosis.pdf")

    Args:
        learner: A fitted learner.
        dataset: What it was fitted on, or another log of the same plant. Where the policy sees outputs, what was found
            in them, or a table with states.
        n_starts: Episodes simulated on each model; by default as in the choice, 64 or fewer.
        n_steps: Their length; by default that of the logged ones.
        seed: Seeds models, starts and noise.
        today: How many episodes, the first ones, were made by the controller that runs today; all by default. Others,
            as of a trial, tell what the plant does, not what runs today.

    Returns:
        The report.

    Raises:
        MPCOfflineError: If the learner was not fitted.
        InvalidDataError: If the data have other dimensions than the MPC.
    """
    counts = {"n_starts": n_starts, "n_steps": n_steps}
    counts |= {"today": today}
    check_integers(1, **{name: count for name, count in counts.items() if count is not None})
    nominal, learned = learner.nominal_mpc, learner.mpc
    if learner.value_function is None:
        raise MPCOfflineError("learner", expected="a fitted learner", actual="no fit yet", hint="Call fit(dataset).")
    chosen = FULL if learner.candidates is None else learner.candidates.chosen
    policies = {FIRST: quick_policy(nominal), chosen: quick_policy(learned)}
    delay = whole_fit(
        learner
    ).layout.delay  # which the learner has found; what it hands out may know of none, or another
    original, nominal = nominal, nominal.with_delay(delay)
    learned = learned if learned.layout.delay == delay else learned.with_delay(delay)
    if isinstance(dataset, OutputIdentification):
        dataset = dataset.table
    logged = TransitionTable.of(dataset)
    table = with_memory(logged, learned.layout)
    known = None if learner.result is None else learner.result.cost
    # From all rows, also those far out that a fit leaves aside: controllers go there, too.
    found, clean = identify_as_logged(nominal, table, as_logged(learned, table, known), seed=seed, start=learner.start)
    identified = nominal.replace(model=found.model)
    around = surroundings_of(
        learned,
        original,
        logged,
        found,
        are_slow=lambda: are_slow(policies.values()),
        n_starts=n_starts,
        n_steps=n_steps,
        seed=seed + _FRESH,
        sensors=learner.sensors,
    )
    acting_on = {name: around.seeing(policy) for name, policy in policies.items()}
    logs = around.logged
    own = _of_today(logs, today)
    clone = Behaviour.of(logs if own.all() else logs.take(np.flatnonzero(own)), learned.layout, seed)
    deviations = clone.deviations(logs, around.rows, around.n_steps)
    others = ~own[around.rows]  # of which nobody knows what today's controller would have done beside
    deviations[others], around.returns[others] = 0.0, np.nan
    trials, loops = _tried(chosen, lambda starts: {**acting_on, TODAY: clone.replaying(deviations[starts])}, around)
    first, second = loops[FIRST], loops[chosen]
    usual = np.flatnonzero(~others[: around.usual])
    rows, acting = around.rows[usual], clone.replaying(deviations[usual])
    paid, trust = logs if around.cost.limits is None else around.cost.limits.whole(logs), None
    if len(rows):
        agreed = agreement(around.models, around.cost, paid, acting, rows, around.n_steps, around.cost.ends.paid)
        trust = _trust(agreed, trials.votes)
    lag, cost = lag_check(identified, clean), around.cost
    plain, priced = (clean, clean) if cost.limits is None else (cost.limits.without(clean), cost.limits.whole(clean))
    tried = {name: loops[name] for name in policies}
    shown = chosen_loops(trials, chosen, tried, learned.layout, around, nominal)
    failed = policies[FIRST].solver_stats.failed_share, policies[chosen].solver_stats.failed_share
    choice = None if learner.candidates is None else learner.candidates.trials
    judgement = decide(trials, chosen, failed=failed[1], choice=choice)
    limits = limit_checks(nominal, table, first, second, learned) if nominal.constraints is not None else ()
    if chosen != FIRST:
        judgement = with_limits(judgement, limits)
    aimed = original.reference is not None  # a learned V has a middle of its own, which is nobody's goal
    reference = learned.reference if aimed and not getattr(learned.stage_cost, "tracks", None) else None
    report = Report(
        judgement=judgement,
        trials=trials,
        choice=choice,
        notes=(),
        cost_r2=cost.r2,
        value=value_check(learner.value_function, priced, learned.discount),
        fit=fit_errors(nominal, learned, learner.value_function, plain, learner.result),
        prediction=_prediction(nominal, identified, learned, found),
        theorem=_theorem(learned, policies[chosen], learner.value_function, clean, second, logged, aimed=aimed),
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
            np.stack(returns_of(learner.value_function, priced, learned.discount)),
            reference,
        ),
        trust=trust,
        limits=limits,
        travel=travels(nominal, logged, first, second),
        background=Background(
            names=names_of(dataset, learned),
            dt=learned.model.dt,
            loops=shown,
            parameters=parameter_lines(nominal, learned, found),
            columns=column_lines(logged, learned.layout),
            episodes=episode_line(logged),
            made_by=made_by(learner, logged, seed),
        ),
    )
    cost_kept = learner.result is not None and learner.result.cost is not None and learner.result.cost.constant
    fit = Fit(
        learner.method.options.get("init") == "identified",
        learner.learn != "cost",
        not cost_kept,
        chosen != FIRST,
    )
    return report.with_notes(notes_on(report, fit))


def _of_today(table: TransitionTable, today: int | None) -> NDArray[np.bool_]:
    """Which rows are of the first episodes, ``(n,)``; all where no number is given, or no row would be left."""
    ids = np.asarray(table.episode_ids)
    own = np.ones(len(ids), dtype=bool) if today is None else ids < today
    return own if own.any() else np.ones(len(ids), dtype=bool)


def _tried(
    proposal: str, controllers: Callable[[slice], Mapping[str, Controller]], around: Surroundings
) -> tuple[Trials, dict[str, Episodes]]:
    """Closed loops of some controllers from the same starts, of which none had a part in any choice.

    The spare starts are tried, too, where the others do not tell whether the proposal is cheaper than MPC_1, and so
    many may.

    Returns:
        The trials, and the closed loops from the usual starts.
    """
    usual, more = slice(0, around.usual), slice(around.usual, len(around.rows))
    acting = controllers(usual)
    trials = Trials.none(list(acting), around)
    loops = trials.fill(acting, around, usual, SHOWN_OF)
    possible = more.start < more.stop and proposal != FIRST and trials.votes.any()
    if possible and 1.0 < Difference.of(trials, proposal, FIRST).undecided <= more.stop / more.start:
        trials.fill(controllers(more), around, more)
    return trials.judged_from(0), loops


def _trust(found: Agreement, votes: NDArray[np.bool_]) -> Trust | None:
    """Medians over the models that have a vote."""
    if not votes.any():
        return None
    return Trust(*(float(np.median(each[votes])) for each in (found.deviations, found.scatters)))


def _prediction(nominal: MPC, identified: MPC, learned: MPC, found: Identification) -> PredictionCheck:
    before, best, after = (one_step_error(mpc, found.table) for mpc in (nominal, identified, learned))
    return PredictionCheck(before, best, after, found.undetermined)


def _theorem(
    learned: MPC,
    policy: MPCPolicy,
    value: ValueFunction,
    table: TransitionTable,
    simulation: Episodes,
    logged: TransitionTable,
    *,
    aimed: bool,
) -> TheoremCheck:
    """The condition of Theorem 1, along rollouts on the identified model; about a reference, where one was given."""
    states = simulation.states.reshape(-1, learned.nx)
    found = TheoremCheck(
        value_growth(value, table, states, bool(simulation.lost[0].any())), outside_support(table, states), ()
    )
    if not aimed:
        return found
    own = policy.mpc
    if own.layout.carried != learned.layout.carried:  # MPC_1 knows no past inputs, one of the user's perhaps others
        table = with_memory(logged, own.layout)
    rest = settled(own, table)
    moduli = closed_loop_eigenvalues(own, policy.solver, table, rest)
    return replace(found, eigenvalues=moduli, leaves=moduli[:1] > (1.0,) and leaves_reference(policy, table, rest))
