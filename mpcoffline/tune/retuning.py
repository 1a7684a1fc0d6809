"""``retune``: learns from a trial, too, and says whether it went as predicted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from mpcoffline.control.serving.decisions import DECIDED, DECIDED_BY
from mpcoffline.core.archive import file_errors
from mpcoffline.core.documents import read_json
from mpcoffline.datasets.logs.collecting import Options
from mpcoffline.datasets.logs.reading import LoggedTable, read_log
from mpcoffline.datasets.logs.sources import opened
from mpcoffline.datasets.logs.wanted import Wanted
from mpcoffline.datasets.table.files import hash_of, load_table, save_table
from mpcoffline.datasets.table.transitions import TransitionTable
from mpcoffline.diagnostics.page import Section
from mpcoffline.diagnostics.trial import Band, Calibration, compared, widening
from mpcoffline.mpc import MPC
from mpcoffline.plants.outputs import OutputReader
from mpcoffline.simulation.choice import FIRST

from .folder import HIDDEN, OUTPUTS, PLANT, RUN, Workplace, identity_of, read_run
from .making import RUNNING, Order, Tell, made
from .tuned import Tuned, item

_DOUBT = (
    "The last trial lay far outside what was predicted for it: models of both logs together describe neither surely."
    " Nothing is recommended before a trial has gone as predicted."
)


@dataclass(frozen=True)
class Retuned:
    """What a trial has changed.

    Attributes:
        tuned: What the folder holds now.
        calibration: Predicted and seen cost of the trial; None where the folder held it already.
    """

    tuned: Tuned
    calibration: Calibration | None

    def __str__(self) -> str:
        """The trial, then the new verdict."""
        return "\n".join([*trial_lines(self.tuned.document), "", str(self.tuned)])


def retune(
    folder: str | PathLike[str],
    trial: Any,
    *,
    read: Mapping[str, Any] | None = None,
    tell: Tell | None = None,
    show_progress: bool = True,
) -> Retuned:
    """Compares a trial with what was predicted for it, and learns from both logs.

    The plant file is not run again: what reads logs and what a step costs stands in the folder. The controller of the
    trial is a candidate beside what is learned now, so that it is handed out again where nothing is better; and
    identification begins at the model that was learned before, too. The folder
    is replaced as a whole; what it held is kept in a numbered folder inside. A trial that it has learned from already
    changes nothing.

    Example:
        >>> after = retune("tuned", "trial.csv")
        >>> print(after)
        >>> after.calibration.inside

    Args:
        folder: What :func:`tune` made.
        trial: The log of the trial: a file, a frame, or several.
        read: How it is read, as :meth:`mpcoffline.Plant.read` takes it; a log with the header of the first one is read
            as that was, any other by the plant's names. Of a log of ``mpcoffline serve``, rows are left out in which
            the policy took over or a fall-back acted, unless ``where`` says otherwise.
        tell: Is told, in a sentence, what is done now.
        show_progress: Whether the fit draws a progress bar.

    Raises:
        FileFormatError: If the folder is none of ``tune``, or damaged.
        InvalidDataError: If the trial cannot be understood, or contradicts the description.
    """
    tell = tell or (lambda _: None)
    before = Tuned.load(folder)
    learner = before.learner
    reader, name, hidden = _reader(before, learner.nominal_mpc)
    table = read_log(trial, reader, _options(before, trial, read))
    tell(f"{len(table):,} control intervals of {reader.dt:g} s, {table.n_episodes} without a gap")
    sha, (options, expected, today, history) = hash_of(table), _of_before(before)
    if sha in [each["sha256"] for each in history]:
        tell("This trial has been learned from already")
        return Retuned(Tuned(before.folder, before.document, again=True), None)
    place = Workplace(before.folder, identity_of(before=before.document["identity"], trial=sha))
    if place.begin():
        tell(f"Going on with {place.path}")
    log, running, outputs = before.table, before.mpc, None
    seen: TransitionTable = table
    today, before_widened = log.n_episodes if today is None else today, _widened(history)
    if hidden is not None:
        tell("Finding model and states in the outputs of both logs")
        measured = load_table(before.folder / OUTPUTS)
        every = TransitionTable.concat([measured, table])
        save_table(every, place.path / OUTPUTS)
        outputs = hidden.identify(learner.nominal_mpc, every, options["seed"])
        tell(f"  {outputs}")
        first = int(every.episode_ids[len(measured)])
        seen = outputs.table.take(np.flatnonzero(np.asarray(outputs.table.episode_ids) >= first))

    def tried() -> dict[str, Any]:
        tell("Comparing the trial with what was predicted")
        how = {"expected": expected, "today": today, "seed": options["seed"], "widened": before_widened}
        return compared(learner, running, log, seen, **how).to_json()

    calibration = Calibration.from_json(place.once("trial", tried))
    history.append({"sha256": sha, "rows": len(table), "controller": before.document["policy"]} | calibration.to_json())
    both = TransitionTable.concat([log, table]) if outputs is None else outputs.table
    also = {} if before.document["policy"] == FIRST else {RUNNING: running}
    sections = [_section(calibration, history), _read_section(table)]
    reader_json, doubt = _reader_json(before), _DOUBT if calibration.far else ""
    how = also, sections, today, doubt, learner.mpc, _widened(history)
    order = Order(name, reader_json, learner.nominal_mpc, both, options, *how, outputs=outputs)
    document = made(order, place, tell, show_progress=show_progress)
    kept = {key: before.document[key] for key in ("check", "read") if key in before.document}
    document |= kept | {"trials": history, "today": today}
    former = place.finish(document)
    return Retuned(Tuned(before.folder, read_run(before.folder), former=former), calibration)


def _reader_json(before: Tuned) -> dict[str, Any]:
    """What reads logs, as the folder holds it."""
    return dict(read_json(before.folder / PLANT))


def _reader(before: Tuned, mpc: MPC) -> tuple[Wanted, str, OutputReader | None]:
    """What reads logs, the plant's name, and what finds states in outputs; None where states are measured."""
    with file_errors(before.folder / PLANT):
        data = _reader_json(before)
        hidden = OutputReader.from_json(data[HIDDEN], mpc) if HIDDEN in data else None
        return Wanted.from_json(data), str(data["name"]), hidden


def _options(before: Tuned, trial: Any, read: Mapping[str, Any] | None) -> Options:
    """As the first log was read, where the header is the same; else as is said, or by the plant's names.

    In a log of ``serve``, rows count in which the policy was in charge, or what it had decided last was held.
    """
    given = {name: value for name, value in (read or {}).items() if value}
    first = trial[0] if isinstance(trial, list | tuple) and trial else trial
    with opened(first) as source:
        header = list(source.header)
    stored = before.document.get("read")
    options = Options(**given)
    if not given and stored and header == stored["header"]:
        with file_errors(before.folder / RUN):
            options = Options(**stored["options"])
    if DECIDED_BY in header and not options.where:
        options = replace(options, where={DECIDED_BY: [DECIDED[0], DECIDED[2]]})
    return options


def _of_before(before: Tuned) -> tuple[dict[str, Any], tuple[Band, int], int | None, list[dict[str, Any]]]:
    """Options, expected cost and in how many steps, how many episodes are today's controller's, trials so far.

    Raises:
        FileFormatError: If the folder says something else.
    """
    with file_errors(before.folder / RUN):
        document = before.document
        options, today, history = dict(document["options"]), document.get("today"), list(document.get("trials", []))
        _ = options["seed"], [each["sha256"] for each in history], _widened(history)
        cost = document["costs"].get(document["policy"], {})
        low, middle, high = (
            float("nan") if cost.get(end) is None else float(cost[end]) for end in ("lowest", "expected", "highest")
        )
        steps = int(document["episode_steps"])
        return options, ((low, middle, high), steps), None if today is None else int(today), history


def _section(calibration: Calibration, history: list[dict[str, Any]]) -> Section:
    """The trial on the page."""
    head, *rest = calibration.sentences
    return Section(
        "The trial: predicted and seen", (head,), [*rest, *_record(history)], [calibration.table], early=True
    )


def _read_section(table: LoggedTable) -> Section:
    head, *_ = str(table.report).splitlines()
    tables = [table.report.table] if table.report.left_out else []
    return Section("What was read of the trial", (head,), table.report.notes, tables)


def _widened(history: list[dict[str, Any]]) -> float:
    """How many times as wide as the models alone say the next bands are."""
    return widening((each["off"], float(each.get("widened", 1.0))) for each in history)


def _record(history: list[dict[str, Any]]) -> list[str]:
    """How the predictions have done so far, and what follows for the next ones."""
    told, widened = [each for each in history if each["off"] is not None], _widened(history)
    sentences = []
    if len(told) > 1:
        inside = sum(bool(each["inside"]) for each in told)
        sentences = [f"Of {len(told)} trials so far, {inside} cost what was predicted for them, within the band."]
    if widened > 1.0:
        sentences += [f"The bands below, and of the next trial, are {widened:.2g} times as wide as models alone say."]
    return sentences


def trial_lines(document: Mapping[str, Any]) -> list[str]:
    """What a folder says of its last trial: what came of it, then the figures.

    Raises:
        FileFormatError: If it says something else.
    """
    with file_errors(RUN):
        last = document["trials"][-1]
        found = Calibration.from_json(last)
        return [item(text) for text in found.sentences] + found.table.lines
