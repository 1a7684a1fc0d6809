"""What withholds a recommendation whatever the mean costs say, and the starts from which a controller fails.

Rules for lag, noise, few rows, costs that states do not explain and rare failures were tried on plants whose truth is
known (``docs/results/zoo.md``): they would have withheld right recommendations and no wrong one, so they are not here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpcoffline.simulation.trials import Trials

from .differences import Difference, outvoted, starts_of

NO_MODEL_PREDICTS = (
    "No model of the log predicts it better than 'the state stays as it is': what a controller would cost cannot be"
    " simulated. Check sampling time, integrator and structure of the model; mpcoffline.check(mpc, log) looks for"
    " slips."
)


def runaway(trials: Trials, proposal: str) -> str | None:
    """Says that a controller is lost more often than MPC_1 on more models than may be outvoted; else None."""
    own, others = (_lost(trials, proposal, name).sum(axis=1) for name in (proposal, trials.names[0]))
    more = own > others
    if int(more.sum()) <= outvoted(len(more)):
        return None
    n, k = int(starts_of(trials, proposal).sum()), int(np.argmax(own))
    return (
        f"It is lost more often than {trials.names[0]} on {int(more.sum())} of {len(more)} models, from {int(own[k])}"
        f" of {n} starts on one of them: restrict the inputs, give limits, or record data where it goes."
    )


def gone_wrong(trials: Trials, proposal: str) -> tuple[str, ...]:
    """How many starts go wrong on the median model, in a sentence; empty where none does.

    One is lost where MPC_1 is not, or costs more than MPC_1 from there by more than the starts differ.
    """
    starts = starts_of(trials, proposal)
    k = Difference.of(trials, proposal, trials.names[0]).middle
    own, first = (trials.of(name)[trials.votes][k][starts] for name in (proposal, trials.names[0]))
    lost = (_lost(trials, proposal, proposal) & ~_lost(trials, proposal, trials.names[0]))[k]
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


def _lost(trials: Trials, proposal: str, name: str) -> NDArray[np.bool_]:
    """Which episodes of a controller were lost, of the starts that judge a proposal: ``(voting models, starts)``."""
    return np.asarray(trials.lost[trials.names.index(name)][trials.votes][:, starts_of(trials, proposal)])
