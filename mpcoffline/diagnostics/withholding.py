"""Rules that may withhold a recommendation, whatever the simulations say: each by its name, to be switched off.

Which of them are on is decided by what they prevent on plants whose truth is known, not by what they might.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mpcoffline.estimation.smoothing import NoiseEstimate
from mpcoffline.simulation.trials import Trials

from .differences import Difference, outvoted, starts_of
from .measures import LagCheck

if TYPE_CHECKING:
    from .report import Report

_MUCH_NOISE = 0.12  # of the states' spread
_FEW_ROWS = 500
_LITTLE_NOISE = 0.02  # where rows are few
_COST_R2 = 0.9


@dataclass(frozen=True)
class Evidence:
    """What a rule may look at; None where it is not known.

    Attributes:
        trials: The simulations.
        proposal: The controller that is judged.
        lag: Whether inputs act late.
        noise: Measurement noise.
        n_rows: Transitions in the data.
        cost_r2: Share of the logged costs' variance that the simulated cost explains.
    """

    trials: Trials
    proposal: str
    lag: LagCheck | None = None
    noise: NoiseEstimate | None = None
    n_rows: int | None = None
    cost_r2: float = 1.0

    @classmethod
    def of(cls, report: Report) -> Evidence:
        """What a report rests on."""
        proposal = report.judgement.proposal
        return cls(report.trials, proposal, report.lag, report.noise, report.n_rows, report.cost_r2)


#: Says why nothing may be recommended and what to do, or None.
Rule = Callable[[Evidence], str | None]


def _no_model_predicts(e: Evidence) -> str | None:
    if e.trials.votes.any():
        return None
    return (
        "No model of the log predicts it better than 'the state stays as it is': what a controller would cost cannot be"
        " simulated. Check sampling time, integrator and structure of the model; mpcoffline.check(mpc, log) looks for"
        " slips."
    )


def _runaway(e: Evidence) -> str | None:
    if not e.trials.votes.any() or e.proposal == e.trials.names[0]:
        return None
    own, others = (_lost(e, name).sum(axis=1) for name in (e.proposal, e.trials.names[0]))
    more = own > others
    if int(more.sum()) <= outvoted(len(more)):
        return None
    n, k = int(starts_of(e.trials, e.proposal).sum()), int(np.argmax(own))
    return (
        f"It is lost more often than {e.trials.names[0]} on {int(more.sum())} of {len(more)} models, from {int(own[k])}"
        f" of {n} starts on one of them: restrict the inputs, give limits, or record data where it goes."
    )


def _lag(e: Evidence) -> str | None:
    if e.lag is None or not e.lag.found:
        return None
    return (
        f"Inputs act late (past ones move the state {100 * e.lag.share:.0f} % as much as present ones), which no model"
        " here knows: give the model their dead time (Model(..., delay=)), or the actuator's own state."
    )


def _noise(e: Evidence) -> str | None:
    if e.noise is None or e.noise.level <= _MUCH_NOISE:
        return None
    return (
        f"Measurement noise is {100 * e.noise.level:.0f} % of the states' spread; all models share its bias: filter the"
        " measurements before logging."
    )


def _few_rows(e: Evidence) -> str | None:
    if e.noise is None or e.n_rows is None or e.n_rows >= _FEW_ROWS or e.noise.level <= _LITTLE_NOISE:
        return None
    return f"Only {e.n_rows} rows, with {100 * e.noise.level:.0f} % measurement noise: record more."


def _cost(e: Evidence) -> str | None:
    if e.cost_r2 >= _COST_R2:
        return None
    return (
        f"The logged cost is hardly a function of state and input (R2 {e.cost_r2:.2f}): check that the state holds all"
        " that the cost depends on."
    )


def _rare_failures(e: Evidence) -> str | None:
    told = gone_wrong(e)
    return f"{told[0]} None may." if told else None


#: All rules by name.
RULES: dict[str, Rule] = {
    "no model predicts": _no_model_predicts,
    "runaway": _runaway,
    "lag": _lag,
    "noise": _noise,
    "few rows": _few_rows,
    "cost": _cost,
    "rare failures": _rare_failures,
}
DEFAULT_RULES = ("no model predicts", "runaway")


def gone_wrong(e: Evidence) -> tuple[str, ...]:
    """How many starts go wrong on the median model, in a sentence; empty where none does.

    One is lost where MPC_1 is not, or costs more than MPC_1 from there by more than the starts differ.
    """
    trials, starts = e.trials, starts_of(e.trials, e.proposal)
    if not trials.votes.any() or e.proposal == trials.names[0]:
        return ()
    k = Difference.of(trials, e.proposal, trials.names[0]).middle
    own, first = (trials.of(name)[trials.votes][k][starts] for name in (e.proposal, trials.names[0]))
    lost = (_lost(e, e.proposal) & ~_lost(e, trials.names[0]))[k]
    with np.errstate(invalid="ignore"):
        dear = (
            (own - first > np.nanstd(first)) & ~lost if np.isfinite(first).any() else np.zeros(len(first), dtype=bool)
        )
    parts = [f"{int(each.sum())} {word}" for each, word in ((lost, "end lost"), (dear, "cost far more")) if each.any()]
    if not parts:
        return ()
    count = int((lost | dear).sum())
    worst = trials.rows[starts][np.argmax(np.where(lost, np.inf, np.where(dear, own - first, -np.inf)))]
    return (
        f"From {count} of {len(own)} starts it does worse than {trials.names[0]} ({', '.join(parts)}), the worst is row"
        f" {int(worst)} of the log: look at these before a trial.",
    )


def _lost(e: Evidence, name: str) -> NDArray[np.bool_]:
    """Which of a controller's episodes were lost, ``(voting models, starts that judge)``."""
    trials = e.trials
    return np.asarray(trials.lost[trials.names.index(name)][trials.votes][:, starts_of(trials, e.proposal)])
