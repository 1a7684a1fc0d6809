"""What the parts of a fit gain on models of the log, and how long they take: regressions beside simulation."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mpcoffline.core.tables import Table
from mpcoffline.core.text import figure
from mpcoffline.simulation.trials import Trials


class Share(NamedTuple):
    """One part of a fit.

    Attributes:
        name: What was done.
        seconds: How long, in s of one core.
        gain: How much less an episode costs by it, on the median of the models that have a vote.
    """

    name: str
    seconds: float
    gain: float


@dataclass(frozen=True)
class Effort:
    """Time and gain of the parts of a fit, one after the other; no file keeps it, and no result depends on it.

    Attributes:
        shares: The regressions, from MPC_1 to the whole fit; the choice, from that to the best candidate; the search
            over its weights.
    """

    shares: tuple[Share, ...]

    @classmethod
    def of(cls, trials: Trials, seconds: Mapping[str, float], names: Sequence[str]) -> Effort:
        """From the trials of the candidates.

        Args:
            trials: Of all of them.
            seconds: By the name of the part, in their order.
            names: The controller before each part, and after the last one.
        """
        steps = zip(seconds.items(), names[:-1], names[1:], strict=True)
        return cls(tuple(Share(part, spent, _gain(trials, a, b)) for (part, spent), a, b in steps))

    @property
    def table(self) -> Table:
        """A row each; the gain in the unit of the logged costs."""
        rows = [
            (each.name, f"{each.seconds:.1f}", figure(each.gain), figure(each.gain / each.seconds))
            for each in self.shares
            if each.seconds > 0.0
        ]
        header = ("", "s of one core", "an episode costs less by", "in each s")
        return Table(header, rows, "Gain on models of the log, and time", "lr")

    def __str__(self) -> str:
        """The table as text."""
        return "\n".join(self.table.lines)


def core_seconds() -> float:
    """What this process and those it has started, as compilers, have computed so far, in s of one core."""
    return sum(os.times()[:4])


def _gain(trials: Trials, before: str, after: str) -> float:
    """Mean cost of an episode less, from the starts that both were tried from; 0 where nothing is known."""
    gains = (trials.of(before) - trials.of(after))[trials.votes]
    known = ~np.isnan(gains).any(axis=0)
    return float(np.median(gains[:, known].mean(axis=1))) if len(gains) and known.any() else 0.0
