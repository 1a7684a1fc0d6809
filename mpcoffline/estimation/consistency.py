"""Whether the description of an MPC and a log can be of the same plant, before anything is learned."""

from __future__ import annotations

from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

from . import contradictions, hypotheses
from .findings import CHECKS, CheckReport, Excerpt, Finding

for _name, _check in (
    ("sizes", contradictions.sizes),
    ("alignment", contradictions.alignment),
    ("episodes", contradictions.episodes),
    ("costs", contradictions.costs),
    ("states", contradictions.states),
    ("rows", contradictions.rows),
    ("inputs", contradictions.inputs),
    ("model", hypotheses.model),
    ("gains", contradictions.gains),
    ("ranges", contradictions.ranges),
    ("rewards", contradictions.rewards),
):
    CHECKS.add(_name, _check)

# What has been found by the one would only be found again, in other words, by the other.
_COLUMNS = ("alignment", "states", "inputs")
_EXPLAINED_BY = {
    "model": _COLUMNS,
    "gains": (*_COLUMNS, "model"),
    "ranges": ("model",),
    "rewards": ("model", "gains", "ranges"),
}


def check(mpc: MPC, table: TransitionTable) -> CheckReport:
    """Compares an MPC with a log: sizes, bounds, units, signs, order of columns, sampling time, rows out of step.

    Everything is compared with the model's own predictions, on about 2,000 rows from all over the log, its parameters
    anywhere within their bounds: a model that is merely rough raises no finding. What is certain is an error, what is
    likely a warning with its evidence in numbers. ``OfflineMPCLearner.fit`` calls this first.

    Example:
        >>> report = mpcoffline.check(mpc, table)
        >>> print(report)

    Args:
        mpc: MPC_1.
        table: The log.

    Returns:
        The findings, errors first.
    """
    excerpt = Excerpt.of(table)
    found: dict[str, list[Finding]] = {}
    for name, look in CHECKS.items():
        if any(found.get(cause) for cause in _EXPLAINED_BY.get(name, ())):
            continue
        found[name] = list(look(mpc, excerpt))
        if name == "sizes" and any(each.name.endswith((": observations", ": actions")) for each in found[name]):
            break  # nothing else can be compared
    every = [each for name in found for each in found[name]]
    return CheckReport(tuple(sorted(every, key=lambda each: each.kind != "error")))
