"""A tuned controller: a folder, and what stands in it."""

from __future__ import annotations

import os
import shlex
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Self

from mpcoffline.control.loading import load_policy
from mpcoffline.control.output_feedback import OutputFeedbackPolicy
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.archive import file_errors
from mpcoffline.core.errors import FileFormatError
from mpcoffline.core.tables import Table
from mpcoffline.core.text import figure
from mpcoffline.datasets.table.files import load_table
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.mpc import MPC
from mpcoffline.simulation.choice import FIRST

from .folder import LEARNER, LOG, PAGE, POLICY, RUN, read_run
from .making import KEEP, RUNNING

_WIDTH = 79


@dataclass(frozen=True)
class Tuned:
    """What ``tune`` or ``retune`` has made.

    Attributes:
        folder: Where it is.
        document: What ``run.json`` says.
        again: Whether the folder held it already.
        former: Where what the folder held before is now; None where there was nothing, or it was not kept.
    """

    folder: Path
    document: Mapping[str, Any] = field(repr=False)
    again: bool = False
    former: Path | None = None

    @classmethod
    def load(cls, folder: str | PathLike[str]) -> Self:
        """What a folder holds.

        Raises:
            FileFormatError: If it is none of ``tune``, damaged, or of another version.
        """
        try:
            document = read_run(folder)
        except (FileNotFoundError, NotADirectoryError) as error:
            expected, hint = "a folder that tune has made", "`mpcoffline tune PLANT.py LOG` makes one."
            raise FileFormatError(str(folder), expected=expected, actual=f"no {RUN} in it", hint=hint) from error
        with file_errors(Path(folder) / RUN):
            _ = [str(each) for each in (*document["reasons"], document["verdict"], document["policy"])]
            _ = [document["costs"], document["episode_steps"], document["options"], document["rows"]]
        return cls(Path(folder), document)

    @property
    def verdict(self) -> str:
        """``"recommend"``, ``"try with care"`` or ``"keep MPC_1"``."""
        return str(self.document["verdict"])

    @property
    def policy(self) -> MPCPolicy:
        """What ``policy.zip`` holds: the proposal, or MPC_1 where the verdict is to keep that.

        Raises:
            FileFormatError: If it takes outputs, as :attr:`output_policy`, or is damaged.
        """
        return MPCPolicy.load(self.folder / POLICY)

    @property
    def output_policy(self) -> OutputFeedbackPolicy:
        """The same where the plant's outputs are measured in place of its states.

        Raises:
            FileFormatError: If it takes states, as :attr:`policy`, or is damaged.
        """
        return OutputFeedbackPolicy.load(self.folder / POLICY)

    @property
    def mpc(self) -> MPC:
        """The MPC in ``policy.zip``, whatever it sees.

        Raises:
            FileFormatError: If the file is damaged.
        """
        return load_policy(self.folder / POLICY).mpc

    @property
    def learner(self) -> OfflineMPCLearner:
        """The fitted learner."""
        return OfflineMPCLearner.load(self.folder / LEARNER)

    @property
    def table(self) -> TransitionTable:
        """The transitions that were learned from."""
        return load_table(self.folder / LOG)

    @property
    def policy_is(self) -> str:
        """What ``policy.zip`` is, in words."""
        if self.document["policy"] == RUNNING:
            return "the controller of the trial as it was: nothing better was learned"
        if self.document["policy"] != FIRST:
            return f"the proposal, {self.document['policy']!r}"
        of = "linear model of the log" if self.document.get("model") else "plant file"
        if self.document["proposal"] == FIRST:
            return f"MPC_1, the controller of the {of} as it is: nothing better was learned"
        return f"MPC_1, the controller of the {of} as it is; what was learned is in learner.zip, not recommended"

    @property
    def costs(self) -> Table:
        """Today, MPC_1 and the proposal."""
        ends = ("lowest", "expected", "highest")
        rows = [(name, *(_number(cost[end]) for end in ends)) for name, cost in self.document["costs"].items()]
        return Table(("", *ends), rows, f"Cost of an episode of {self.document['episode_steps']} steps:", "lr")

    @property
    def next_steps(self) -> tuple[str, ...]:
        """What to do now, commands included."""
        at = shlex.quote(str(self.folder))
        if self.verdict == KEEP and self.document.get("model"):
            return (
                "MPC_1 is new, too: it acts on a linear model of the log. Where it costs clearly less than today's"
                " controller, above, it is worth a trial under supervision, of which you keep the log:",
                f"  mpcoffline serve {at}/{POLICY} --device HOST:PORT --log trial.csv",
            )
        if self.verdict == KEEP:
            return (
                "Read the reasons: each says what would change it. A log that says more is worth most:"
                " `mpcoffline check` names the experiment.",
            )
        care = ", somebody at the switch from the first step on" if self.verdict == "try with care" else ""
        return (
            f"Read {at}/{PAGE}. Then a trial under supervision{care}, of which you keep the log:",
            f"  mpcoffline serve {at}/{POLICY} --device HOST:PORT --log trial.csv",
            "After it, see whether the plant did as predicted, and learn from that, too:",
            f"  mpcoffline retune {at} trial.csv",
        )

    def __str__(self) -> str:
        """Verdict, files and what to do next."""
        d, at = self.document, self.folder
        lines = [f"Verdict: {self.verdict}", *map(item, d["reasons"]), *self.costs.lines, "Files:"]
        code = f"{d['controller']}/" if d.get("controller") else None
        files = [(PAGE, "the report, for a browser"), (POLICY, self.policy_is), (LEARNER, "all that was learned")]
        files += [(code, f"{POLICY} as C99")] if code else []
        files += [(LOG, f"{d['rows']} transitions, for retune"), (RUN, "options, versions, hashes, expected costs")]
        width = max(len(name) for name, _ in files)
        lines += [f"  {at}{os.sep}{name.ljust(width)}  {text}" for name, text in files]
        if not code:
            lines.append(item(f"No C code: {d['why_no_controller']}"))
        if self.former is not None:
            lines.append(f"  {at}{os.sep}{f'{self.former.name}/'.ljust(width)}  what was here before")
        first, *rest = self.next_steps
        return "\n".join([*lines, textwrap.fill(f"Next: {first}", _WIDTH, break_on_hyphens=False), *rest])


def _number(value: Any) -> str:
    return "?" if value is None else figure(float(value), 4)


def item(text: str) -> str:
    """A list item, wrapped."""
    return textwrap.fill(text, _WIDTH, initial_indent="  - ", subsequent_indent="    ", break_on_hyphens=False)
