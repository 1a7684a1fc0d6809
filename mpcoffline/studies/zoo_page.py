"""The page of what was learned on plants that nobody tuned for: counts, and a line a case."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mpcoffline.core.tables import Table
from mpcoffline.core.text import markdown

from .zoo import Outcome


class Summary(NamedTuple):
    """Counts over all cases that have a result.

    Attributes:
        cases: Number of cases.
        worse: Those where the learned MPC costs more than MPC_1 by more than 2 % of its size.
        yardsticks: Number of cases with a yardstick.
        close: Of these, those within 5 % of it.
        room: Of these, those where the yardstick is better than MPC_1 by more than 2 %.
        better: Of these, those where the learned MPC is, too.
    """

    cases: int
    worse: list[Outcome]
    yardsticks: int
    close: int
    room: int
    better: int


def summarised(outcomes: Sequence[Outcome]) -> Summary:
    """The counts."""
    done = [o for o in outcomes if not o.error]
    measured = [o for o in done if not np.isnan(o.yardstick)]
    room = [o for o in measured if o.room]
    close, better = sum(o.close for o in measured), sum(o.better for o in room)
    return Summary(len(done), [o for o in done if o.worse], len(measured), close, len(room), better)


_HEADER = ["plant", "seed", "behaviour", "MPC_1", "yardstick", "learned", "learned - MPC_1", "learned - yardstick"]
_HEADER += ["ends well: MPC_1/yardstick/learned", "fit (s)", "build (s)", "learned - behaviour", "handed out"]
_HEADER += ["full - MPC_1"]
_OF_LIMITS = ["steps that violate a limit: MPC_1/yardstick/learned", "learned - MPC_1"]
_OF_VERDICT = ["from the log's starts", "expected", "verdict", "verdict on full"]


def report(outcomes: Sequence[Outcome]) -> str:
    """A page in Markdown: the counts, those that became worse, and a line a case."""
    rows = sorted(outcomes, key=lambda o: o.key)
    s, failed = summarised(rows), [o for o in rows if o.error]
    starts = ", ".join(str(n) for n in sorted({o.starts for o in rows})) or "no"
    lines = [
        "# Plants that nobody tuned for",
        "",
        f"`scripts/bench_zoo`: {s.cases} cases, each a plant file and a seed (of MPC_1's errors, the log, the learning,"
        f" the starts), the default preset, no option set for any plant. Costs are means over {starts} starts that the"
        " log does not hold, the same for all controllers; differences are paired, +- their standard error. The"
        " yardstick is an MPC with the best model and the plant's own stage cost. What a plant file is:"
        " [](../guides/plant_files.md).",
        "",
        f"* Worse than MPC_1 by more than 2 % of its cost: **{len(s.worse)} of {s.cases}**"
        + "".join(f"; {o.plant} {o.seed} ({_pair(o.gain, o.gain_error)})" for o in s.worse),
        f"* Within 5 % of the yardstick: **{s.close} of {s.yardsticks}**",
        f"* Better than MPC_1 by more than 2 % where the yardstick is: **{s.better} of {s.room}**",
        f"* Time in s of one core: fit {_range([o.fit_s for o in rows])};"
        f" build of its solver {_range([o.build_s for o in rows])}",
    ]
    lines += _of_choice(done := [o for o in rows if not o.error]) + _of_verdicts([o for o in done if o.verdict])
    lines += _of_limits(limited := [o for o in rows if not np.isnan(o.over_learned)])
    lines += [f"* Failed: {o.plant} {o.seed}: {o.error}" for o in failed]
    judged = any(o.verdict for o in rows)
    has_limits = bool(limited)
    header = _HEADER + _OF_LIMITS * has_limits + _OF_VERDICT * judged
    cells = [_cells(o) + _limit_cells(o) * has_limits + _verdict_cells(o) * judged for o in rows]
    table = Table(header, cells, align="lrrrrrrrrrrrlr" + "rr" * has_limits + "rrll" * judged)
    lines += ["", table.markdown(), "", *_sayings(rows)]
    return "\n".join(lines).rstrip("\n") + "\n"


def _of_limits(rows: Sequence[Outcome]) -> list[str]:
    """Violations of what was handed out, of the plants that have limits."""
    if not rows:
        return []
    more = [o for o in rows if o.violates_more]
    return [
        f"* Violates limits in more steps than MPC_1, beyond two standard errors: **{len(more)} of {len(rows)}** with"
        f" limits{_names(more)}"
    ]


def _limit_cells(o: Outcome) -> list[str]:
    shares = [o.over_mpc_1, o.over_yardstick, o.over_learned]
    told = "/".join("-" if np.isnan(share) else f"{share:.1%}" for share in shares)
    return [told, "-" if np.isnan(o.more_over) else f"{100 * o.more_over:+.2g} +- {100 * o.more_over_error:.2g} %"]


def _of_choice(rows: Sequence[Outcome]) -> list[str]:
    """What choosing among candidates gave."""
    chosen = [o for o in rows if o.candidate]
    if not chosen:
        return []
    worse = sum(o.full_worse for o in chosen)
    return [
        f"* The whole fit, had it been handed out everywhere: worse than MPC_1 by more than 2 % in {worse} of"
        f" {len(chosen)}; better in {sum(o.full_better for o in chosen)}, what was handed out in"
        f" {sum(o.better for o in chosen)}. Time of the choice {_range([o.choice_s for o in chosen])}"
    ]


def _of_verdicts(rows: Sequence[Outcome]) -> list[str]:
    """Verdicts against the truth: on what was handed out, and on the whole fit."""
    if not rows:
        return []

    def both(count: Callable[[bool], str]) -> str:
        return f"handed out {count(False)}, whole fit {count(True)}"

    def recommended(o: Outcome, full: bool) -> bool:
        return (o.full_verdict if full else o.verdict) == "recommend"

    def wrong(full: bool) -> str:
        found = [o for o in rows if recommended(o, full) and (o.full_worse if full else o.worse)]
        return f"**{len(found)}**" + _names(found)

    def right(full: bool) -> str:
        better = [o for o in rows if (o.full_better if full else o.better)]
        return f"**{sum(recommended(o, full) for o in better)} of {len(better)}**"

    def right_today(full: bool) -> str:
        better = [o for o in rows if (o.full_better if full else o.better)]
        better = [o for o in better if (o.full_under_today if full else o.under_today)]
        return f"**{sum(recommended(o, full) for o in better)} of {len(better)}**"

    def over(full: bool) -> str:
        found = [o for o in rows if recommended(o, full) and (o.full_over_today if full else o.over_today)]
        return f"**{len(found)}**" + _names(found)

    def warned(full: bool) -> str:
        found = [o for o in rows if (o.full_over_today if full else o.over_today)]
        return f"**{sum((o.full_warned if full else o.warned) > 0.0 for o in found)} of {len(found)}**"

    known = [o for o in rows if np.isfinite(o.expected)]
    off = [abs(o.expected - o.from_log) / abs(o.from_log) for o in known]
    lines = [
        f"* Recommended, but worse than MPC_1 by more than 2 %: {both(wrong)}",
        f"* Better than MPC_1 by more than 2 % and recommended: {both(right)}",
        f"* Better than the controllers of the log by more than 2 %, too, and recommended: {both(right_today)}",
        f"* Recommended, but worse than the controllers of the log by more than 2 %: {both(over)}",
        f"* Worse than these by more than 2 %, and the verdict says so: {both(warned)}",
    ]
    if off:
        inside = sum(o.lowest <= o.from_log <= o.highest for o in known)
        lines.append(
            f"* Expected against true cost of what was handed out, from where episodes of the log began: median"
            f" deviation **{np.median(off):.1%}**, 90 % within **{np.quantile(off, 0.9):.0%}**; within the report's own"
            f" band {inside} of {len(known)}"
        )
    total = [o.fit_s + o.verdict_s for o in rows]
    return [*lines, f"* Time in s of one core: verdict {_range([o.verdict_s for o in rows])}; with fit {_range(total)}"]


def _names(rows: Sequence[Outcome]) -> str:
    return f" ({'; '.join(f'{o.plant} {o.seed}' for o in rows)})" if rows else ""


def _sayings(rows: Sequence[Outcome]) -> list[str]:
    """What the learner said, once a plant where only numbers differ; a column of it would make the table unreadable."""
    first: dict[tuple[str, str], Outcome] = {}
    for o in rows:
        first.setdefault((o.plant, re.sub(r"[\d.]+", "", o.said)), o)
    said = [f"* {o.plant} {o.seed}: {markdown(o.said)}" for o in first.values() if o.said]
    intro = ["## What the learner said", "", "Where it is the same but for numbers, for the first seed.", ""]
    return [*intro, *said] if said else []


def _cells(o: Outcome) -> list[str]:
    costs = [_number(cost) for cost in (o.behaviour, o.mpc_1, o.yardstick, o.learned)]
    ends = "/".join("-" if np.isnan(e) else f"{e:.2f}" for e in (o.ends_mpc_1, o.ends_yardstick, o.ends_learned))
    differences = [_pair(o.gain, o.gain_error), _pair(o.short, o.short_error)]
    times = ["-" if np.isnan(t) else f"{t:.0f}" for t in (o.fit_s, o.build_s)]
    over = _pair(o.over_behaviour, o.over_behaviour_error)
    full = _pair(o.full_gain, o.full_gain_error)
    return [o.plant, str(o.seed), *costs, *differences, ends, *times, over, o.candidate or "-", full]


def _verdict_cells(o: Outcome) -> list[str]:
    band = "-" if np.isnan(o.expected) else f"{o.expected:.4g} ({o.lowest:.4g} to {o.highest:.4g})"
    return [_number(o.from_log), band, f"{o.verdict}: {o.reason}".rstrip(": ") or "-", o.full_verdict or "-"]


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.5g}"


def _pair(mean: float, error: float) -> str:
    return "-" if np.isnan(mean) else f"{mean:+.3g} +- {error:.2g}"


def _range(values: Sequence[float]) -> str:
    known = [value for value in values if not np.isnan(value)]
    return f"{min(known):.0f} to {max(known):.0f} (median {np.median(known):.0f})" if known else "-"
