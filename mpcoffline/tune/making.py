"""From transitions to a folder with a controller, its verdict and its C code: what ``tune`` and ``retune`` share."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mpcoffline.control.export import export_c
from mpcoffline.control.loading import Acting
from mpcoffline.control.output_feedback import OutputFeedbackPolicy
from mpcoffline.control.policy import MPCPolicy
from mpcoffline.core.errors import InvalidArgumentError
from mpcoffline.core.outputs import write_file
from mpcoffline.core.text import figure
from mpcoffline.datasets.table.files import hash_of, save_table
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.diagnostics import diagnose
from mpcoffline.diagnostics.page import Section
from mpcoffline.diagnostics.report import Report
from mpcoffline.diagnostics.trial import stretched
from mpcoffline.estimation import OutputIdentification
from mpcoffline.learner.learner import OfflineMPCLearner
from mpcoffline.mpc import MPC
from mpcoffline.simulation.choice import FIRST
from mpcoffline.solvers.ddp.build import CompilerError

from .folder import CHECKPOINT, CODE, LEARNER, LOG, PAGE, PLANT, POLICY, Workplace, versions

KEEP = "keep MPC_1"
RUNNING = "running"  # the controller of a trial, among the candidates

#: Is told what is done now.
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Order:
    """What is to be made.

    Attributes:
        plant: Name of the plant.
        reader: What reads its logs, as JSON.
        mpc: MPC_1.
        table: All transitions that are learned from, of states.
        options: Of the learner: ``preset``, ``learn``, ``polish``, ``seed``.
        also: Further controllers that are tried beside what is learned, by name.
        sections: Further parts of the page.
        today: How many episodes, the first ones, were made by the controller that runs today; all by default.
        doubt: Why nothing may be recommended whatever the models say; empty where nothing speaks against it.
        start: What was learned before, where identification begins, too.
        widened: How many times as wide as models alone say the band of the proposal's cost is, since trials lay outside
            theirs.
        outputs: Where the log holds outputs, what was found in them; the table is its.
    """

    plant: str
    reader: Mapping[str, Any]
    mpc: MPC
    table: TransitionTable
    options: Mapping[str, Any]
    also: Mapping[str, MPC] = field(default_factory=dict)
    sections: Sequence[Section] = ()
    today: int | None = None
    doubt: str = ""
    start: MPC | None = None
    widened: float = 1.0
    outputs: OutputIdentification | None = None


def made(order: Order, place: Workplace, tell: Tell, *, show_progress: bool) -> dict[str, Any]:
    """Fits, judges and writes, each once: what the workplace holds already stays.

    Args:
        order: What is to be made.
        place: Where.
        tell: Is told what is done now.
        show_progress: Whether the fit draws a progress bar.

    Returns:
        What ``run.json`` says of it.

    Raises:
        InvalidDataError: If log and description contradict each other.
        StorageError: If something cannot be written.
    """
    path = place.path
    write_file(path / PLANT, json.dumps(dict(order.reader)))
    if not (path / LOG).is_file():
        save_table(order.table, path / LOG)
    learner = _learner(order, path, tell, show_progress)

    def judged() -> dict[str, Any]:
        tell("Judging: closed loops on models of the log")
        report = diagnose(learner, order.table, seed=order.options["seed"], today=order.today)
        if order.doubt and report.verdict != KEEP:
            judgement, reasons = report.judgement, (order.doubt, *report.reasons)
            report = replace(report, judgement=replace(judgement, verdict="try with care", reasons=reasons))
        report = _calibrated(report, order.widened)
        report.html(path / PAGE, title=order.plant, sections=order.sections)
        return _judgement(report, learner)

    judgement = place.once("judgement", judged)

    def written() -> dict[str, Any]:
        kept = judgement["verdict"] == KEEP
        acting = MPCPolicy(order.mpc) if kept else learner.policy
        policy: Acting = acting
        if learner.sensors is not None:
            observer = learner.sensors.suited(acting.mpc, order.table).observer(acting.mpc)
            policy = OutputFeedbackPolicy(acting, observer)
        policy.save(path / POLICY)
        tell("Writing the controller as C99")
        try:
            export_c(policy, path / CODE)
        except (CompilerError, InvalidArgumentError) as error:
            return {"controller": None, "why_no_controller": str(error)}
        return {"controller": CODE}

    files = place.once("files", written)
    return {
        "plant": order.plant,
        **judgement,
        **files,
        "options": dict(order.options),
        "rows": len(order.table),
        "episodes": order.table.n_episodes,
        "sha256": {"log": hash_of(order.table)},
        "versions": versions(),
    }


def _calibrated(report: Report, widened: float) -> Report:
    """The report with the band that trials before have shown to be right."""
    judgement = report.judgement
    low, middle, high = expected = stretched(judgement.expected, widened, report.trials.floor)
    if widened == 1.0 or not np.isfinite(expected).all():
        return report
    said = (
        f"Trials so far lay as far from what was predicted that the band of the proposal is {widened:.2g} times as wide"
        f" as models alone say: expect {figure(middle, 4)} an episode, {figure(low, 4)} to {figure(high, 4)}."
    )
    return replace(report, judgement=replace(judgement, expected=expected, reasons=(*judgement.reasons, said)))


def _learner(order: Order, path: Path, tell: Tell, show_progress: bool) -> OfflineMPCLearner:
    """The fitted learner: the one that is there, or a new one."""
    file = path / LEARNER
    if file.is_file():
        return OfflineMPCLearner.load(file)
    checkpoint = path / CHECKPOINT
    tell("Fitting" + (", from where it was interrupted" if checkpoint.is_file() else ""))
    learner = OfflineMPCLearner(order.mpc, **order.options)
    data = order.table if order.outputs is None else order.outputs
    learner.fit(data, checkpoint=checkpoint, show_progress=show_progress, also=order.also, start=order.start)
    learner.save(file)
    return learner


def _judgement(report: Report, learner: OfflineMPCLearner) -> dict[str, Any]:
    """What ``run.json`` says of a verdict."""
    whole, kept, ends = json.loads(report.to_json()), report.verdict == KEEP, ("lowest", "expected", "highest")
    return {
        "verdict": report.verdict,
        "reasons": list(report.reasons),
        "notes": list(report.notes),
        "findings": list(learner.findings),
        "proposal": report.judgement.proposal,
        "policy": FIRST if kept else report.judgement.proposal,
        "episode_steps": report.trials.n_steps,
        "costs": {name: dict(zip(ends, cost, strict=True)) for name, cost in whole["costs"].items()},
    }


def check_options(options: Mapping[str, Any], mpc: MPC) -> dict[str, Any]:
    """Refuses what no learner takes, or no file can hold, before anything is read or written.

    Returns:
        The options, in the order of their names.

    Raises:
        InvalidArgumentError: For an option that is none.
        UnknownIdError: For the name of something that there is none of.
    """
    for name, value in options.items():
        if not isinstance(value, bool | int | float | str):
            raise InvalidArgumentError(name, expected="a number or a text", actual=repr(value)[:200])
    OfflineMPCLearner(mpc, **options)
    return dict(sorted(options.items()))
