"""What a trial is worth: some episodes of the proposal on the true plant join the log, and all is learned again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.tables import Table
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.diagnostics.trial import compared
from mpcoffline.learner.candidates import FULL
from mpcoffline.learner.effort import core_seconds
from mpcoffline.learner.learner import Learn, OfflineMPCLearner

from .plant_files import PlantFile
from .zoo import CLOSE, MARGIN, NAN, Found, noted, paired

RUNNING = "running"


@dataclass(frozen=True)
class Case:
    """One plant file at one seed, and how many episodes a trial has."""

    path: str
    plant: str
    seed: int
    n_starts: int
    n_episodes: int = 5

    @property
    def key(self) -> tuple[str, int, int, int]:
        """What makes it the same case: plant, seed, number of starts, of episodes."""
        return self.plant, self.seed, self.n_starts, self.n_episodes


@dataclass(frozen=True)
class Outcome:
    """What came of a trial; a line of the results. Costs are means over the starts, NaN where there is none.

    Attributes:
        plant: Name of the plant.
        seed: The seed.
        starts: Number of episodes of each controller, from the same starts.
        episodes: Of the trial.
        mpc_1: Cost of the rough MPC.
        yardstick: Cost of the best MPC that the plant file knows.
        before: Cost of what was learned from the log.
        after: Cost of what was learned from log and trial.
        short_before: before - yardstick, mean of the differences, start by start.
        short_after: after - yardstick, likewise.
        change: after - before, likewise.
        change_error: Its standard error.
        handed_before: Which candidate was handed out after the log.
        handed_after: The same after the trial; ``running`` is that one again.
        steps: Length of the stretches of the trial that were compared with what was predicted for them.
        seen: What these cost.
        lowest: The lowest cost that was predicted.
        predicted: The middle.
        highest: The highest.
        fit_s: Time of the first fit in s of one core.
        again_s: Time of the second, likewise.
        error: What went wrong; such a case is tried again.
    """

    plant: str
    seed: int
    starts: int
    episodes: int
    mpc_1: float = NAN
    yardstick: float = NAN
    before: float = NAN
    after: float = NAN
    short_before: float = NAN
    short_after: float = NAN
    change: float = NAN
    change_error: float = NAN
    handed_before: str = ""
    handed_after: str = ""
    steps: int = 0
    seen: float = NAN
    lowest: float = NAN
    predicted: float = NAN
    highest: float = NAN
    fit_s: float = NAN
    again_s: float = NAN
    error: str = ""

    @property
    def key(self) -> tuple[str, int, int, int]:
        """That of its case."""
        return self.plant, self.seed, self.starts, self.episodes

    @property
    def far(self) -> bool:
        """Whether what was learned from the log costs more than the yardstick by more than 5 % of its size."""
        return self.short_before > CLOSE * abs(self.yardstick)

    @property
    def closed(self) -> float:
        """The share of the distance to the yardstick that the trial has closed; negative where it has grown."""
        return 1.0 - self.short_after / self.short_before if self.short_before else NAN

    @property
    def worse(self) -> bool:
        """Whether it has become dearer, by more than 2 % of the cost before."""
        return not self.change <= MARGIN * abs(self.before)

    @property
    def inside(self) -> bool:
        """Whether the trial cost what was predicted for it, within the band."""
        return self.lowest <= self.seen <= self.highest

    def __str__(self) -> str:
        """In short."""
        return self.error or (
            f"yardstick {self.yardstick:.5g}, before {self.before:.5g}, after {self.after:.5g}"
            f" ({self.change:+.3g} +- {self.change_error:.2g}), predicted {self.predicted:.4g}, seen {self.seen:.4g}"
        )


def run_case(case: Case, tell: Callable[[str], None] = lambda what: None) -> Outcome:
    """Logs, learns, tries on the plant, learns again as ``retune`` does; an error becomes part of the outcome.

    Args:
        case: The case.
        tell: Is told what is being done.
    """
    found: Found = {}
    noted(found, lambda: _fill(found, case, tell))
    return Outcome(case.plant, case.seed, case.n_starts, case.n_episodes, **found)


def _fill(found: Found, case: Case, tell: Callable[[str], None]) -> None:
    """The figures of a case, each put down as soon as it is known."""
    tell("log")
    plant = PlantFile.load(Path(case.path))
    log, seed = plant.log(case.seed), case.seed

    def cost(name: str, policy: MPCPolicy) -> Array:
        tell(f"{case.n_starts} episodes of {name}")
        costs = plant.closed_loops(policy, seed, case.n_starts).cost
        found[name] = float(costs.mean())
        return np.asarray(costs)

    nominal, truth = plant.module.mpc(seed), plant.module.truth()
    cost("mpc_1", MPCPolicy(nominal))
    best = None if truth is None else cost("yardstick", MPCPolicy(truth))
    learn: Learn = getattr(plant.module, "LEARN", "cost+model")
    learner, again = (OfflineMPCLearner(nominal, learn=learn, seed=seed) for _ in range(2))
    tell(f"fit of {len(log)} transitions")
    begun = core_seconds()
    learner.fit(log, show_progress=False)
    found["fit_s"], found["handed_before"] = core_seconds() - begun, _handed(learner)
    before = cost("before", learner.policy)
    tell(f"a trial of {case.n_episodes} episodes")
    trial = plant.trial(learner.policy, seed, case.n_episodes)
    calibration = compared(learner, learner.mpc, log, trial, seed=seed)
    found["lowest"], found["predicted"], found["highest"] = calibration.band
    found["seen"], found["steps"] = calibration.seen, calibration.steps
    both = TransitionTable.concat([log, trial])
    tell(f"fit of {len(both)} transitions")
    begun = core_seconds()
    again.fit(both, show_progress=False, also={RUNNING: learner.mpc}, start=learner.mpc)
    found["again_s"], found["handed_after"] = core_seconds() - begun, _handed(again)
    after = cost("after", again.policy)
    found["change"], found["change_error"] = paired(after, before)
    if best is not None:
        found["short_before"], found["short_after"] = float((before - best).mean()), float((after - best).mean())


def _handed(learner: OfflineMPCLearner) -> str:
    return FULL if learner.candidates is None else learner.candidates.chosen


def report(outcomes: Sequence[Outcome]) -> str:
    """A page in Markdown: the counts, then a line a case."""
    rows = sorted(outcomes, key=lambda o: o.key)
    done = [o for o in rows if not o.error]
    far = [o for o in done if o.far]
    episodes, starts = _listed([o.episodes for o in rows]), _listed([o.starts for o in rows])
    known = [o for o in done if np.isfinite(o.predicted)]
    lines = [
        "# A trial, and what it is worth",
        "",
        f"`scripts/bench_zoo --trial`: {len(done)} cases, each a plant file and a seed. What was learned from the log"
        f" acts in {episodes} episodes on the plant, these join the log, and all is learned again, as by"
        " `mpcoffline retune`: the controller of the trial is one of the candidates, and identification begins at its"
        f" model, too. Costs are means over {starts} starts that neither log nor trial hold.",
        "",
    ]
    if far:
        lines += [
            f"* More than 5 % from the yardstick before the trial: {len(far)} of {len(done)}; of their distance the"
            f" trial closed **{np.median([o.closed for o in far]):.0%}** in the median"
        ]
    worse = [o for o in done if o.worse]
    names = f" ({'; '.join(f'{o.plant} {o.seed}' for o in worse)})" if worse else ""
    lines += [f"* Dearer than before by more than 2 %: **{len(worse)} of {len(done)}**{names}"]
    if known:
        off = [abs(o.seen - o.predicted) / abs(o.seen) for o in known]
        lines += [
            f"* The trial cost what was predicted for it, within the band: **{sum(o.inside for o in known)} of"
            f" {len(known)}**; the middle was off by {np.median(off):.1%} in the median"
        ]
    lines += [f"* Failed: {o.plant} {o.seed}: {o.error}" for o in rows if o.error]
    header = ["plant", "seed", "MPC_1", "yardstick", "before", "after", "after - before", "distance closed"]
    header += ["handed out before", "after", "trial: predicted", "seen", "fits (s)"]
    cells = [_cells(o) for o in done]
    return "\n".join([*lines, "", Table(header, cells, align="lrrrrrrrll" + "r" * 3).markdown(), ""])


def _cells(o: Outcome) -> list[str]:
    costs = ["-" if np.isnan(v) else f"{v:.5g}" for v in (o.mpc_1, o.yardstick, o.before, o.after)]
    closed = f"{o.closed:.0%}" if o.far else "-"
    band = f"{o.predicted:.4g} ({o.lowest:.4g} to {o.highest:.4g})" if np.isfinite(o.predicted) else "-"
    change = f"{o.change:+.3g} +- {o.change_error:.2g}"
    rest = [o.handed_before, o.handed_after, band, f"{o.seen:.4g}", f"{o.fit_s:.0f}, {o.again_s:.0f}"]
    return [o.plant, str(o.seed), *costs, change, closed, *rest]


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, sorted(set(numbers)))) or "no"
