"""Plants that nobody tuned for, from plant files: MPC_1, a yardstick and the learned MPC on the true plant."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.types import Array
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.learner.candidates import FULL
from mpcoffline.learner.effort import core_seconds
from mpcoffline.learner.learner import OfflineMPCLearner

from .plant_files import Loops, PlantFile

if TYPE_CHECKING:
    from mpcoffline.diagnostics import Report

NAN = float("nan")
MARGIN, CLOSE = 0.02, 0.05  # "worse" and "better" by more than this of |MPC_1|; "as good" within this of |yardstick|
_SAID = 300

Found = dict[str, Any]  # figures of a case by the names of its columns


@dataclass(frozen=True)
class Case:
    """One plant file at one seed (of MPC_1's errors, of the log, of learning and of the starts)."""

    path: str
    plant: str
    seed: int
    n_starts: int
    diagnose: bool = False

    @property
    def key(self) -> tuple[str, int, int]:
        """What makes it the same case: plant, seed, number of starts."""
        return self.plant, self.seed, self.n_starts


@dataclass(frozen=True)
class Outcome:
    """What came of a case; a line of the results. Costs are means over the starts; NaN where there is none.

    Attributes:
        plant: Name of the plant.
        seed: The seed.
        starts: Number of episodes of each controller, from the same starts.
        rows: Transitions in the log.
        behaviour: Cost of the controllers that made the log.
        mpc_1: Cost of the rough MPC.
        yardstick: Cost of the best MPC that the plant file knows.
        learned: Cost of the learned MPC.
        gain: learned - MPC_1: mean of the differences, start by start.
        gain_error: Its standard error.
        short: learned - yardstick, likewise.
        short_error: Its standard error.
        ends_behaviour: Share of the episodes that end well.
        ends_mpc_1: The same of MPC_1.
        ends_yardstick: The same of the yardstick.
        ends_learned: The same of the learned MPC.
        over_mpc_1: Share of the steps in which MPC_1 violates a limit; NaN where the plant has none.
        over_yardstick: The same of the yardstick.
        over_learned: The same of the learned MPC.
        more_over: over_learned - over_mpc_1, start by start.
        more_over_error: Its standard error.
        fit_s: Time of the fit in s of one core.
        build_s: Time to build the learned MPC's solver, its compiler included, likewise.
        candidate: What the learner handed out, by name; empty where it had one candidate alone.
        choice_s: Time of the choice, a part of that of the fit.
        over_behaviour: learned - behaviour, likewise: what runs today.
        over_behaviour_error: Its standard error.
        full: Cost of the whole fit, ``candidate="full"``; that of the learned MPC where it was handed out.
        full_gain: full - MPC_1, likewise.
        full_gain_error: Its standard error.
        full_over_behaviour: full - behaviour, likewise.
        said: What the learner said of itself: its warnings.
        verdict: That of ``diagnose`` on the learned MPC, where it was asked.
        reason: Its first reason.
        warned: 1 if it says that the learned MPC is worse, or rather worse, than what runs today; else 0.
        from_log: Cost of the learned MPC from where the episodes of the log began, of which the verdict speaks.
        expected: What it expects an episode of the learned MPC to cost, where it simulates whole ones.
        lowest: The lowest that it expects.
        highest: The highest.
        verdict_s: Time of the verdict in s of one core.
        full_verdict: The verdict on the whole fit.
        full_warned: Likewise.
        error: What went wrong; such a case is tried again.
    """

    plant: str
    seed: int
    starts: int
    rows: int = 0
    behaviour: float = NAN
    mpc_1: float = NAN
    yardstick: float = NAN
    learned: float = NAN
    gain: float = NAN
    gain_error: float = NAN
    short: float = NAN
    short_error: float = NAN
    ends_behaviour: float = NAN
    ends_mpc_1: float = NAN
    ends_yardstick: float = NAN
    ends_learned: float = NAN
    over_mpc_1: float = NAN
    over_yardstick: float = NAN
    over_learned: float = NAN
    more_over: float = NAN
    more_over_error: float = NAN
    fit_s: float = NAN
    build_s: float = NAN
    candidate: str = ""
    choice_s: float = NAN
    over_behaviour: float = NAN
    over_behaviour_error: float = NAN
    full: float = NAN
    full_gain: float = NAN
    full_gain_error: float = NAN
    full_over_behaviour: float = NAN
    said: str = ""
    verdict: str = ""
    reason: str = ""
    warned: float = NAN
    from_log: float = NAN
    expected: float = NAN
    lowest: float = NAN
    highest: float = NAN
    verdict_s: float = NAN
    full_verdict: str = ""
    full_warned: float = NAN
    error: str = ""

    @property
    def key(self) -> tuple[str, int, int]:
        """That of its case."""
        return self.plant, self.seed, self.starts

    def __str__(self) -> str:
        """In short."""
        return self.error or (
            f"MPC_1 {self.mpc_1:.5g}, yardstick {self.yardstick:.5g}, learned {self.learned:.5g}"
            f" ({self.gain:+.3g} +- {self.gain_error:.2g}), fit {self.fit_s:.0f} s"
        )

    @property
    def worse(self) -> bool:
        """Whether the learned MPC costs more than MPC_1, by more than 2 % of its size; so does one without a cost."""
        return not self.gain <= MARGIN * abs(self.mpc_1)

    @property
    def better(self) -> bool:
        """Whether it costs less, by more than 2 %."""
        return self.gain < -MARGIN * abs(self.mpc_1)

    @property
    def close(self) -> bool:
        """Whether it costs at most as much as the yardstick and 5 % of its size."""
        return self.short <= CLOSE * abs(self.yardstick)

    @property
    def full_better(self) -> bool:
        """Whether the whole fit costs less than MPC_1, by more than 2 %."""
        return self.full_gain < -MARGIN * abs(self.mpc_1)

    @property
    def full_worse(self) -> bool:
        """Whether it costs more, by more than 2 %."""
        return self.full_gain > MARGIN * abs(self.mpc_1)

    @property
    def over_today(self) -> bool:
        """Whether the learned MPC costs more than the controllers that made the log, by more than 2 % of their cost."""
        return self.over_behaviour > MARGIN * abs(self.behaviour)

    @property
    def full_over_today(self) -> bool:
        """Whether the whole fit does."""
        return self.full_over_behaviour > MARGIN * abs(self.behaviour)

    @property
    def under_today(self) -> bool:
        """Whether the learned MPC costs less than these, by more than 2 %."""
        return self.over_behaviour < -MARGIN * abs(self.behaviour)

    @property
    def full_under_today(self) -> bool:
        """Whether the whole fit does."""
        return self.full_over_behaviour < -MARGIN * abs(self.behaviour)

    @property
    def violates_more(self) -> bool:
        """Whether the learned MPC violates limits in more steps than MPC_1, beyond two standard errors."""
        return self.more_over > 2.0 * self.more_over_error

    @property
    def room(self) -> bool:
        """Whether the yardstick costs less than MPC_1, by more than 2 %."""
        return self.yardstick < self.mpc_1 - MARGIN * abs(self.mpc_1)


def run_case(case: Case, tell: Callable[[str], None] = lambda what: None) -> Outcome:
    """Logs, learns with the default preset, and lets all controllers act on the plant; an error becomes part of it.

    Args:
        case: The case.
        tell: Is told what is being done.
    """
    found: Found = {}
    noted(found, lambda: _fill(found, case, tell))
    return Outcome(case.plant, case.seed, case.n_starts, **found)


def noted(found: Found, fill: Callable[[], None]) -> None:
    """Fills in the figures of a case; an error becomes one of them, so that no case ends the others."""
    try:
        fill()
    except Exception as error:
        found["error"] = short_text(f"{type(error).__name__}: {error}")


def _fill(found: Found, case: Case, tell: Callable[[str], None]) -> None:
    """The figures of a case, each put down as soon as it is known."""
    tell("log")
    plant = PlantFile.load(Path(case.path))
    table, seed, n = plant.log(case.seed), case.seed, case.n_starts
    found["rows"] = len(table)

    def loops(name: str, controller: MPCPolicy | None) -> Loops:
        tell(f"{n} episodes of {name}")
        done = plant.closed_loops(controller, seed, n)
        column = name.lower()
        found[column], found[f"ends_{column}"] = float(done.cost.mean()), float(done.success.mean())
        if controller is not None:
            found[f"over_{column}"] = float(done.violated.mean())
        return done

    today = loops("behaviour", None)
    nominal = plant.module.mpc(seed)
    first = loops("MPC_1", MPCPolicy(nominal))
    best, truth = None, plant.module.truth()
    if truth is not None:
        best = loops("yardstick", MPCPolicy(truth))
    tell(f"fit of {len(table)} transitions")
    said: list[str] = []
    learned_by: list[float] = []  # until here nothing was chosen
    learner = OfflineMPCLearner(nominal, learn=getattr(plant.module, "LEARN", "cost+model"), seed=seed)
    start = core_seconds()
    with heard(said):
        learner.fit(table, show_progress=False, callbacks=[lambda *_: learned_by.append(core_seconds())])
    found["fit_s"], found["choice_s"] = core_seconds() - start, core_seconds() - max(learned_by, default=start)
    found["said"] = short_text("; ".join(dict.fromkeys(said)))
    tell("build of the solver")
    start = core_seconds()
    _ = learner.policy.solver
    found["build_s"] = core_seconds() - start
    learned = loops("learned", learner.policy)
    found["gain"], found["gain_error"] = paired(learned.cost, first.cost)
    found["more_over"], found["more_over_error"] = paired(learned.violated, first.violated)
    found["over_behaviour"], found["over_behaviour_error"] = paired(learned.cost, today.cost)
    if best is not None:
        found["short"], found["short_error"] = paired(learned.cost, best.cost)
    found["candidate"] = "" if learner.candidates is None else learner.candidates.chosen
    whole = taking(learner, FULL)
    full = learned
    if whole is not learner:
        tell(f"{n} episodes of the whole fit")
        full = plant.closed_loops(whole.policy, seed, n)
    found["full"] = float(full.cost.mean())
    found["full_gain"], found["full_gain_error"] = paired(full.cost, first.cost)
    found["full_over_behaviour"], _ = paired(full.cost, today.cost)
    if case.diagnose:
        tell("verdict")
        found["from_log"] = float(plant.closed_loops(learner.policy, seed, n, logged=True).cost.mean())
        _judge(found, learner, whole, table, seed, plant.module.STEPS)


def _judge(
    found: Found,
    learner: OfflineMPCLearner,
    whole: OfflineMPCLearner,
    table: TransitionTable,
    seed: int,
    n_steps: int,
) -> None:
    """What ``diagnose`` says of what was handed out, and of the whole fit."""
    from mpcoffline.diagnostics import diagnose

    start = core_seconds()
    report = diagnose(learner, table, seed=seed)
    found["verdict_s"] = core_seconds() - start
    found["verdict"], found["reason"] = report.verdict, short_text(report.reasons[0] if report.reasons else "")
    if report.trials.n_steps == n_steps:
        found["lowest"], found["expected"], found["highest"] = report.judgement.expected
    found["warned"] = _warned(report)
    other = report if whole is learner else diagnose(whole, table, seed=seed)
    found["full_verdict"], found["full_warned"] = other.verdict, _warned(other)


def _warned(report: Report) -> float:
    today = report.judgement.today
    return float(today.known and (today.worse or today.dearer))


def taking(learner: OfflineMPCLearner, name: str) -> OfflineMPCLearner:
    """The learner as if it had been asked for a candidate by name; itself where it has handed that out."""
    if learner.candidates is None or learner.candidates.chosen == name:
        return learner
    other = copy(learner)
    other.candidate, other.candidates = name, None
    other._mpc, other._policy = learner.candidates[name], None
    return other


def paired(costs: Array, others: Array) -> tuple[float, float]:
    """Mean of the differences of costs ``(n,)`` from the same starts, and its standard error (NaN for one start)."""
    difference = costs - others
    n = len(difference)
    return float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(n)) if n > 1 else NAN


@contextmanager
def heard(said: list[str], level: str = "WARNING") -> Iterator[None]:
    """Collects warnings, and what the package logs from a level on."""

    class Ear(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(record.getMessage())

    ear, logger = Ear(level), logging.getLogger("mpcoffline")
    logger.addHandler(ear)
    before = logger.level
    if logger.getEffectiveLevel() > ear.level:
        logger.setLevel(ear.level)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
        said += [str(each.message) for each in caught if not issubclass(each.category, DeprecationWarning)]
    finally:
        logger.removeHandler(ear)
        logger.setLevel(before)


def short_text(text: str) -> str:
    """Text on one line, cut."""
    line = " ".join(text.split())
    return line if len(line) <= _SAID else line[: _SAID - 3] + "..."
