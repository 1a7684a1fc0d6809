"""The page of the field: what each controller costs, log by log, and where ours loses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mpcoffline.core.tables import Table

from .jobs import ALGORITHMS, NAN, Outcome

OURS, BEST = "default", "truth"
MARGIN = 0.02  # as in the other studies: what differs by less is as good

#: What was asked of each, beyond what the figures show.
SETTINGS = """\
## How each was run

* **Logs.** The tasks' are whole episodes drawn at random from the shipped ones, which hold all that a DDPG agent did
  while it learned; a plant file's come from its own controllers, another one an episode. The seed draws the episodes,
  the model error of MPC_1 (alpha = 1) and, on plant files, the starts. A third of the swing-ups' starts is hanging.
* **The log's controller.** On plant files, from the starts of the comparison. Of the tasks there is no such controller:
  the figure is that of all logged episodes, from their own starts, none of them hanging, and not to be set beside the
  others'.
* **MPC, true model.** Of the swing-ups: true model, nominal cost, 50 steps, undiscounted, as J is. That is no bound: a
  longer look or a learned terminal cost can be better. Of the linear task: the optimum of Jd. Else: the plant file's
  yardstick.
* **Identified, plain MPC.** Our identification, then MPC_1 with that model, undiscounted in the tasks;
  nothing else is learned.
* **mpcoffline.** The presets as they are, no option set for any plant. They are given MPC_1, which the networks are
  not: that is what a model is worth, and the price is to have one.
* **Behaviour cloning, TD3+BC, IQL, CQL.** d3rlpy 2.8.1, with the settings of its authors' reproduction scripts (TD3+BC:
  alpha 2.5; IQL: expectile 0.7, temperature 3, cosine decay; CQL: conservative weight 5, three layers of 256), discount
  0.99, {steps} gradient steps of 256 transitions, the last policy counts. Reward is minus the cost, divided by the
  range of the log's returns and times 1000, as IQL's authors do; observations are standardised; actions are scaled from
  their bounds to [-1, 1]. Only where an episode terminated is the future worth nothing; where it was cut, it is not,
  and its last transition is kept. d3rlpy draws minibatches row by row; they are drawn by index here, which makes its
  trainings faster.
* **Best of 10 on the plant** (`--search`). Ten settings of two knobs each, the best by closed loops on the true plant
  from other starts: more than anybody has who has a log alone. One seed, 5,000 transitions.
* **Times.** Training: CPU time of one core. Actions: median of 100, one observation at a time, with warm starts, in
  Python on the same core. File: what `save` and d3rlpy's `save_policy` write.
"""


@dataclass(frozen=True)
class Cell:
    """Seeds of one controller on one log size, put together: means; NaN where there is none.

    Attributes:
        seeds: The seeds that are there.
        cost: J.
        error: Standard error over the seeds; of one seed, over the starts.
        excess: J over that of the true model's MPC, ``1 + (J - J_true) / |J_true|``, seed by seed.
        verdicts: What ours says of itself, seed by seed.
    """

    seeds: tuple[int, ...]
    cost: float
    error: float
    discounted: float
    success: float
    violated: float
    train_s: float
    latency_ms: float
    file_kb: float
    excess: float
    verdicts: tuple[str, ...]


class Results:
    """Outcomes by arena, algorithm and size.

    Args:
        outcomes: Lines of the results; those that failed count as missing.
    """

    def __init__(self, outcomes: Iterable[Outcome]) -> None:
        whole = [o for o in outcomes if not o.error]
        self.done = [o for o in whole if np.isfinite(o.cost)]
        self.timed = [o for o in whole if o.algorithm == "mpcrl"]
        self.arenas = list(dict.fromkeys(o.arena for o in self.done))
        self._by = {(o.arena, o.algorithm, o.size, o.seed): o for o in self.done}

    def place(self, arena: str) -> int:
        """Where an arena stands; those that nothing but times are known of, last."""
        return self.arenas.index(arena) if arena in self.arenas else len(self.arenas)

    def sizes(self, arena: str) -> list[int]:
        """The log sizes that there is something of."""
        return sorted({o.size for o in self.done if o.arena == arena and o.size})

    def one(self, arena: str, algorithm: str, size: int, seed: int) -> Outcome | None:
        """A line; of what needs no log, that of the seed."""
        return self._by.get((arena, algorithm, size if ALGORITHMS[algorithm].needs_log else 0, seed))

    def excess(self, outcome: Outcome) -> float:
        """See :class:`Cell`; NaN where the true model's MPC is missing or costs nothing, and for other starts."""
        best = self.one(outcome.arena, BEST, 0, outcome.seed)
        if best is None or best.cost == 0.0 or outcome.has_own_starts:
            return NAN
        return 1.0 + (outcome.cost - best.cost) / abs(best.cost)

    def cell(self, arena: str, algorithm: str, size: int, seeds: Sequence[int] | None = None) -> Cell | None:
        """All seeds of one controller and size, or some; None where there is none."""
        size = size if ALGORITHMS[algorithm].needs_log else 0
        rows = [
            o
            for o in self.done
            if (o.arena, o.algorithm, o.size) == (arena, algorithm, size) and (seeds is None or o.seed in seeds)
        ]
        if not rows:
            return None

        def mean(of: Callable[[Outcome], float]) -> float:
            return float(np.mean([of(o) for o in rows]))

        costs = np.array([o.cost for o in rows])
        spread = float(costs.std(ddof=1) / np.sqrt(len(rows))) if len(rows) > 1 else rows[0].cost_error
        return Cell(
            tuple(sorted(o.seed for o in rows)),
            float(costs.mean()),
            spread,
            mean(lambda o: o.discounted),
            mean(lambda o: o.success),
            mean(lambda o: o.violated),
            mean(lambda o: o.train_s),
            mean(lambda o: o.latency_ms),
            mean(lambda o: o.file_kb),
            mean(self.excess),
            tuple(o.verdict for o in sorted(rows, key=lambda o: o.seed) if o.verdict),
        )


def report(outcomes: Sequence[Outcome]) -> str:
    """The page in Markdown.

    Args:
        outcomes: Lines of the results, all from the same number of starts.
    """
    results = Results(outcomes)
    starts = ", ".join(map(str, sorted({o.starts for o in outcomes})))
    steps = ", ".join(f"{n:,}" for n in sorted({o.steps for o in results.done if o.steps})) or "no"
    shown = [name for name in ALGORITHMS if any(o.algorithm == name for o in results.done)]
    lines = [
        "# The field",
        "",
        "`scripts/bench_field`: offline learners of another package, plain MPCs and this package, each from the same"
        f" logs, in closed loop on the true plant from the same {starts} starts. J is the undiscounted cost of an"
        " episode, Jd the discounted one, as each plant defines them; lower is better. +- is a standard error: over the"
        " seeds, or over the starts where there is one seed. Every figure is a line of [field.csv](field.csv); what was"
        " not run is left blank.",
        "",
        *_picture(),
        "## At a glance",
        "",
        *_glance(results, shown),
        *_losses(results),
        *_tables(results, shown),
        *_solving(results),
        SETTINGS.format(steps=steps).rstrip("\n"),
        "",
        "## What was run",
        "",
        *_extent(results, outcomes, shown),
    ]
    return "\n".join(lines).rstrip("\n") + "\n"


def _picture() -> list[str]:
    alt = "Cost of an episode over that of the MPC with the true model, against the transitions of the log, by plant"
    lines = []
    for tone in ("light", "dark"):
        lines += [f"```{{image}} field_{tone}.png", f":class: only-{tone}", f":alt: {alt}", ":width: 100%", "```", ""]
    return [*lines, "*Lines: means over seeds; dots: seeds. A triangle at the edge lies beyond it.*", ""]


def _glance(results: Results, shown: Sequence[str]) -> list[str]:
    """Cost over that of the MPC with the true model, at the size of log that has most."""
    sizes = [o.size for o in results.done if o.size]
    if not sizes:
        return []
    size = max(sorted(set(sizes)), key=sizes.count)
    rows = []
    for name in shown:
        cells = [results.cell(arena, name, size) for arena in results.arenas]
        rows.append([ALGORITHMS[name].label, *("" if c is None else _figure(c.excess, 3) for c in cells)])
    lines = [
        f"Cost of an episode over that of the MPC with the true model, from {size:,} transitions"
        " (1 + (J - J_true) / |J_true|; 1 is as good, less is better):",
        "",
        Table(["controller", *results.arenas], rows, align="lr").markdown(),
        "",
    ]
    return lines


def _losses(results: Results) -> list[str]:
    """Where something else that learns from the log is better than ours, seeds that both have."""
    lines, compared = [], 0
    for arena in results.arenas:
        for size in results.sizes(arena):
            ours = results.cell(arena, OURS, size)
            if ours is None:
                continue
            better = []
            for name, algorithm in ALGORITHMS.items():
                other = results.cell(arena, name, size, ours.seeds)
                if name == OURS or other is None or not algorithm.needs_log:
                    continue
                own = results.cell(arena, OURS, size, other.seeds)
                if own is not None and own.cost > other.cost + MARGIN * abs(other.cost):
                    better.append((other.cost, f"{algorithm.label} ({other.cost:.5g} against {own.cost:.5g})"))
            compared += 1
            if better:
                lines.append(f"* {arena}, {size:,} transitions: {'; '.join(text for _, text in sorted(better))}")
    head = f"Of {compared} logs, those where something else that learned from the log costs less than"
    head += f" {ALGORITHMS[OURS].label}, by more than {MARGIN:.0%}:"
    none = [] if lines else ["* none"]
    return ["## What we lose", "", head, "", *lines, *none, ""] if compared else []


_HEADER = ["log", "controller", "J", "Jd", "ends well", "steps over a limit", "training (s)", "action (ms)"]
_HEADER += ["file (kB)", "verdict", "seeds"]


def _tables(results: Results, shown: Sequence[str]) -> list[str]:
    lines = ["## Plant by plant", ""]
    for arena in results.arenas:
        rows = [_row("", name, results.cell(arena, name, 0)) for name in shown if not ALGORITHMS[name].needs_log]
        for size in results.sizes(arena):
            learned = [name for name in shown if ALGORITHMS[name].needs_log]
            rows += [_row(f"{size:,}", name, results.cell(arena, name, size)) for name in learned]
        lines += [f"### {arena}", "", Table(_HEADER, rows, align="llrrrrrrrlr").markdown(), ""]
    return lines


def _solving(results: Results) -> list[str]:
    """What learning costs where MPCs are solved for it, beside ours on the same logs."""
    rows = []
    for o in sorted(results.timed, key=lambda o: (results.place(o.arena), o.size, o.seed)):
        ours = results.one(o.arena, OURS, o.size, o.seed)
        each_ms, share = f"{1e3 * o.train_s / o.rows:.3g}", o.said.removeprefix("from ")
        times = [] if ours is None else [ours.pass_s, ours.regressions_s, ours.train_s + ours.verdict_s]
        compared = [
            f"{_figure(time, 3)} ({float(f'{o.train_s / time:.2g}'):,.10g} x)" if time > 0.0 else "" for time in times
        ]
        compared += [""] * (3 - len(compared))
        rows.append([o.arena, f"{o.rows:,}", str(o.seed), each_ms, share, _figure(o.train_s, 3), *compared])
    if not rows:
        return []
    header = ["log", "transitions", "seed", "mpcrl: ms a transition", "timed on", "one pass over the log (s)"]
    header += ["ours: one pass (s)", "all regressions of `default` (s)", "with choice and verdict (s)"]
    return [
        "## Where learning solves MPCs: mpcrl",
        "",
        "mpcrl 1.4.1 learns the same MPC's theta by LSTD-Q: for each transition it solves Q(s, a) and V(s+) by ipopt"
        " and differentiates Q. Its time was measured on the first transitions of a log and is scaled to one pass over"
        " it; how many passes it needs, and what it then costs in closed loop, was not. In brackets: how many times as"
        " long one pass of mpcrl takes. One pass of ours is (FIT)'s error of each transition, and its gradient in"
        " theta. Times are of one core.",
        "",
        Table(header, rows, align="lrrr").markdown(),
        "",
    ]


def _row(size: str, name: str, cell: Cell | None) -> list[str]:
    label = ALGORITHMS[name].label
    if cell is None:
        return [size, label, *[""] * (len(_HEADER) - 2)]
    shares = ["" if np.isnan(share) else f"{share:.0%}" for share in (cell.success, cell.violated)]
    verdict = "; ".join(f"{cell.verdicts.count(each)} {each}" for each in dict.fromkeys(cell.verdicts))
    return [
        size,
        label,
        f"{cell.cost:.5g} +- {cell.error:.2g}",
        _figure(cell.discounted, 4),
        *shares,
        _figure(cell.train_s, 3),
        _figure(cell.latency_ms, 2),
        _figure(cell.file_kb, 3),
        verdict if len(cell.verdicts) != 1 else cell.verdicts[0],
        str(len(cell.seeds)),
    ]


def _figure(value: float, digits: int) -> str:
    return "" if np.isnan(value) else f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"


def _extent(results: Results, outcomes: Sequence[Outcome], shown: Sequence[str]) -> list[str]:
    """Which seeds of which log each controller was run on, and what failed."""
    columns = [(arena, size) for arena in results.arenas for size in results.sizes(arena)]
    rows = []
    for name in shown:
        if not ALGORITHMS[name].needs_log:
            continue
        cells = (results.cell(arena, name, size) for arena, size in columns)
        rows.append([ALGORITHMS[name].label, *("" if c is None else ", ".join(map(str, c.seeds)) for c in cells)])
    header = ["seeds run", *(f"{arena}, {size:,}" for arena, size in columns)]
    failed = [f"* Failed: {o.arena}, {o.size:,}, seed {o.seed}, {o.algorithm}: {o.error}" for o in outcomes if o.error]
    absent = [ALGORITHMS[name].label for name in ALGORITHMS if name not in shown and name != "mpcrl"]
    rest = [f"* Not run on any log: {', '.join(absent)}"] if absent else []
    logs = [o for o in results.done if o.algorithm == "behaviour" and o.said]
    said = [f"* The log's controller of {o.arena}: {o.said}" for o in logs]
    return [Table(header, rows, align="l").markdown(), "", *rest, *dict.fromkeys(said), *failed]
