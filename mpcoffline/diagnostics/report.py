"""What :func:`mpcoffline.diagnose` returns: figures, a verdict, and the reasons, as text, JSON and a picture."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from html import escape
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mpcoffline.core.archive import plain
from mpcoffline.core.notebook import html_of
from mpcoffline.core.outputs import write_file
from mpcoffline.core.text import figure, listed, visible
from mpcoffline.estimation.smoothing import NoiseEstimate
from mpcoffline.plotting import save_figure
from mpcoffline.simulation.trials import Trials

from .background import Background, Names
from .differences import TODAY, candidates
from .figure import Traces, draw
from .limits import LimitCheck
from .measures import GoalCheck, LagCheck, RegionError, ValueCheck
from .page import Section, page_of
from .stability import TheoremCheck, WeightCheck
from .travel import Travel
from .verdict import Judgement, Verdict, costs_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDTH = 79  # of the text


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
class Trust:
    """What the log cost, as models predict it that are left to themselves under its own controller.

    A clone of the logged controller acts, with what was done beside it on top; nothing is replayed that a model misses.

    Attributes:
        deviation: Median over the voting models of the mean difference of an episode's cost, simulated minus logged, in
            spreads of the stage cost, a step.
        scatter: Root mean square of the differences, episode by episode, likewise.
    """

    deviation: float
    scatter: float

    def __str__(self) -> str:
        """In words."""
        return f"off by {self.deviation:+.2g} spreads of the cost a step, episode by episode by {self.scatter:.2g}"


@dataclass(frozen=True)
class Report:
    """May this fit be trusted?

    Only the simulations decide the verdict; the other figures explain it, and rank fits badly on their own.

    Attributes:
        judgement: The verdict and what it rests on.
        trials: What was judged and what it was compared with, on models of the log.
        choice: All candidates, where the learner chose among them.
        notes: What else the user should know, and what to do about it.
        cost_r2: Share of the logged costs' variance that the simulated cost explains.
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
        trust: How well the models reproduce what the log itself cost; None where none has a vote.
        limits: How often each limit of the MPC that was given is violated.
        travel: How far each input travels.
        background: What :meth:`html` shows besides; not in the JSON form.
    """

    judgement: Judgement
    trials: Trials
    choice: Trials | None
    notes: tuple[str, ...]
    cost_r2: float
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
    trust: Trust | None = None
    limits: tuple[LimitCheck, ...] = ()
    travel: tuple[Travel, ...] = ()
    background: Background | None = field(default=None, repr=False, compare=False)

    @property
    def verdict(self) -> Verdict:
        """``"recommend"``, ``"try with care"`` or ``"keep MPC_1"``."""
        return self.judgement.verdict

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why, and what to do; the decisive one first."""
        return self.judgement.reasons

    def _repr_html_(self) -> str:
        """The verdict and its reasons, for notebooks; the page of :meth:`html` has the rest."""
        text = "\n".join(escape(visible(line)) for line in str(self).splitlines())
        text = f"<details><summary>All figures</summary><pre>{text}</pre></details>"
        return html_of(f"Verdict: {self.verdict}", sentences=self.reasons) + text

    def __str__(self) -> str:
        """The report as plain text."""
        p = self.prediction
        lines = [f"Verdict: {self.verdict}", *map(_item, self.reasons), *self._costs(), *self._limits()]
        lines += self._candidates()
        for title, items in (("Notes", self.notes), ("What the fit found", self.findings)):
            lines += [title, *map(_item, items)] if items else []
        rows = [
            ("data", f"{self.n_rows} rows, {self.n_episodes} episodes"),
            ("failed solves", "{:.2%} MPC_1, {:.2%} learned".format(*self.failed_solves)),
            ("R2 of the simulated cost", f"{self.cost_r2:.4f}"),
            ("V against returns", self._value_text()),
            *((f"(FIT) error, {part.name}", f"{part.before:.3g} before, {part.after:.3g} after") for part in self.fit),
            ("one-step error", f"{p.nominal:.3g} MPC_1, {p.identified:.3g} identified, {p.learned:.3g} learned"),
            ("f(s,a) outside the data", f"{self.outside_support:.1%}"),
            ("V along model rollouts", f"{self.theorem.value_growth:.2f} of its range in the data"),
            ("rollouts outside the data", f"{self.theorem.outside:.1%}"),
            ("closed-loop eigenvalues", _numbers(self.theorem.eigenvalues) or "unknown"),
            *((f"eigenvalues of {w.name}", f"{_numbers(w.before)} before, {_numbers(w.after)} after")
              for w in self.weights),
            *((f"{each.name} moves a step", _travel_text(each)) for each in self.travel),
            ("parameters at bounds", listed(self.at_bounds, 3) or "none"),
            ("measurement noise", f"{self.noise.level:.1%} of the states' spread ({self.noise.source})"),
            ("effect of past inputs", f"{self.lag.share:.1%} of the present one's"),
            ("logged states near the goal", "unknown" if self.goal is None else f"{self.goal.share:.2%}"),
        ]  # fmt: skip
        width = max(len(name) for name, _ in rows)
        return "\n".join([*lines, "Figures", *(f"  {name:<{width}}  {text}" for name, text in rows)])

    def with_notes(self, notes: tuple[str, ...]) -> Report:
        """The same report with notes."""
        return replace(self, notes=notes)

    def _costs(self) -> list[str]:
        """Today, MPC_1 and the proposal, and how far models and log agree, which says how far to trust the rest."""
        t = self.trials
        rows: list[tuple[str, ...]] = [("", "lowest", "expected", "highest")]
        for name, cost in costs_of(self.judgement, t):
            known = bool(np.isfinite(cost).any())
            rows.append(
                (name, *(figure(value, 4) if np.isfinite(value) else "?" for value in cost))
                if known
                else (name, "", "?", "")
            )
        title = f"Cost of an episode of {t.n_steps} steps, {len(t.rows)} starts"
        voting = f"{int(t.votes.sum())} of {len(t.models)} models predict the log well enough to be asked"
        if self.trust is not None:
            voting += f"; left to themselves under the log's own controller, their costs are {self.trust}"
        return [title, *_columns(rows), _item(f"{voting}.")]

    def _limits(self) -> list[str]:
        """How often, and by how much at most, limits are violated."""
        rows: list[tuple[str, ...]] = [("", "the log", self.trials.names[0], self.judgement.proposal)]
        for check in self.limits:
            told = [
                f"{share:.1%}" + (f" ({most:.2g})" if most > 0.0 else "")
                for share, most in zip(check.shares, check.largest, strict=True)
            ]
            rows.append((f"{check.name} ({check.kind})", *told))
        title = "Limits: share of the steps that violate them (by how much at most), on the identified model"
        return [title, *_columns(rows)] if self.limits else []

    def _candidates(self) -> list[str]:
        """What was tried, the cheapest first: in the choice, where there was one."""
        rows: list[tuple[str, ...]] = [("", "minus MPC_1", "models that agree", "lost")]
        for each in candidates(self.choice or self.trials):
            name = f"{each.name} (clone)" if each.name == TODAY else each.name
            chosen = f"{name} *" if each.name == self.judgement.proposal else name
            rows.append(
                (
                    chosen,
                    f"{figure(each.difference, sign=True)} +- {figure(2.0 * each.error, 2)}",
                    f"{each.agree} of {each.of}",
                    f"{each.lost:.1%}",
                )
            )
        return (
            [
                f"Candidates, by {'the choice of the fit' if self.choice else 'these episodes'} (* is judged)",
                *_columns(rows),
            ]
            if len(rows) > 1
            else []
        )

    def _value_text(self) -> str:
        v = self.value
        if not v.n:
            return "no episode is long enough"
        return f"correlation {v.correlation:.2f}, bias {v.bias:+.2f} std, above {v.above:.0%} of {v.n}"

    def to_json(self) -> str:
        """The report as JSON text; what is not finite becomes null."""
        fields = ("trials", "choice", "traces", "background", "judgement")
        judgement = {name: value for name, value in vars(self.judgement).items() if name not in ("first", "today")}
        data = judgement | {name: value for name, value in vars(self).items() if name not in fields}
        data = {name: _as_data(value) for name, value in data.items()}
        t = self.trials
        data["costs"] = {name: list(cost) for name, cost in costs_of(self.judgement, t)}
        data["candidates"] = [asdict(each) for each in candidates(self.choice or t)]
        data["difference"] = _as_data(self.judgement.first)
        data["today"] = _as_data(self.judgement.today)
        data["trials"] = {
            "models": t.models, "votes": t.votes, "starts": len(t.rows), "steps": t.n_steps,
            "cost": {name: t.of(name).mean(axis=1) for name in t.names},
        }  # fmt: skip
        data["noise"] |= {"level": self.noise.level}
        return json.dumps(plain(data), indent=2, allow_nan=False)

    def plot(self) -> Figure:
        """Draws the report: candidates, costs, models against the log, closed loops, V against returns, error of (FIT).

        Returns:
            The figure; a notebook shows it.
        """
        return draw(self.judgement, self.trials, self.choice or self.trials, self.value, self.fit, self.traces)

    def figure(self, path: str | PathLike[str]) -> list[Path]:
        """Writes :meth:`plot`.

        Args:
            path: Where; PDF and PNG are written, whichever of them it names.

        Returns:
            The files.
        """
        return save_figure(self.plot(), Path(path))

    def html(
        self,
        path: str | PathLike[str],
        *,
        title: str = "",
        names: Names | None = None,
        sections: Sequence[Section] = (),
    ) -> Path:
        """Writes the report as one page of HTML, for a browser and for paper, that loads nothing from elsewhere.

        It begins with the verdict and its reasons; then what would change (costs, closed loops from the same starts),
        candidates, parameters before and after, how far models and data can be trusted, notes, versions and hashes.
        Equal reports give equal pages.

        Args:
            path: The file; what was there is replaced, its folder made where it is missing.
            title: The heading; by default the name of the plant, where that is known.
            names: Names and units of states, inputs and cost, where they are known better than from the data set.
            sections: Further parts of the page.

        Returns:
            The file.

        Raises:
            InvalidArgumentError: For names of another number of columns.
            StorageError: If it cannot be written.
        """
        return write_file(path, page_of(self, title=title, names=names, sections=sections))


def _as_data(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_as_data(each) for each in value]
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value


def _columns(rows: list[tuple[str, ...]]) -> list[str]:
    """A small table: names to the left, figures to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  "
        + "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]).rstrip()
        for row in rows
    ]


def _item(text: str) -> str:
    """A list item, wrapped."""
    return textwrap.fill(text, _WIDTH, initial_indent="  - ", subsequent_indent="    ", break_on_hyphens=False)


def _travel_text(travel: Travel) -> str:
    logged, first, proposed = (f"{share:.1%}" if np.isfinite(share) else "?" for share in travel.shares)
    return f"{logged} of its range in the log, {first} MPC_1, {proposed} learned"


def _numbers(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
