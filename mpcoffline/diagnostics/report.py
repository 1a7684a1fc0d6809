"""What :func:`mpcoffline.diagnose` returns: figures, a verdict, and the reasons, as text, JSON and a picture."""

from __future__ import annotations

import json
import textwrap
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mpcoffline.core.archive import plain
from mpcoffline.core.text import listed
from mpcoffline.estimation.smoothing import NoiseEstimate
from mpcoffline.plotting import save_figure

from .figure import Traces, draw
from .measures import GoalCheck, LagCheck, RegionError, ValueCheck
from .stability import TheoremCheck, WeightCheck
from .verdict import Comparison, Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDTH = 84  # of the text


@dataclass(frozen=True)
class PredictionCheck:
    """One-step prediction errors, every coordinate in the spread of its increments (root mean squares).

    Attributes:
        nominal: Of MPC_1's model.
        identified: Of the model with the smallest error: what this model structure can do.
        learned: Of the learned MPC's model.
        undetermined: Parameters, or combinations, that the data do not determine.
    """

    nominal: float
    identified: float
    learned: float
    undetermined: tuple[str, ...]


@dataclass(frozen=True)
class Report:
    """May this fit be trusted?

    Only the simulations decide the verdict; the other figures explain it, and rank fits badly on their own.

    Attributes:
        verdict: ``"recommend"``, ``"try with care"`` or ``"keep MPC_1"``.
        reasons: Why, and what to do; the decisive one first.
        notes: What else the user should know, and what to do about it.
        comparison: Both controllers on an ensemble of models identified from the log.
        value: V_phi against measured returns.
        fit: The regression error of (FIT) before and after, by region.
        prediction: One-step prediction errors.
        theorem: The condition of Theorem 1.
        weights: Eigenvalues of W and R.
        at_bounds: Learned parameters on a bound.
        outside_support: Share of f_theta(s, a), over the logged (s, a), outside the data's support.
        lag: Whether inputs act late.
        noise: Measurement and process noise.
        goal: How near the log comes to the goal; None without one.
        failed_solves: Share of the simulations' MPCs that were not solved at first: MPC_1's, the learned MPC's.
        findings: What the fit found beside the parameters; see :attr:`mpcoffline.OfflineMPCLearner.findings`.
        n_rows: Transitions.
        n_episodes: Episodes.
        traces: What the figure shows besides; not in the JSON form.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    notes: tuple[str, ...]
    comparison: Comparison
    value: ValueCheck
    fit: tuple[RegionError, ...]
    prediction: PredictionCheck
    theorem: TheoremCheck
    weights: tuple[WeightCheck, ...]
    at_bounds: tuple[str, ...]
    outside_support: float
    lag: LagCheck
    noise: NoiseEstimate
    goal: GoalCheck | None
    failed_solves: tuple[float, float]
    findings: tuple[str, ...]
    n_rows: int
    n_episodes: int
    traces: Traces = field(repr=False, compare=False)

    def __str__(self) -> str:
        """The report as plain text."""
        c, p, ratios = self.comparison, self.prediction, np.array(self.comparison.ratios)
        lines = [f"Verdict: {self.verdict}", *map(_item, self.reasons)]
        for title, items in (("Notes", self.notes), ("What the fit found", self.findings)):
            lines += [title, *map(_item, items)] if items else []
        rows = [
            ("data", f"{self.n_rows} rows, {self.n_episodes} episodes"),
            ("models, starts, steps", f"{len(ratios)}, {c.n_starts}, {c.n_steps}"),
            ("cost relative to MPC_1", f"{ratios[0]:.3f} identified, {ratios.min():.3f} to {ratios.max():.3f} all"),
            ("episodes that end well", f"{c.nominal_success[0]:.0%} MPC_1, {c.learned_success[0]:.0%} learned"),
            ("failed solves", "{:.2%} MPC_1, {:.2%} learned".format(*self.failed_solves)),
            ("R2 of the simulated cost", f"{c.cost_r2:.4f}"),
            ("V against returns", self._value_text()),
            *((f"(FIT) error, {part.name}", f"{part.before:.3g} before, {part.after:.3g} after") for part in self.fit),
            ("one-step error", f"{p.nominal:.3g} MPC_1, {p.identified:.3g} identified, {p.learned:.3g} learned"),
            ("f(s,a) outside the data", f"{self.outside_support:.1%}"),
            ("V along model rollouts", f"{self.theorem.value_growth:.2f} of its range in the data"),
            ("rollouts outside the data", f"{self.theorem.outside:.1%}"),
            ("closed-loop eigenvalues", _numbers(self.theorem.eigenvalues) or "unknown"),
            *((f"eigenvalues of {w.name}", f"{_numbers(w.before)} before, {_numbers(w.after)} after")
              for w in self.weights),
            ("parameters at bounds", listed(self.at_bounds) or "none"),
            ("measurement noise", f"{self.noise.level:.1%} of the states' spread ({self.noise.source})"),
            ("effect of past inputs", f"{self.lag.share:.1%} of the present one's"),
            ("logged states near the goal", "unknown" if self.goal is None else f"{self.goal.share:.2%}"),
        ]  # fmt: skip
        width = max(len(name) for name, _ in rows)
        return "\n".join([*lines, "Figures", *(f"  {name:<{width}}  {text}" for name, text in rows)])

    def with_notes(self, notes: tuple[str, ...]) -> Report:
        """The same report with notes."""
        return replace(self, notes=notes)

    def _value_text(self) -> str:
        v = self.value
        if not v.n:
            return "no episode is long enough"
        return f"correlation {v.correlation:.2f}, bias {v.bias:+.2f} std, above {v.above:.0%} of {v.n}"

    def to_json(self) -> str:
        """The report as JSON text; what is not finite becomes null."""
        data = {name: value for name, value in asdict(self).items() if name != "traces"}
        data["comparison"] |= {"ratios": list(self.comparison.ratios), "limit": self.comparison.limit}
        data["noise"] |= {"level": self.noise.level}
        return json.dumps(plain(data), indent=2, allow_nan=False)

    def plot(self) -> Figure:
        """Draws the report: relative costs on the models, closed loops, V against returns, and the error of (FIT).

        Returns:
            The figure; a notebook shows it.
        """
        return draw(self.verdict, self.comparison, self.value, self.fit, self.traces)

    def figure(self, path: str | PathLike[str]) -> list[Path]:
        """Writes :meth:`plot`.

        Args:
            path: Where; PDF and PNG are written, whichever of them it names.

        Returns:
            The files.
        """
        return save_figure(self.plot(), Path(path))


def _item(text: str) -> str:
    """A list item, wrapped."""
    return textwrap.fill(text, _WIDTH, initial_indent="  - ", subsequent_indent="    ", break_on_hyphens=False)


def _numbers(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
