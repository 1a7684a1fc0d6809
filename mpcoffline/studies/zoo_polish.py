"""What polishing is worth: regressions, choice and search over the weights, on the models and on the true plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.errors import InvalidDataError
from mpcoffline.core.tables import Table
from mpcoffline.core.types import Array
from mpcoffline.learner.candidates import FULL
from mpcoffline.learner.learner import Learn, OfflineMPCLearner

from .plant_files import PlantFile
from .zoo import NAN, Case, Found, heard, noted, paired, short_text

SUFFIX = ", polished"


@dataclass(frozen=True)
class Outcome:
    """What came of a case; a line of the results. Costs are means over the starts, NaN where there is none.

    Attributes:
        plant: Name of the plant.
        seed: The seed.
        starts: Number of episodes of each controller, from the same starts.
        mpc_1: Cost of the rough MPC.
        yardstick: Cost of the best MPC that the plant file knows.
        full: Cost of the whole fit.
        chosen: Cost of the best candidate, which is polished.
        polished: Cost of the polished one; that of the best candidate where it was refused.
        gain: chosen - polished, mean of the differences, start by start.
        gain_error: Its standard error.
        candidate: Name of the best candidate.
        taken: 1 if the polished one was taken, else 0.
        why: What the search said.
        learning_s: Time of the regressions in s of one core.
        choice_s: That of the choice.
        polish_s: That of the search.
        learning_gain: MPC_1 - full, on the models.
        choice_gain: full - chosen, on the models.
        polish_gain: chosen - polished, on the models.
        error: What went wrong; such a case is tried again.
    """

    plant: str
    seed: int
    starts: int
    mpc_1: float = NAN
    yardstick: float = NAN
    full: float = NAN
    chosen: float = NAN
    polished: float = NAN
    gain: float = NAN
    gain_error: float = NAN
    candidate: str = ""
    taken: float = NAN
    why: str = ""
    learning_s: float = NAN
    choice_s: float = NAN
    polish_s: float = NAN
    learning_gain: float = NAN
    choice_gain: float = NAN
    polish_gain: float = NAN
    error: str = ""

    @property
    def key(self) -> tuple[str, int, int]:
        """That of its case."""
        return self.plant, self.seed, self.starts

    def __str__(self) -> str:
        """In short."""
        return self.error or (
            f"MPC_1 {self.mpc_1:.5g}, {self.candidate} {self.chosen:.5g}, polished {self.polished:.5g}"
            f" ({-self.gain:+.3g} +- {self.gain_error:.2g}), {self.polish_s:.0f} s: {self.why}"
        )


def run_case(case: Case, tell: Callable[[str], None] = lambda what: None) -> Outcome:
    """Logs, learns and polishes with the default preset, and lets all act on the plant; errors become part of it.

    Args:
        case: The case.
        tell: Is told what is being done.
    """
    found: Found = {}
    noted(found, lambda: _fill(found, case, tell))
    return Outcome(case.plant, case.seed, case.n_starts, **found)


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
    if truth is not None:
        cost("yardstick", MPCPolicy(truth))
    tell(f"fit of {len(log)} transitions, polished")
    learn: Learn = getattr(plant.module, "LEARN", "cost+model")
    said: list[str] = []
    learner = OfflineMPCLearner(nominal, learn=learn, seed=seed, polish=True)
    with heard(said, "INFO"):
        learner.fit(log, show_progress=False)
    candidates = learner.candidates
    if candidates is None or candidates.effort is None:
        raise InvalidDataError(case.plant, expected="several candidates", actual="one")
    found["why"] = short_text("; ".join(each for each in said if "polished: " in each))
    parts = candidates.effort.shares
    for name, part in zip(("learning", "choice", "polish"), parts, strict=True):
        found[f"{name}_s"], found[f"{name}_gain"] = part.seconds, part.gain
    best = candidates.chosen.removesuffix(SUFFIX)
    found["candidate"], found["taken"] = best, float(best != candidates.chosen)
    cost("full", MPCPolicy(candidates[FULL]))
    before = cost("chosen", MPCPolicy(candidates[best]))
    after = cost("polished", learner.policy) if found["taken"] else before
    found["polished"] = float(after.mean())
    found["gain"], found["gain_error"] = paired(before, after)


def report(outcomes: Sequence[Outcome]) -> str:
    """A page in Markdown: the counts, then a line a case."""
    rows = sorted(outcomes, key=lambda o: o.key)
    done = [o for o in rows if not o.error]
    taken = [o for o in done if o.taken]
    clear = [[o for o in taken if sign * o.gain > 2.0 * o.gain_error] for sign in (1.0, -1.0)]
    lines = [
        "# Polishing: weights by closed loops on models of the log",
        "",
        f"`scripts/bench_zoo --polish`: {len(done)} cases, each a plant file and a seed. Gains are of an episode's"
        " cost, on models of the log and on the plant, from starts that the log does not hold; times in s of one core.",
        "",
        f"* Taken: **{len(taken)} of {len(done)}**; of these better on the plant beyond two standard errors:"
        f" **{len(clear[0])}**, worse: **{len(clear[1])}**",
    ]
    if done:
        gains = [100.0 * o.gain / abs(o.chosen) for o in done]
        lines += [
            f"* Gain on the plant over the best candidate: {min(gains):.2g} % to {max(gains):.2g} % (median"
            f" {np.median(gains):.2g} %)",
            "* Gain in each s of one core, in % of MPC_1's cost, median of the cases:"
            f" regressions {_rate(done, 'learning'):.2g}, choice {_rate(done, 'choice'):.2g}, search"
            f" {_rate(done, 'polish'):.2g}",
        ]
    lines += [f"* Failed: {o.plant} {o.seed}: {o.error}" for o in rows if o.error]
    header = ["plant", "seed", "MPC_1", "yardstick", "full", "best candidate", "", "polished", "gain on the plant"]
    header += ["gain on models: regressions", "choice", "search", "s: regressions", "choice", "search", "taken"]
    table = Table(header, [_cells(o) for o in done], align="lrrrrlrrrrrrrrrl")
    return "\n".join([*lines, "", table.markdown(), ""])


def _rate(rows: Sequence[Outcome], part: str) -> float:
    rates = [getattr(o, f"{part}_gain") / getattr(o, f"{part}_s") / abs(o.mpc_1) for o in rows]
    return 100.0 * float(np.median(rates))


def _cells(o: Outcome) -> list[str]:
    costs = ["-" if np.isnan(v) else f"{v:.5g}" for v in (o.mpc_1, o.yardstick, o.full, o.chosen, o.polished)]
    gains = [f"{v:.3g}" for v in (o.learning_gain, o.choice_gain, o.polish_gain)]
    times = [f"{v:.0f}" for v in (o.learning_s, o.choice_s, o.polish_s)]
    taken = "yes" if o.taken else "no"
    plant = f"{o.gain:+.3g} +- {o.gain_error:.2g}"
    return [o.plant, str(o.seed), *costs[:3], o.candidate, *costs[3:], plant, *gains, *times, taken]
