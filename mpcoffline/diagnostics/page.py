"""A report as one page of HTML that needs nothing beside it: no network, no script, light, dark and on paper."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from markupsafe import Markup

from mpcoffline.core.tables import Table
from mpcoffline.core.text import figure, listed, visible

from .background import Background, Names, ParameterLine
from .differences import SURE, TODAY, Difference, candidates
from .page_figures import loop_panels, panels
from .verdict import costs_of

if TYPE_CHECKING:
    from .report import Report

_TEMPLATE = "page.html.jinja"
_DOCS = "https://arxiv.org/abs/2301.01667"
_MOST_PARAMETERS = 200
_UNKNOWN = "unknown"
_EXPONENT = re.compile(r"e([+-]?)0*(\d+)")
_MINUS = re.compile(r"(?<![\w.)\]-])-(?=\d)")  # in front of a number, not inside a word
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_GROUPS = {"model": "Model", "cost": "Stage cost", "terminal": "Terminal cost", "reference": "Reference"}
_CANDIDATES = {
    "MPC_1": "the controller of the given description",
    "full": "all that was learned: model, stage cost, terminal cost",
    "identified": "the model that the log identifies, all else as given",
    "identified, farther": "the same, with the horizon and discount of the whole fit",
    "identified, V": "the identified model, and the learned value function as terminal cost",
    "fitted cost": "model and stage cost as learned, the terminal cost as given",
    "running": "the controller of the trial",
}
_SHORT = {"recommend": "good", "try with care": "care", "keep MPC_1": "keep"}


@dataclass(frozen=True)
class Section:
    """A part of a page that is not of the report.

    Attributes:
        title: Its heading.
        texts: Its paragraphs.
        items: What is listed below.
        tables: Its tables.
        early: Whether it follows the verdict at once; else it stands with the data.
    """

    title: str
    texts: Sequence[str] = ()
    items: Sequence[str] = ()
    tables: Sequence[Table] = ()
    early: bool = False

    def numeric(self, table: Table, column: int) -> bool:
        """Whether a column of a table holds figures."""
        return table.align[min(column, len(table.align) - 1)] == "r"


def page_of(report: Report, *, title: str = "", names: Names | None = None, sections: Sequence[Section] = ()) -> str:
    """A report as a page of HTML.

    Args:
        report: The report.
        title: Its heading; the plant's name by default.
        names: Names and units, where they are known better.
        sections: Further parts.

    Raises:
        InvalidArgumentError: For names of another number of columns.
    """
    background = None if report.background is None else report.background.named(names)
    unit = "" if background is None else background.names.cost
    plant = "" if background is None else background.names.plant
    pictures = panels(report)
    loops: list[dict[str, Any]] = []
    for k, loop in enumerate(background.loops if background is not None else ()):
        shown = [Markup(each.svg) for each in loop_panels(loop, k, background)] if background is not None else []
        loops.append({"row": loop.row, "why": loop.why, "pictures": shown})
    return _template().render(
        report=report,
        title=visible(title or plant or "Diagnosis of a learned controller"),
        plant=plant,
        tone=_SHORT[report.verdict],
        unit=unit,
        proposal=report.judgement.proposal,
        pictures={name: (Markup(each.svg), each.caption) for name, each in pictures.items()},
        loops=loops,
        marked=_marked(background),
        n_voting=int(report.trials.votes.sum()),
        costs=_costs(report),
        candidates=_candidates(report),
        meanings=_meanings(report),
        models=_models(report),
        limits=_limits(report),
        groups=() if background is None else _parameters(background.parameters),
        columns=() if background is None else _columns(report),
        episodes=None if background is None else background.episodes,
        dt=None if background is None else background.dt,
        checks=_checks(report),
        noise=_noise(report),
        made_by=() if background is None else background.made_by,
        sections=sections,
        docs=_DOCS,
    )


def _marked(background: Background | None) -> dict[str, bool]:
    """Which marks the closed loops have: what their key explains."""
    marks = () if background is None else tuple(loop.marks for loop in background.loops)
    return {kind: any(getattr(each, kind) for each in marks) for kind in ("wanted", "limits", "outside")}


def _template() -> jinja2.Template:
    text = resources.files("mpcoffline.diagnostics").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"number": number, "share": share, "prose": prose}
    return environment.from_string(text)


# ---------------------------------------------------------------- numbers and words


def number(value: float, digits: int = 4, sign: bool = False) -> str:
    """A number for a reader: some digits, a real minus, powers of ten where they are far; not finite is unknown."""
    if not np.isfinite(value):
        return _UNKNOWN if np.isnan(value) else "∞" if value > 0 else "−∞"
    return _signed(figure(value, digits, sign=sign))


def _signed(plain: str) -> str:
    """The text of a number with a real minus and raised exponents."""

    def raised(found: re.Match[str]) -> str:
        return "·10" + (("-" if found[1] == "-" else "") + found[2]).translate(_RAISED)

    return _EXPONENT.sub(raised, plain).replace("-", "−")


def pair(mean: float, error: float, *, sign: bool = False) -> str:
    """A number with its doubt; digits as far as that leaves some."""
    if not np.isfinite(mean):
        return _UNKNOWN
    if not np.isfinite(error):
        return f"{number(mean, 3, sign)} (doubt unknown)"
    if error <= 0.0:
        return number(mean, 4, sign)
    place = int(np.floor(np.log10(error))) - 1
    whole = max(1, int(np.floor(np.log10(max(abs(mean), error)))) - place + 1)
    return f"{number(mean, min(whole, 6), sign)} ± {number(error, 2)}"


def share(value: float) -> str:
    """A share in percent."""
    return f"{number(100.0 * value, 3)} %"


def prose(text: str) -> str:
    """The report's sentences as a page sets them."""
    return _MINUS.sub("−", visible(text).replace(" +- ", " ± ").replace(" -> ", " → "))


# ---------------------------------------------------------------- tables


def _costs(report: Report) -> list[dict[str, Any]]:
    words = {TODAY: "today, as logged"}
    rows = []
    for name, cost in costs_of(report.judgement, report.trials):
        low, middle, high = (float(v) for v in cost)
        rows.append({"name": words.get(name, name), "low": low, "middle": middle, "high": high})
    return rows


def _candidates(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "name": f"{each.name} (clone)" if each.name == TODAY else each.name,
            "judged": each.name == report.judgement.proposal,
            "cost": number(each.cost),
            "difference": pair(each.difference, SURE * each.error, sign=True),
            "agree": f"{each.agree} of {each.of}",
            "lost": share(each.lost),
        }
        for each in candidates(report.choice or report.trials)
    ]


def _meanings(report: Report) -> list[tuple[str, str]]:
    """What the candidates are, of those whose names do not say it."""
    names = [each.name for each in candidates(report.choice or report.trials)]
    known = {name: text for name, text in _CANDIDATES.items() if any(each.startswith(name) for each in names)}
    variants = {
        ", undiscounted": ("undiscounted", "with a discount of 1, as an episode is paid"),
        ", residual": ("residual", "with a network for what the model misses"),
        ", polished": ("polished", "with weights that closed loops have moved"),
    }
    return [*known.items(), *(said for end, said in variants.items() if any(end in each for each in names))]


def _models(report: Report) -> list[dict[str, Any]]:
    """Each model: whether it is asked, and what it says of the proposal."""
    trials, proposal = report.trials, report.judgement.proposal
    said: dict[str, str] = {}
    if trials.votes.any() and proposal != trials.names[0]:
        d = Difference.of(trials, proposal, trials.names[0])
        said = {m: pair(d.mean[k], SURE * d.error[k], sign=True) for k, m in enumerate(d.models)}
    return [
        {"name": name, "asked": bool(vote), "difference": said.get(name, "–")}
        for name, vote in zip(trials.models, trials.votes, strict=True)
    ]


def _limits(report: Report) -> list[dict[str, Any]]:
    """How often, and by how much at most, the log, MPC_1 and the proposal violate each limit."""
    return [
        {
            "name": f"{each.name} ({each.kind})",
            "worse": each.worse,
            "cells": [
                "kept" if not s else f"{share(s)} of the steps, by up to {number(most, 3)}"
                for s, most in zip(each.shares, each.largest, strict=True)
            ],
        }
        for each in report.limits
    ]


def _parameters(lines: Iterable[ParameterLine]) -> list[dict[str, Any]]:
    """By what they belong to; those of the model whole, of others the first ones."""
    groups = []
    every = list(lines)
    for group, title in _GROUPS.items():
        own = [line for line in every if line.group == group]
        if own:
            rows = [_parameter(line) for line in own[:_MOST_PARAMETERS]]
            groups.append({"title": title, "model": group == "model", "rows": rows, "more": len(own) - len(rows)})
    return groups


def _parameter(line: ParameterLine) -> dict[str, str]:
    known = np.isfinite(line.found)
    log = pair(line.found, SURE * line.deviation) if known else "–"
    return {
        "name": line.name,
        "unit": line.unit,
        "before": number(line.before) if np.isfinite(line.before) else "–",
        "log": f"not determined ({log})" if line.open else log,
        "after": number(line.after),
    }


def _columns(report: Report) -> list[dict[str, Any]]:
    if report.background is None:
        return []
    names = report.background.names
    called = (*names.states, *names.inputs, "stage cost")
    return [
        {"name": name, "values": [number(v) for v in (c.low, c.mean, c.high, c.spread)]}
        for name, c in zip(called, report.background.columns, strict=True)
    ]


def _noise(report: Report) -> list[dict[str, str]]:
    """Noise of each state."""
    noise, names = report.noise, None if report.background is None else report.background.names.states
    return [
        {
            "name": f"state {i + 1}" if names is None or i >= len(names) else names[i],
            "measurement": number(float(noise.measurement[i]), 3),
            "level": share(float(noise.levels[i])),
            "process": number(float(noise.process[i]), 3),
        }
        for i in range(len(noise.measurement))
    ]


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(number(each, 3) for each in values)


def _shares(shares: Iterable[float]) -> str:
    return "; ".join(share(each) if np.isfinite(each) else "–" for each in shares)


def _checks(report: Report) -> dict[str, list[tuple[str, str]]]:
    """The report's other figures, by what they are about."""
    p, v, t = report.prediction, report.value, report.theorem
    value = (
        f"correlation {number(v.correlation, 2)} (a regression has {number(v.attainable, 2)}), bias"
        f" {number(v.bias, 2, True)} standard deviations, above by more than one in {share(v.above)} of {v.n} states"
        if v.n
        else "no episode is long enough"
    )
    reached = _UNKNOWN if report.goal is None else share(report.goal.share)
    return {
        "model": [
            ("One-step error of MPC_1's model", share(p.nominal)),
            ("of the identified model", share(p.identified)),
            ("of the learned MPC's model", share(p.learned)),
            ("What the log does not determine", listed(p.undetermined, joint="; ") or "nothing"),
            ("Predictions outside the data", share(report.outside_support)),
            ("Share of the logged cost that the simulated one explains (R²)", number(report.cost_r2)),
            ("Effect of past inputs, against the present one's", share(report.lag.share)),
            (
                "Past inputs that the model lacks, as where one acts late or slowly",
                "found" if report.lag.found else "none found",
            ),
        ],
        "value": [
            ("V against measured returns", value),
            ("V along model rollouts, of its range in the data", number(t.value_growth, 3)),
            ("Rollouts outside the data", share(t.outside)),
            ("Closed-loop eigenvalues at the reference (moduli)", _numbers(t.eigenvalues) or _UNKNOWN),
            *((f"Eigenvalues of {w.name}", f"{_numbers(w.before)} → {_numbers(w.after)}") for w in report.weights),
        ],
        "solver": [
            ("Problems of MPC_1 not solved at first", share(report.failed_solves[0])),
            ("of the proposal", share(report.failed_solves[1])),
            ("Parameters at a bound", listed(report.at_bounds, 12) or "none"),
            *((f"{e.name} moves a step, of its range: log; MPC_1; proposal", _shares(e.shares)) for e in report.travel),
        ],
        "data": [("Logged states near the goal", reached)],
    }
