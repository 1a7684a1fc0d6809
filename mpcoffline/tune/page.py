"""The page on a log and a description: remarks, tables, and whether tuning pays, in a sentence."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from mpcoffline.core.notebook import html_of
from mpcoffline.core.tables import Table
from mpcoffline.estimation import DelaySearch, Identification, Lag, OutputIdentification

from .experiment import Experiment

Kind = Literal["problem", "advice", "good"]


@dataclass(frozen=True)
class Remark:
    """A sentence on log or description.

    Attributes:
        kind: ``"problem"``: mend it first; ``"advice"``: better with it; ``"good"``.
        about: What it is about: a section of the page.
        text: The sentence.
        forbids: Whether nothing can be fitted before it is mended.
    """

    kind: Kind
    about: str
    text: str
    forbids: bool = False

    def __str__(self) -> str:
        return self.text


@dataclass
class LogCheck:
    """What a log and a description say of each other.

    Attributes:
        head: What was read.
        remarks: What was found, problems first.
        tables: Coverage, parameters and predictions.
        identification: The model of the log; None where none could be found, or outputs are measured.
        outputs: What was found in a log of outputs; None where states are measured.
        delays: What the log says of dead time.
        lags: Inputs and signals that act slowly where the equations say at once; nothing is looked for in outputs.
        experiments: What would determine the parameters that the log leaves open.
    """

    head: str = ""
    remarks: list[Remark] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    identification: Identification | None = None
    outputs: OutputIdentification | None = None
    delays: DelaySearch | None = None
    lags: list[Lag] = field(default_factory=list)
    experiments: dict[str, Experiment | None] = field(default_factory=dict)

    def add(self, kind: Kind, about: str, text: str, *, forbids: bool = False) -> None:
        """Enters a remark."""
        self.remarks.append(Remark(kind, about, text, forbids))

    def sort(self) -> None:
        """Puts problems first, then advice."""
        self.remarks.sort(key=lambda each: ("problem", "advice", "good").index(each.kind))

    @property
    def problems(self) -> list[Remark]:
        """What is to be mended first."""
        return [each for each in self.remarks if each.kind == "problem"]

    @property
    def verdict(self) -> str:
        """Whether tuning is worth it, in a sentence."""
        if self.problems:
            n = len(self.problems)
            return f"Not yet worth tuning: {n} {'thing is' if n == 1 else 'things are'} to be looked at first."
        gain = [each.text for each in self.remarks if each.about == "gain"]
        return " ".join(gain) or "Nothing speaks against tuning."

    def _repr_html_(self) -> str:
        """The page, for notebooks."""
        said = [f"{each.kind}: {each.about}: {each.text}" for each in self.remarks if each.about != "gain"]
        return html_of(self.verdict, tables=self.tables, sentences=[*self.head.splitlines(), *said])

    def __str__(self) -> str:
        """The page."""
        lines = [self.verdict, "", self.head, ""]
        for kind, title in (("problem", "To be mended first"), ("advice", "Advice"), ("good", "Good")):
            chosen = [each for each in self.remarks if each.kind == kind and each.about != "gain"]
            if chosen:
                lines += [f"{title}:", *(f"* {each.about}: {each.text}" for each in chosen), ""]
        for table in self.tables:
            lines += [*table.lines, ""]
        return "\n".join(lines).rstrip()
