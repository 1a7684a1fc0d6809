"""Whether the description of an MPC and a log can be of the same plant, before anything is learned."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

from . import contradictions, hypotheses
from .findings import CHECKS, CheckReport, Excerpt, Finding, named

if TYPE_CHECKING:
    from minari import MinariDataset

for _name, _check in (
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


def check(mpc: MPC, data: TransitionTable | MinariDataset | str) -> CheckReport:
    """Compares an MPC with a log: sizes, bounds, units, signs, order of columns, sampling time, rows out of step.

    Everything is compared with the model's own predictions, on about 2,000 rows from all over the log, its parameters
    anywhere within their bounds: a model that is merely rough raises no finding. What is certain is an error, what is
    likely a warning with its evidence in numbers. ``OfflineMPCLearner.fit`` calls this first.

    Example:
        >>> report = mpcoffline.check(mpc, table)
        >>> print(report)

    Args:
        mpc: MPC_1.
        data: The log: a table, a Minari data set or the id of one.

    Returns:
        The findings, errors first.

    Raises:
        UnknownIdError: For an unknown data set id.
    """
    table = TransitionTable.of(data)
    found: dict[str, list[Finding]] = {}
    try:
        excerpt = Excerpt.of(mpc, table)  # refuses other sizes, and episodes shorter than the dead time
        table.check_fits(mpc.ny, mpc.nu, mpc.action_low, mpc.action_high)
    except InvalidDataError as error:
        finding = Finding(error.name, error.expected, error.actual, error.hint, "error")
        return CheckReport((named(finding, mpc),))
    for name, look in CHECKS.items():
        if not any(found.get(cause) for cause in _EXPLAINED_BY.get(name, ())):
            found[name] = list(look(mpc, excerpt))
    every = [named(each, mpc) for name in found for each in found[name]]
    return CheckReport(tuple(sorted(every, key=lambda each: each.kind != "error")))
