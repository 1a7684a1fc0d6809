"""What a comparison of an MPC's description with a log finds, and the excerpt of the log that it looks at."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.registry import Registry
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.mpc import MPC

from .plant import state_rows

_ROWS, _BLOCK = 2_000, 100


@dataclass(frozen=True)
class Finding:
    """A contradiction between the description and the data.

    Attributes:
        name: What it is about, e.g. ``"observation 1"``.
        expected: What would fit together.
        actual: What was found, in numbers.
        hint: What to do.
        kind: ``"error"`` where it is certain, ``"warning"`` where it is likely.
        misread: Whether the data are something else than the model takes them for; what would be identified of them
            means nothing then.
    """

    name: str
    expected: str
    actual: str
    hint: str
    kind: Literal["error", "warning"] = "warning"
    misread: bool = False

    def __str__(self) -> str:
        return f"{self.name}: expected {self.expected}, got {self.actual}. {self.hint}".rstrip()

    @property
    def error(self) -> InvalidDataError:
        """The finding as an error."""
        return InvalidDataError(self.name, expected=self.expected, actual=self.actual, hint=self.hint)


@dataclass(frozen=True)
class CheckReport:
    """What :func:`mpcoffline.check` found; empty where description and data agree as far as the data tell.

    Attributes:
        findings: Errors first.
    """

    findings: tuple[Finding, ...] = ()

    @property
    def errors(self) -> tuple[Finding, ...]:
        """What is certain."""
        return tuple(each for each in self.findings if each.kind == "error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """What is likely."""
        return tuple(each for each in self.findings if each.kind == "warning")

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    def raise_for_errors(self) -> None:
        """Raises the first error.

        Raises:
            InvalidDataError: If there is one.
        """
        for finding in self.errors:
            raise finding.error

    def __str__(self) -> str:
        lines = [f"{each.kind}: {each}" for each in self.findings]
        return "\n".join(lines) or "Nothing contradicts the description of the MPC."


@dataclass(frozen=True)
class Excerpt:
    """Rows from all over a log, in pieces of consecutive ones, in float64.

    Attributes:
        table: The log.
        z: The MPC's states, ``(m, nx)``: s, and past inputs where the MPC holds some.
        a: Actions, ``(m, nu)``.
        x: The plant's states, s, ``(m, n)``.
        u: What acts on the plant: the actions, late by known dead times, ``(m, nu)``.
        cost: Costs, ``(m,)``.
        reached: Observations s+, ``(m, n)``.
        ended: Whether the episode terminated there, ``(m,)``.
        adjacent: Whether a row and the next of the excerpt are neighbours in the log, ``(m - 1,)``.
        together: Whether they are of the same episode, too, ``(m - 1,)``.
    """

    table: TransitionTable
    z: Array
    a: Array
    x: Array
    u: Array
    cost: Array
    reached: Array
    ended: NDArray[np.bool_]
    adjacent: NDArray[np.bool_]
    together: NDArray[np.bool_]

    @classmethod
    def of(cls, mpc: MPC, table: TransitionTable) -> Excerpt:
        """At most 2,000 rows.

        Raises:
            InvalidDataError: If the data have other dimensions than the MPC, or no episode outlasts its dead time.
        """
        rows = state_rows(mpc, table)
        n = len(rows)
        index = np.arange(n)
        if n > _ROWS:
            firsts = np.linspace(0, n - _BLOCK, _ROWS // _BLOCK).astype(np.intp)
            index = np.unique(firsts[:, None] + np.arange(_BLOCK))
        c, ids = rows.take(index).values(), np.asarray(rows.episode_ids[index])
        adjacent = np.diff(index) == 1
        together = adjacent & (ids[1:] == ids[:-1])
        x, u = mpc.layout.split(c.observations, c.actions)
        reached, ended = c.next_observations[:, : x.shape[1]], np.asarray(c.terminations) > 0.0
        return cls(table, c.observations, c.actions, x, u, c.costs, reached, ended, adjacent, together)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.x)


#: Called as ``check(mpc, excerpt)``: yields what it finds. Further ones are registered beside these.
Check = Callable[[MPC, Excerpt], Iterator[Finding]]
CHECKS: Registry[Check] = Registry("check")


def named(finding: Finding, mpc: MPC) -> Finding:
    """A finding that calls observations and actions by their names, where the MPC's model has some."""
    layout = mpc.layout
    known = {"observation": layout.y_labels, "action": layout.u_labels}
    if not (layout.labels.states or layout.labels.inputs):
        return finding

    def name(match: re.Match[str]) -> str:
        labels = known[match["kind"]]
        numbers = [int(number) for number in re.findall(r"\d+", match["numbers"])]
        if max(numbers) >= len(labels):
            return match[0]
        return " and ".join(labels[i].name for i in numbers)

    def called(text: str) -> str:
        return re.sub(r"\b(?P<kind>observation|action)s? (?P<numbers>\d+( and \d+)?)\b", name, text)

    return replace(
        finding,
        name=called(finding.name),
        expected=called(finding.expected),
        actual=called(finding.actual),
        hint=called(finding.hint),
    )


def predicted(mpc: MPC, x: Array, u: Array) -> Array:
    """The nominal model's f(x, u) of the plant's states, ``(m, n)``; not finite where the model is not."""
    with np.errstate(all="ignore"):
        return np.asarray(mpc.plant_function(x.T, u.T, mpc.theta).full().T)


def nominal_costs(mpc: MPC, z: Array, a: Array) -> Array:
    """The nominal stage cost of the MPC's states and inputs, ``(m,)``."""
    with np.errstate(all="ignore"):
        return mpc.stage_costs(z, a)
